"""The base of the data classes: read-only arrays, equality by content, hashing by identity; and
the digests of their content."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

ALIGNMENT = 128  # bytes, of buffers that CPU drivers do not copy (CL_DEVICE_MEM_BASE_ADDR_ALIGN)


@dataclass(frozen=True)
class Blocks:
    """An array that is not in memory: its blocks come one after the other.

    row : the shape of an item; () of a one-dimensional array.
    """

    size: int
    dtype: np.dtype
    blocks: Iterator[np.ndarray]
    row: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self.size


@dataclass(frozen=True)
class Slices:
    """An array that is not in memory: a slice of it is read when it is asked for.

    row : the shape of an item; () of a one-dimensional array.
    """

    size: int
    read: Callable[[int, int], np.ndarray]  # the items from one index up to another one
    dtype: np.dtype
    row: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self.size

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of items, and the shape of one."""
        return self.size, *self.row

    @property
    def ndim(self) -> int:
        """The number of axes."""
        return 1 + len(self.row)

    @property
    def nbytes(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.dtype.itemsize

    def __getitem__(self, part: slice) -> np.ndarray:
        start, stop, _ = part.indices(self.size)
        return self.read(start, max(start, stop))


def blocks_of(
    array: np.ndarray | Slices, size: int, start: int = 0, stop: int | None = None
) -> Iterator[np.ndarray]:
    """Yield the items of an array from `start` up to `stop`, in blocks of up to `size`."""
    stop = len(array) if stop is None else stop
    for first in range(start, stop, size):
        yield array[first : min(first + size, stop)]


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a view of an array that cannot be written to; the array itself stays as it is."""
    view = array.view()
    view.flags.writeable = False
    return view


def float64(values: Any) -> np.ndarray:
    """Return a copy as float64 in C order; of signalling NaN numpy would warn."""
    with np.errstate(invalid="ignore"):
        return np.array(values, np.float64, order="C")


def aligned_empty(shape: tuple[int, ...], dtype: np.dtype | type) -> np.ndarray:
    """Return an array of undefined content, in C order, that begins at a multiple of ALIGNMENT
    bytes: CPU devices read and write it where it is."""
    nbytes = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(nbytes + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + nbytes].view(dtype).reshape(shape)


def aligned(values: Any, dtype: np.dtype | type) -> np.ndarray:
    """Return a copy of values in an aligned array, without numpy's warning of signalling NaN."""
    values = np.asarray(values)
    copy = aligned_empty(values.shape, dtype)
    with np.errstate(invalid="ignore"):
        copy[...] = values
    return copy


def digest_of(head: dict[str, Any], *arrays: np.ndarray) -> str:
    """Return the SHA-256 of a head in JSON types and of arrays, in little-endian order. Equal
    content has an equal digest on every device and platform."""
    return digest_of_blocks(head, arrays)


def digest_of_blocks(head: dict[str, Any], blocks: Iterable[np.ndarray]) -> str:
    """Return the digest_of arrays that come in blocks, one after the other."""
    sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
    for array in blocks:
        sha.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
    return sha.hexdigest()


@dataclass(frozen=True, eq=False, repr=False)
class Data:
    """The base of frozen dataclasses whose fields include arrays.

    The arrays are read-only, also in a copy and in an unpickled object. Two objects are equal if
    they are of one class and their compared fields are equal, arrays by shape, dtype and content.
    The hash is of the identity, so that a device can keep what was computed for an object.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, field.name, read_only(value))

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            _same(getattr(self, field.name), getattr(other, field.name))
            for field in fields(self)
            if field.compare
        )

    __hash__ = object.__hash__

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple(getattr(self, field.name) for field in fields(self))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    return bool(a == b)
