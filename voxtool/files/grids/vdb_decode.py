"""Trees of OpenVDB as voxels: the reverse of vdb_encode.py, for what other programs write, too.

A file is not trusted: every count is compared with the bytes that are left before memory is taken
for it, and values are unpacked to the size that their node has, at most.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError
from voxtool.files.grids.vdb_encode import (
    ACTIVE_MASK,
    ALL_MINUS,
    BLOSC,
    CELLS,
    EVERY_VALUE,
    LEAF_SIDE,
    LOWER,
    LOWER_SIDE,
    MASK_BYTES,
    ONE_VALUE,
    PLUS_OR_MINUS,
    PLUS_OR_VALUE,
    TWO_VALUES,
    UPPER,
    UPPER_SIDE,
    ZIP,
)

LEAVES = 1 << 12  # that are passed on at once
BLOSC_HEADER = struct.Struct("<4B3I")  # versions, flags, size of a value; sizes: whole, block, all
TRANSLATED = ("UniformScaleTranslateMap", "ScaleTranslateMap")
SCALED = ("UniformScaleMap", "ScaleMap")
MATRICES = ("AffineMap", "UnitaryMap")
LENGTH = struct.Struct("<q")  # of packed values, negative if they are not packed
MOST_TEXT = 1 << 16  # bytes of a text


class Source:
    """A file that is read from its start to its end.

    Parameters
    ----------
    file : BinaryIO
        An open file that can seek.
    size : int
        Its bytes.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self.file, self.size = file, size
        self.place = file.tell()

    def take(self, count: int) -> bytes:
        """Return the next bytes; FileError if there are fewer."""
        self.check(count)
        self.place += count
        return self.file.read(count)

    def check(self, count: int) -> None:
        """Raise FileError if fewer bytes are left."""
        if not 0 <= count <= self.size - self.place:
            raise FileError(f"{count} bytes are expected at byte {self.place}, beyond its end")

    def go(self, place: int) -> None:
        """Go on from another byte."""
        if not 0 <= place <= self.size:
            raise FileError(f"names byte {place} of its {self.size}")
        self.place = place
        self.file.seek(place)

    def numbers(self, form: str) -> tuple[Any, ...]:
        """Return numbers, little-endian, by the letters of struct."""
        return struct.unpack(f"<{form}", self.take(struct.calcsize(f"<{form}")))

    def number(self, form: str) -> int:
        """Return one number."""
        return self.numbers(form)[0]

    def text(self) -> str:
        """Return a text after its length."""
        length = self.number("I")
        if length > MOST_TEXT:
            raise FileError(f"a name of {length} bytes: the file is damaged")
        return self.take(length).decode(errors="replace")


def read_matrix(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """Return the map from indices to the world: the columns of its matrix, and its translation."""
    kind = source.text()
    if kind in TRANSLATED or kind in SCALED:
        count = 3 * (6 if kind in TRANSLATED else 5)
        values = np.array(source.numbers(f"{count}d"))
        translation = values[:3] if kind in TRANSLATED else np.zeros(3)
        return np.diag(values[3:6] if kind in TRANSLATED else values[:3]), translation
    if kind == "TranslationMap":
        return np.eye(3), np.array(source.numbers("3d"))
    if kind in MATRICES:
        rows = np.array(source.numbers("16d")).reshape(4, 4)
        return rows[:3, :3].T, rows[3, :3]
    raise FileError(f"its transform is a {kind[:40]}: resample it to a linear one first")


@dataclass
class Tree:
    """A tree whose topology has been read.

    Attributes
    ----------
    dtype : np.dtype
        The type of the values.
    half : bool
        Whether values are stored as half floats.
    flags : int
        How values are packed.
    background : scalar
        The value of what no node holds.
    corners : list of (3,) int arrays and masks : list of (n, 64) uint8
        The low cells and the bits of active cells of leaves, a lower node in one piece.
    tiles : list of (corners, side, values, active)
        The tiles of nodes.
    """

    dtype: np.dtype
    half: bool
    flags: int
    background: Any = 0
    corners: list[np.ndarray] = field(default_factory=list)
    masks: list[np.ndarray] = field(default_factory=list)
    tiles: list[tuple[np.ndarray, int, np.ndarray, np.ndarray]] = field(default_factory=list)

    def read_topology(self, source: Source) -> None:
        """Read all nodes."""
        if source.number("I") != 1:
            raise FileError("its leaves have several buffers")
        self.background = self._one(source)
        tiles, children = source.numbers("2I")
        each = 12 + self.dtype.itemsize
        source.check(tiles * (each + 1) + children * 12)
        for _ in range(tiles):
            corner = np.array([source.numbers("3i")], np.int64)
            value, active = self._one(source), source.number("B")
            self.tiles.append((corner, UPPER_SIDE, np.array([value]), np.array([active != 0])))
        for _ in range(children):
            corner = np.array(source.numbers("3i"), np.int64)
            if (corner % UPPER_SIDE).any():
                raise FileError("a node is not at a multiple of its side")
            for low in self._node(source, corner, UPPER, LOWER_SIDE):
                leaves = self._node(source, low, LOWER, LEAF_SIDE)
                masks = source.take(MASK_BYTES * len(leaves))
                self.corners.append(leaves)
                self.masks.append(np.frombuffer(masks, np.uint8).reshape(-1, MASK_BYTES))

    def _node(self, source: Source, corner: np.ndarray, power: int, side: int) -> np.ndarray:
        """Read a node; return the low cells of its children, (n, 3), which have this side."""
        count = 1 << 3 * power
        child, active = (
            np.unpackbits(np.frombuffer(source.take(count // 8), np.uint8), bitorder="little").view(
                bool
            )
            for _ in range(2)
        )
        (values,) = self.values(source, active[None])
        tiles = np.flatnonzero(~child & (active | (values != 0)))
        if len(tiles):
            held = self._corners(corner, tiles, power, side)
            self.tiles.append((held, side, values[tiles], active[tiles]))
        return self._corners(corner, np.flatnonzero(child), power, side)

    @staticmethod
    def _corners(corner: np.ndarray, places: np.ndarray, power: int, side: int) -> np.ndarray:
        parts = [places >> shift & ((1 << power) - 1) for shift in (2 * power, power, 0)]
        return corner + side * np.stack(parts, axis=1)

    def _one(self, source: Source) -> Any:
        return np.frombuffer(source.take(self.dtype.itemsize), self.dtype)[0]

    def values(self, source: Source, active: np.ndarray, skip: int = 0) -> np.ndarray:
        """Return the values of nodes, (n, cells), whose active ones are given as (n, cells) bool;
        `skip` bytes before those of each node are passed over."""
        active = active.copy()  # of the cells whose values follow
        first, second = np.full((2, len(active)), self.background, self.dtype)
        chosen, bits, parts = [], [], []
        for row, count in enumerate(np.count_nonzero(active, axis=1).tolist()):
            how = source.take(skip + 1)[-1]
            if how:  # otherwise inactive values are the background
                if how > EVERY_VALUE or (how != EVERY_VALUE and not self.flags & ACTIVE_MASK):
                    raise FileError(f"the values of a node are stored in an unknown way, {how}")
                if how == EVERY_VALUE:
                    active[row] = True
                    count = active.shape[1]
                if how in (ALL_MINUS, PLUS_OR_MINUS):
                    first[row] = self._negative()
                if how in (ONE_VALUE, PLUS_OR_VALUE, TWO_VALUES):
                    first[row] = self._one(source)
                if how == TWO_VALUES:
                    second[row] = self._one(source)
                if how in (PLUS_OR_MINUS, PLUS_OR_VALUE, TWO_VALUES):
                    chosen.append(row)
                    bits.append(source.take(active.shape[1] // 8))
            parts.append(self._unpacked(source, count))
        found = np.repeat(first[:, None], active.shape[1], axis=1)
        if chosen:
            which = np.unpackbits(np.frombuffer(b"".join(bits), np.uint8), bitorder="little")
            found[chosen] = np.where(
                which.reshape(len(chosen), -1), second[chosen, None], found[chosen]
            )
        found[active] = np.frombuffer(b"".join(parts), self._stored)
        return found

    def _negative(self) -> Any:
        return ~self.background if self.dtype.kind == "b" else -self.background

    @property
    def _stored(self) -> np.dtype:
        """The type of the values of active cells in the file."""
        return np.dtype("<f2") if self.half else self.dtype

    def _unpacked(self, source: Source, count: int) -> bytes:
        """Return the bytes of the next values."""
        if self.half and not count:
            return b""
        needed = count * self._stored.itemsize
        if not self.flags & (ZIP | BLOSC):
            return source.take(needed)
        (length,) = LENGTH.unpack(source.take(LENGTH.size))
        data = source.take(abs(length))
        if length > 0:
            data = unpack_blosc(data, needed) if self.flags & BLOSC else unzip(data, needed)
        if len(data) != needed:
            raise FileError(f"{len(data)} bytes of values where {needed} are expected")
        return data

    def leaves(self, source: Source) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield the low cells, the values (n, 512) and the active cells (n, 512) of leaves."""
        for corners, masks in zip(self.corners, self.masks, strict=True):
            for first in range(0, len(corners), LEAVES):
                chosen = slice(first, first + LEAVES)
                active = np.unpackbits(masks[chosen], axis=1, bitorder="little").view(bool)
                if self.dtype.kind == "b":
                    values = self._bits_of_leaves(source, len(active))
                else:
                    values = self.values(source, active, MASK_BYTES)  # the mask again
                yield corners[chosen], values, active

    @staticmethod
    def _bits_of_leaves(source: Source, count: int) -> np.ndarray:
        """Return the values of leaves of bool: after the mask again and the low cell, bits."""
        skipped = MASK_BYTES + 12
        data = np.frombuffer(source.take((skipped + MASK_BYTES) * count), np.uint8)
        bits = data.reshape(count, -1)[:, skipped:]
        return np.unpackbits(bits, axis=1, bitorder="little").reshape(-1, CELLS) != 0


def unzip(data: bytes, needed: int) -> bytes:
    """Return unpacked bytes, one more than needed at most."""
    return zlib.decompressobj().decompress(data, needed + 1)


def unpack_blosc(data: bytes, needed: int) -> bytes:
    """Return unpacked bytes; FileError if their number is not that which is needed."""
    try:
        from numcodecs.blosc import decompress
    except ImportError:
        raise FileError(
            "is packed by Blosc, which needs numcodecs: pip install 'voxtool[formats]'"
        ) from None
    whole, _, packed = BLOSC_HEADER.unpack(data[: BLOSC_HEADER.size])[4:]
    if whole != needed or packed != len(data):
        raise FileError(f"a piece of {whole} bytes by Blosc where {needed} are expected")
    try:
        return bytes(decompress(data)) if needed else b""  # which it takes for an error
    except RuntimeError as error:
        raise FileError(f"a piece by Blosc is damaged: {error}") from None
