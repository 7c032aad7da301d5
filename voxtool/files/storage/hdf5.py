"""Records in HDF5: the attributes and datasets of the root group, as a schema lists them.

Datasets are contiguous and uncompressed, so a program can map them or upload them unchanged. A file
is not trusted: no memory is taken for a dataset before its size is known to be in the file, and no
link is followed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.arrays import Blocks, Slices
from voxtool.errors import FileError, VoxtoolError
from voxtool.files.storage.schema import FORMAT, FORMAT_VERSION, Attribute, Dataset, Schema
from voxtool.limits import bounded_memory
from voxtool.memory import check_memory

if TYPE_CHECKING:
    from collections.abc import Iterable

# Bytes of memory that a file may take beside its data. HDF5 follows a damaged list of free places
# that leads back to its start for ever, and takes memory at each step.
METADATA = 1 << 25

h5py: Any = import_module("h5py")  # its low-level modules have no types


def write(schema: Schema, content: Any, file: BinaryIO) -> None:
    """Write content into an empty file that is open for reading and writing.

    Raises
    ------
    FileError : an attribute is out of range, or does not fit.
    OSError : the file cannot be written.
    """
    stored = {"format": schema.format, **schema.encode(content)}
    with h5py.File(file, "w", track_order=False) as h5:
        for attribute in (FORMAT, *schema.held(stored)):
            _write_attribute(h5, attribute, stored[attribute.name])
        for dataset in schema.datasets:
            array = dataset.encode(content, stored)
            if isinstance(array, Blocks):
                _write_blocks(h5, dataset.name, array)
            elif array is not None:
                h5.create_dataset(dataset.name, data=array, track_times=False)


def _write_blocks(h5: Any, name: str, array: Blocks) -> None:
    stored = h5.create_dataset(name, (array.size, *array.row), array.dtype, track_times=False)
    start = 0
    for block in array.blocks:
        stored[start : start + len(block)] = block
        start += len(block)


def _write_attribute(h5: Any, attribute: Attribute, value: Any) -> None:
    dtype = "<i8" if attribute.stored is int else "<f8"
    if attribute.stored is str:
        value = value.encode()
        dtype = h5py.string_dtype("utf-8", max(1, len(value)))
    h5.attrs.create(attribute.name, value, dtype=dtype)


def read(schemas: Iterable[Schema], file: BinaryIO, size: int) -> Any:
    """Return the content of a file of `size` bytes, whose format is one of the schemas.

    Raises
    ------
    FileError : the file is damaged, hostile or of another format.
    """
    with _one_line(), opened(file) as h5:
        return _in_memory(*_content(h5, schemas, size))


def _in_memory(schema: Schema, stored: dict[str, Any], found: dict[str, Any]) -> Any:
    needed = sum(array.dtype.itemsize * math.prod(array.shape) for array in found.values())
    check_memory(needed, "its datasets", "choose a smaller file")
    return schema.decode(stored, {name: load(array) for name, array in found.items()})


def read_slices(schemas: Iterable[Schema], file: BinaryIO, size: int) -> Any:
    """Return the content of a file as `read` does, but the datasets of a sliced schema are Slices
    of the file, while it is open."""
    with _one_line():
        schema, stored, found = _content(opened(file), schemas, size)
        if not schema.sliced:
            return _in_memory(schema, stored, found)
        return schema.decode(stored, {name: _slices(array) for name, array in found.items()})


def _slices(dataset: Any) -> Slices:
    """Return the rows of a checked dataset, which are read when they are asked for."""
    size, *row = dataset.shape
    stored = dataset.get_space()

    def read(start: int, stop: int) -> np.ndarray:
        array = np.empty((stop - start, *row), dataset.dtype)
        if array.size:
            with _one_line():
                stored.select_hyperslab((start, *[0] * len(row)), array.shape)
                dataset.read(h5py.h5s.create_simple(array.shape), stored, array)
        return array

    return Slices(size, read, dataset.dtype, tuple(row))


@contextmanager
def _one_line() -> Iterator[None]:
    """Raise a FileError, which says that the file is damaged, for errors of the library."""
    try:
        yield
    except VoxtoolError:
        raise
    except Exception as error:
        first = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise FileError(f"damaged HDF5 file: {first}") from error


def _content(
    h5: Any, schemas: Iterable[Schema], size: int
) -> tuple[Schema, dict[str, Any], dict[str, Any]]:
    """Return the schema of a file, its checked attributes, and its checked datasets."""
    with bounded_memory(METADATA):
        schema = _schema_of(h5, schemas)
        return schema, *_checked(schema, h5, size)


def opened(file: BinaryIO) -> Any:
    """Return an open HDF5 file."""
    with bounded_memory(METADATA):
        return h5py.File(file, "r")


def _schema_of(h5: Any, schemas: Iterable[Schema]) -> Schema:
    """Return the schema of the file's format and major version; those behind it are not asked
    for."""
    missing = not h5py.h5a.exists(h5.id, b"format")
    if missing and h5.id.links.exists(b"VTKHDF"):
        raise FileError("holds data of VTK: voxtool import makes an octree of its voxels")
    format, others = None if missing else read_attribute(h5, FORMAT), []
    for schema in schemas:
        if schema.format == format:
            return schema.of_version(read_attribute(h5, FORMAT_VERSION))
        others.append(schema)
    what = " or ".join(schema.what for schema in others)
    names = " or ".join(schema.format for schema in others)
    if missing:
        raise FileError(f"an HDF5 file, but no {what}: attribute format={names} is missing")
    article = "an" if what[0] in "aeiou" else "a"
    raise FileError(f"holds {format!r}, not {article} {what} ({names!r}): {others[0].hint}")


def _checked(schema: Schema, h5: Any, size: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the attributes and the datasets of a file, by name."""
    names = {attribute.name for attribute in schema.attributes if attribute.name in h5.attrs}
    stored = {attribute.name: read_attribute(h5, attribute) for attribute in schema.held(names)}
    schema.check(stored)
    found, sizes = {}, dict(stored)
    for dataset in schema.datasets:
        if not dataset.needed(sizes, h5.id.links.exists(dataset.name.encode())):
            continue
        checked = _dataset(h5, dataset, sizes, size)
        names = zip(dataset.shape, checked.shape, strict=True)
        sizes |= {side: n for side, n in names if isinstance(side, str)}
        found[dataset.name] = checked
    return stored, found


def read_attribute(h5: Any, expected: Attribute) -> Any:
    """Return the stored value of an attribute of a group or dataset, its type and size checked
    before it is read."""
    name, kind, limit = expected.name, expected.stored, expected.size
    if not h5py.h5a.exists(h5.id, name.encode()):
        raise FileError(f"attribute {name} is missing")
    attribute = h5py.h5a.open(h5.id, name.encode())
    stored = attribute.get_type()
    shape = () if kind is str or limit == 1 else (limit,)
    if attribute.get_space().get_simple_extent_type() != h5py.h5s.SCALAR and shape == ():
        raise FileError(f"attribute {name} is not one value")
    if attribute.shape != shape:
        raise FileError(f"attribute {name} has shape {attribute.shape} where {shape} is expected")
    if kind is str:
        return _text(attribute, name, limit)
    type_id = h5py.h5t.TypeIntegerID if kind is int else h5py.h5t.TypeFloatID
    if not isinstance(stored, type_id) or stored.get_size() > 8:
        raise FileError(f"attribute {name} is not of type {kind.__name__}")
    values = np.empty(shape, stored.dtype)
    attribute.read(values)
    numbers = tuple(map(kind, np.atleast_1d(values)))
    return numbers if shape else numbers[0]


def _text(attribute: Any, name: str, limit: int) -> str:
    stored = attribute.get_type()
    if not isinstance(stored, h5py.h5t.TypeStringID):
        raise FileError(f"attribute {name} is not text")
    if stored.is_variable_str():
        raise FileError(f"attribute {name} is text of variable length: store it with a fixed one")
    if stored.get_size() > limit:
        raise FileError(f"attribute {name} has {stored.get_size()} bytes: at most {limit} fit")
    value = np.empty((), f"S{stored.get_size()}")
    attribute.read(value, mtype=stored)
    try:
        return value.tobytes().rstrip(b"\0").decode()
    except UnicodeDecodeError:
        raise FileError(f"attribute {name} is not UTF-8 text") from None


def _dataset(h5: Any, expected: Dataset, sizes: dict[str, Any], size: int) -> Any:
    """Return a dataset of the root group, found to be stored in this file of `size` bytes as one
    piece."""
    name = expected.name
    shape, dtype = expected.shape_for(sizes), expected.type_for(sizes)
    dataset = open_dataset(h5, name)
    creation = dataset.get_create_plist()
    if creation.get_layout() != h5py.h5d.CONTIGUOUS or creation.get_nfilters():
        raise FileError(f"dataset {name} is not contiguous: store it unchunked and uncompressed")
    number = h5py.h5t.TypeFloatID if dtype.kind == "f" else h5py.h5t.TypeIntegerID
    stored_type = dataset.get_type()
    if not isinstance(stored_type, number) or stored_type.dtype != dtype:
        raise FileError(f"dataset {name} is not of type {dtype.name}, little-endian")
    found = dataset.shape
    if len(found) != len(shape) or not all(map(_suits, found, shape)):
        raise FileError(f"dataset {name} has shape {found} where {shape} is expected")
    needed = dtype.itemsize * math.prod(map(int, found))
    stored = dataset.get_storage_size()
    start = dataset.get_offset() if needed else 0
    if stored != needed or start is None or start + needed > size:
        raise FileError(f"dataset {name} needs {needed} bytes that the file does not have")
    return dataset


def open_dataset(h5: Any, name: str) -> Any:
    """Return a dataset of the root group, whose data lie in this file; FileError if there is
    none."""
    key = name.encode()
    if not h5.id.links.exists(key):
        raise FileError(f"dataset {name} is missing")
    if h5.id.links.get_info(key).type != h5py.h5l.TYPE_HARD:
        raise FileError(f"dataset {name} is a link to another place: it must lie in the file")
    if h5py.h5o.get_info(h5.id, key).type != h5py.h5o.TYPE_DATASET:
        raise FileError(f"{name} is not a dataset")
    dataset = h5py.h5d.open(h5.id, key)
    creation = dataset.get_create_plist()
    if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
        raise FileError(f"dataset {name} lies in another file: it must lie in this one")
    return dataset


def _suits(found: int, expected: Any) -> bool:
    return expected is None or found in (expected if isinstance(expected, tuple) else (expected,))


def load(dataset: Any) -> np.ndarray:
    """Return the content of a checked dataset."""
    array = np.empty(dataset.shape, dataset.dtype)
    if array.size:
        dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array
