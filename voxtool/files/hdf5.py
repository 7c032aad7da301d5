"""What the HDF5 formats share: attributes and datasets of the root group, written and read.

Datasets are contiguous and uncompressed, so that a program can map or upload them as they lie in
the file. A file is not trusted: nothing is allocated before its size is known to be in the file,
and nothing is followed out of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import numpy as np

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.head import INT, TEXT, VERSION_LIMIT, Layout, check_version

if TYPE_CHECKING:
    from collections.abc import Callable

SIGNATURE = b"\x89HDF\r\n\x1a\n"
FORMAT_LIMIT = 64  # bytes of the name of a format

Content = TypeVar("Content")


def _library() -> Any:
    """h5py, imported when it is first needed; its low-level modules have no types."""
    import h5py

    return h5py


# Writing


def write(
    file: BinaryIO, format: str, head: dict[str, Any], layout: Layout, arrays: dict[str, np.ndarray]
) -> None:
    """Write attributes and datasets into an empty file that is open for reading and writing.

    Raises
    ------
    OSError : the file cannot be written.
    """
    h5py = _library()
    with h5py.File(file, "w", track_order=False) as h5:
        _write_attribute(h5, "format", TEXT, format)
        for name, (kind, _) in layout.items():
            _write_attribute(h5, name, kind, head[name])
        for name, array in arrays.items():
            h5.create_dataset(name, data=array, track_times=False)


def _write_attribute(h5: Any, name: str, kind: type, value: Any) -> None:
    h5py = _library()
    if kind is TEXT:
        data = value.encode()
        h5.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))
    else:
        h5.attrs.create(name, value, dtype="<i8" if kind is INT else "<f8")


# Reading


def read(file: BinaryIO, size: int, read_open: Callable[[Any, int], Content]) -> Content:
    """What `read_open` makes of the open HDF5 file of `size` bytes.

    Raises
    ------
    FileError : the file is damaged, or what read_open says.
    """
    h5py = _library()
    try:
        with h5py.File(file, "r") as h5:
            return read_open(h5, size)
    except VoxtoolError:
        raise
    except Exception as error:  # damage shows in any of the library's errors
        first = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise FileError(f"damaged HDF5 file: {first}") from error


def check_format(h5: Any, format: str, version: str, what: str, mend: str) -> None:
    """Check that a file says that it is of this format and major version.

    Parameters
    ----------
    what : the format holds; mend : what to do with a file of another format.

    Raises
    ------
    FileError : it is of another.
    """
    h5py = _library()
    if not h5py.h5a.exists(h5.id, b"format"):
        raise FileError(f"an HDF5 file, but no {what}: attribute format={format} is missing")
    found = attribute(h5, "format", TEXT, FORMAT_LIMIT)
    if found != format:
        article = "an" if what[0] in "aeiou" else "a"
        raise FileError(f"holds {found!r}, not {article} {what} ({format!r}): {mend}")
    check_version(attribute(h5, "format_version", TEXT, VERSION_LIMIT), version)


def read_by_format(
    file: BinaryIO, size: int, readers: dict[str, Callable[[BinaryIO, int], Content]]
) -> Content:
    """What the reader for the format that a file of `size` bytes names makes of it.

    Raises
    ------
    FileError : it names none of these, or what the reader says.
    """

    def named(h5: Any, size: int) -> str:
        if not _library().h5a.exists(h5.id, b"format"):
            raise FileError(f"an HDF5 file without an attribute format: {known}")
        return attribute(h5, "format", TEXT, FORMAT_LIMIT)

    known = f"expected one of {', '.join(readers)}"
    format = read(file, size, named)
    if format not in readers:
        raise FileError(f"holds {format!r}: {known}")
    return readers[format](file, size)


def attribute(h5: Any, name: str, kind: type, limit: int) -> Any:
    """An attribute of the root group, its type and size checked before it is read.

    Raises
    ------
    FileError : it is missing, or of another type or size.
    """
    h5py = _library()
    if not h5py.h5a.exists(h5.id, name.encode()):
        raise FileError(f"attribute {name} is missing")
    attribute = h5py.h5a.open(h5.id, name.encode())
    stored = attribute.get_type()
    shape = () if kind is TEXT or limit == 1 else (limit,)
    if attribute.get_space().get_simple_extent_type() != h5py.h5s.SCALAR and shape == ():
        raise FileError(f"attribute {name} is not one value")
    if attribute.shape != shape:
        raise FileError(f"attribute {name} has shape {attribute.shape} where {shape} is expected")
    if kind is TEXT:
        return _text(attribute, name, limit)
    wanted = h5py.h5t.TypeIntegerID if kind is INT else h5py.h5t.TypeFloatID
    if not isinstance(stored, wanted) or stored.get_size() > 8:
        raise FileError(f"attribute {name} is not of type {kind.__name__}")
    values = np.empty(shape, stored.dtype)
    attribute.read(values)
    numbers = tuple(map(kind, np.atleast_1d(values)))
    return numbers if shape else numbers[0]


def _text(attribute: Any, name: str, limit: int) -> str:
    h5py = _library()
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


def has_dataset(h5: Any, name: str) -> bool:
    """Whether the root group has a member of this name."""
    return h5.id.links.exists(name.encode())


def dataset(h5: Any, name: str, shape: tuple[Any, ...], dtype: np.dtype, size: int) -> Any:
    """A dataset of the root group that lies whole in this file, in one plain piece.

    Parameters
    ----------
    shape : of each side what it must be, the tuple of what it may be, or None for anything.
    size : of the file.

    Raises
    ------
    FileError : it is missing, stored in another way, of another type or shape, or not in the file.
    """
    h5py = _library()
    key = name.encode()
    if not h5.id.links.exists(key):
        raise FileError(f"dataset {name} is missing")
    if h5.id.links.get_info(key).type != h5py.h5l.TYPE_HARD:
        raise FileError(f"dataset {name} is a link to another place: it must lie in the file")
    if h5py.h5o.get_info(h5.id, key).type != h5py.h5o.TYPE_DATASET:
        raise FileError(f"{name} is not a dataset")
    dataset = h5py.h5d.open(h5.id, key)
    creation = dataset.get_create_plist()
    if creation.get_layout() != h5py.h5d.CONTIGUOUS or creation.get_nfilters():
        raise FileError(f"dataset {name} is not contiguous: store it unchunked and uncompressed")
    if creation.get_external_count():
        raise FileError(f"dataset {name} lies in another file: it must lie in this one")
    stored = dataset.get_type()
    wanted = h5py.h5t.TypeFloatID if dtype.kind == "f" else h5py.h5t.TypeIntegerID
    if not isinstance(stored, wanted) or stored.dtype != dtype:
        raise FileError(f"dataset {name} is not of type {dtype.name}, little-endian")
    found = dataset.shape
    if len(found) != len(shape) or not all(map(_suits, found, shape)):
        raise FileError(f"dataset {name} has shape {found} where {shape} is expected")
    _check_storage(dataset, name, size)
    return dataset


def _suits(found: int, expected: Any) -> bool:
    return expected is None or found in (expected if isinstance(expected, tuple) else (expected,))


def _check_storage(dataset: Any, name: str, size: int) -> None:
    needed = dataset.dtype.itemsize
    for n in dataset.shape:
        needed *= int(n)
    stored = dataset.get_storage_size()
    start = dataset.get_offset() if needed else 0
    if stored != needed or start is None or start + needed > size:
        raise FileError(f"dataset {name} needs {needed} bytes that the file does not have")


def load(dataset: Any) -> np.ndarray:
    """The content of a dataset that has been checked."""
    h5py = _library()
    array = np.empty(dataset.shape, dataset.dtype)
    if array.size:
        dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array
