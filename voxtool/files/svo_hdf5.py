"""Octrees as HDF5, format `voxtool-svo`: docs/formats.md has it exactly.

The three datasets are contiguous and uncompressed, so that a program can map or upload them as
they lie in the file. A file is not trusted: nothing is allocated before its size is known to be
in the file, nothing is followed out of it, and the octree is validated.
"""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.svo_head import (
    FORMAT,
    INT,
    LAYOUT,
    TEXT,
    build,
    check_head,
    check_version,
    head_of,
)
from voxtool.svo.octree import BRICK, NODE, Octree, check_offsets

SIGNATURE = b"\x89HDF\r\n\x1a\n"
WORD = np.dtype("<u4")


def _library() -> Any:
    """h5py, imported when it is first needed; its low-level modules have no types."""
    import h5py

    return h5py


def write(octree: Octree, file: BinaryIO) -> None:
    """Write an octree into an empty file that is open for reading and writing.

    Raises
    ------
    OSError : the file cannot be written.
    """
    h5py = _library()
    head = head_of(octree)
    nodes = np.ascontiguousarray(octree.nodes, NODE).view(WORD).reshape(-1, 2)
    arrays = {
        "offsets": np.ascontiguousarray(octree.offsets, WORD),
        "nodes": nodes,
        "bricks": np.ascontiguousarray(octree.bricks, BRICK),
    }
    with h5py.File(file, "w", track_order=False) as h5:
        _write_attribute(h5, "format", TEXT, FORMAT)
        for name, (kind, _) in LAYOUT.items():
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


def read(file: BinaryIO, size: int) -> Octree:
    """Read an octree from a file of `size` bytes.

    Raises
    ------
    FileError : the file is damaged, hostile or of another kind.
    """
    h5py = _library()
    try:
        with h5py.File(file, "r") as h5:
            return _read_open(h5, size)
    except VoxtoolError:
        raise
    except Exception as error:  # damage shows in any of the library's errors
        first = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise FileError(f"damaged HDF5 file: {first}") from error


def _read_open(h5: Any, size: int) -> Octree:
    _check_format(h5)
    head = {name: _attribute(h5, name, *LAYOUT[name]) for name in LAYOUT}
    grid = check_head(head)
    found = {
        "offsets": _dataset(h5, "offsets", (head["depth"] + 1,), WORD, size),
        "nodes": _dataset(h5, "nodes", (None, 2), WORD, size),
        "bricks": _dataset(h5, "bricks", (None,), BRICK, size),
    }
    offsets = _load(found["offsets"])
    check_offsets(grid, offsets)
    nodes, bricks = int(offsets[-1]), int(offsets[-1] - offsets[-2])
    for name, expected in (("nodes", nodes), ("bricks", bricks)):
        if found[name].shape[0] != expected:
            raise FileError(
                f"dataset {name} has {found[name].shape[0]} rows where offsets say {expected}"
            )
    words = _load(found["nodes"])
    return build(grid, head, offsets, words.view(NODE).reshape(-1), _load(found["bricks"]))


def _check_format(h5: Any) -> None:
    h5py = _library()
    if not h5py.h5a.exists(h5.id, b"format"):
        raise FileError(f"an HDF5 file, but no octree: attribute format={FORMAT} is missing")
    found = _attribute(h5, "format", TEXT, 64)
    if found != FORMAT:
        raise FileError(f"holds {found!r}, not an octree ({FORMAT!r})")
    check_version(_attribute(h5, "format_version", *LAYOUT["format_version"]))


def _attribute(h5: Any, name: str, kind: type, limit: int) -> Any:
    """An attribute of the root group, its type and size checked before it is read."""
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


def _dataset(h5: Any, name: str, shape: tuple[int | None, ...], dtype: np.dtype, size: int) -> Any:
    """A dataset of the root group that lies whole in this file, in one plain piece."""
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
    if not isinstance(stored, h5py.h5t.TypeIntegerID) or stored.dtype != dtype:
        raise FileError(f"dataset {name} is not of type {dtype.name}, little-endian")
    found = dataset.shape
    if len(found) != len(shape) or any(
        b is not None and a != b for a, b in zip(found, shape, strict=True)
    ):
        raise FileError(f"dataset {name} has shape {found} where {shape} is expected")
    _check_storage(dataset, name, size)
    return dataset


def _check_storage(dataset: Any, name: str, size: int) -> None:
    needed = dataset.dtype.itemsize
    for n in dataset.shape:
        needed *= int(n)
    stored = dataset.get_storage_size()
    start = dataset.get_offset() if needed else 0
    if stored != needed or start is None or start + needed > size:
        raise FileError(f"dataset {name} needs {needed} bytes that the file does not have")


def _load(dataset: Any) -> np.ndarray:
    h5py = _library()
    array = np.empty(dataset.shape, dataset.dtype)
    if array.size:
        dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array
