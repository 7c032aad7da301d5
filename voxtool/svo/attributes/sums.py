"""Tallies of the cells of an octree: votes for labels, and sums of numbers, over the voxels of each
cell. The value of an attribute follows from them by the rules of of_cells.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from voxtool.mesh import srgb
from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import Attribute

BITS_OF_UNIT = 24  # of light, and of normals, fractions and shares of faces in float32
CHILDREN = 8


def tally_of(attribute: Attribute, side: int) -> _Tallies:
    """Return the functions of the tallies of an attribute, in a cube of `side` voxels."""
    if attribute.name == "label":
        return _Votes(attribute)
    kinds: Any = {
        "colour": _Colours, "normal": _Normals, "area": _Areas, "fraction": _Fractions,
        "faces": _Faces,
    }  # fmt: skip
    return kinds[attribute.name](attribute, side)


class _Tallies(ABC):
    """Tallies of the voxels of each cell, and of larger cells from those of smaller ones. A
    subclass decides what a tally consists of."""

    @abstractmethod
    def of_voxels(self, values: np.ndarray, set_: np.ndarray, own: np.ndarray) -> Any:
        """Return the tally of n cells of m voxels each.

        values : (n, m, ...); set_, own : (n, m) bool, which voxels are set, and which have a value
        of their own, not the default.
        """

    @abstractmethod
    def of_leaves(self, values: np.ndarray, volume: int, own: bool) -> Any:
        """Return the tally of inside leaves of `volume` voxels each, without their numbers, given
        their values and whether these are their own."""

    @abstractmethod
    def joined(self, parts: list[Any], starts: Any) -> Any:
        """Return the tallies of consecutive cells as one; starts: the first cell of each part."""

    @abstractmethod
    def above(
        self, n: int, refined: np.ndarray, below: Any, inside: np.ndarray, leaves: Any
    ) -> Any:
        """Return the tally of the n nodes of a level.

        refined, inside : the indices of the refined nodes, and of the inside leaves; below :
        the tally of the nodes one level below; leaves : that of the inside leaves (`of_leaves`).
        """

    @abstractmethod
    def values(self, tally: Any, n: int, volume: int) -> np.ndarray:
        """Return the values of n cells of `volume` voxels each, 0 where no voxel is set."""


class _Votes(_Tallies):
    """Tallies of labels: the number of voxels of a cell that have each label, as three arrays,
    cell, label and number, which ascend by cell and label."""

    def __init__(self, attribute: Attribute) -> None:
        self.dtype = attribute.values.dtype

    def of_voxels(self, values: np.ndarray, set_: np.ndarray, own: np.ndarray) -> Any:
        # most cells have one label
        some = np.flatnonzero(set_.any(axis=1))
        set_, values = set_[some], values[some]
        first = values[np.arange(len(some)), set_.argmax(axis=1)]
        alike = ((values == first[:, None]) | ~set_).all(axis=1)
        cell, voxel = np.nonzero(set_[~alike])
        counts = np.concatenate([set_[alike].sum(axis=1), np.ones(len(cell), np.int64)])
        cells = np.concatenate([some[alike], some[~alike][cell]])
        return _merged(cells, np.concatenate([first[alike], values[~alike][cell, voxel]]), counts)

    def of_leaves(self, values: np.ndarray, volume: int, own: bool) -> Any:
        return values, np.full(len(values), volume)

    def joined(self, parts: list[Any], starts: Any) -> Any:
        columns = [
            (cells + start, *rest) for (cells, *rest), start in zip(parts, starts, strict=True)
        ]
        if not columns:
            return np.empty(0, np.int64), np.empty(0, self.dtype), np.empty(0, np.int64)
        return tuple(map(np.concatenate, zip(*columns, strict=True)))

    def above(
        self, n: int, refined: np.ndarray, below: Any, inside: np.ndarray, leaves: Any
    ) -> Any:
        cells, labels, counts = below
        parts = ((refined[cells // CHILDREN], labels, counts), (inside, *leaves))
        return _merged(*map(np.concatenate, zip(*parts, strict=True)))

    def values(self, tally: Any, n: int, volume: int) -> np.ndarray:
        cells, labels, counts = tally
        found = np.zeros(n, self.dtype)
        best = np.lexsort((-labels.astype(np.int64), counts, cells))  # the last of a cell wins
        last = np.diff(cells[best], append=-1) != 0
        found[cells[best][last]] = labels[best][last]
        return found


def _merged(cells: np.ndarray, labels: np.ndarray, counts: np.ndarray) -> Any:
    """Return votes with one row for each cell and label."""
    keys = cells.astype(np.uint64) << np.uint64(32) | labels
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=~keys[order][:1]))
    sums = np.add.reduceat(counts[order], first) if len(first) else counts[:0]
    return cells[order][first], labels[order][first], sums.astype(np.int64)


class _Sums(_Tallies):
    """Tallies of numbers: their sums over the voxels of a cell, the number of voxels that are
    summed, and the number that are set, as (n, channels + 2)."""

    wide: Any = np.uint64

    def __init__(self, attribute: Attribute, side: int) -> None:
        self.attribute, self.dtype = attribute, attribute.values.dtype
        self.channels = attribute.values.shape[1] if attribute.values.ndim > 1 else 1

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Return values as the whole numbers that are summed."""
        return values.astype(self.wide)

    def summed(self, set_: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return which voxels are summed: those with values of their own."""
        return own

    def of_voxels(self, values: np.ndarray, set_: np.ndarray, own: np.ndarray) -> Any:
        chosen = self.summed(set_, own)
        found = np.empty((len(values), self.channels + 2), self.wide)
        whole = self.whole(values.reshape(*chosen.shape, self.channels))
        found[:, :-2] = (whole * chosen[..., None].astype(self.wide)).sum(axis=1)
        found[:, -2], found[:, -1] = chosen.sum(axis=1), set_.sum(axis=1)
        return found

    def of_leaves(self, values: np.ndarray, volume: int, own: bool) -> Any:
        chosen = self.summed(np.ones(1, bool), np.full(1, own))[0]
        found = np.zeros((len(values), self.channels + 2), self.wide)
        if chosen:
            whole = self.whole(values.reshape(-1, self.channels))
            found[:, :-2], found[:, -2] = whole * self.wide(volume), volume
        found[:, -1] = volume
        return found

    def joined(self, parts: list[Any], starts: Any) -> Any:
        return np.concatenate([np.empty((0, self.channels + 2), self.wide), *parts])

    def above(
        self, n: int, refined: np.ndarray, below: Any, inside: np.ndarray, leaves: Any
    ) -> Any:
        found = np.zeros((n, self.channels + 2), self.wide)
        found[refined] = below.reshape(-1, CHILDREN, self.channels + 2).sum(axis=1)
        found[inside] = leaves
        return found

    def values(self, tally: Any, n: int, volume: int) -> np.ndarray:
        sums, counts, set_ = tally[:, :-2], tally[:, -2:-1], tally[:, -1]
        found = self.means(sums, counts, volume).astype(self.dtype)
        found[counts[:, 0] == 0] = self.attribute.blank
        found[set_ == 0] = 0
        return found.reshape(n, *self.attribute.values.shape[1:])

    @abstractmethod
    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        """Return the values of cells.

        sums : (n, channels); counts : (n, 1), the voxels that are summed; volume : voxels a cell.
        """


class _Colours(_Sums):
    def __init__(self, attribute: Attribute, side: int) -> None:
        super().__init__(attribute, side)
        self.lost = np.uint64(srgb.BITS - _bits_left(side, 64))

    def whole(self, values: np.ndarray) -> np.ndarray:
        found = values.astype(self.wide)
        light = srgb.linear_table().astype(self.wide) >> self.lost
        found[..., :3] = light[values[..., :3]]
        return found

    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        counts = np.maximum(counts, self.wide(1))
        found = _rounded(sums, counts)
        light = (sums[:, :3] // counts << self.lost).astype(np.int64)
        found[:, :3] = srgb.to_levels(light)
        return found


class _Normals(_Sums):
    wide = np.int64

    def __init__(self, attribute: Attribute, side: int) -> None:
        super().__init__(attribute, side)
        self.unit = 1 << _bits_left(side, 62)

    def whole(self, values: np.ndarray) -> np.ndarray:
        return np.rint(values.astype(np.float64) * self.unit).astype(self.wide)

    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        x, y, z = vectors = sums.astype(np.float64).T
        length = np.sqrt(x * x + y * y + z * z)
        return (vectors / np.where(length > 0, length, 1.0)).T


class _Fractions(_Sums):
    def __init__(self, attribute: Attribute, side: int) -> None:
        super().__init__(attribute, side)
        self.unit = 1 << _bits_left(side, 63)

    def whole(self, values: np.ndarray) -> np.ndarray:
        if self.dtype.kind != "f":
            return super().whole(values)
        return np.rint(values.astype(np.float64) * self.unit).astype(self.wide)

    def summed(self, set_: np.ndarray, own: np.ndarray) -> np.ndarray:
        return set_

    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        if self.dtype.kind != "f":
            return _rounded(sums, np.array(volume, self.wide))
        return sums.astype(np.float64) / (float(volume) * self.unit)


class _Faces(_Fractions):
    """Tallies of the faces of a cell: sums over the faces of voxels that lie in them."""

    def of_voxels(self, values: np.ndarray, set_: np.ndarray, own: np.ndarray) -> Any:
        within = values.reshape(*set_.shape, self.channels) * _in_faces(set_.shape[1])
        return super().of_voxels(within.astype(self.dtype), set_, own)

    def of_leaves(self, values: np.ndarray, volume: int, own: bool) -> Any:
        return super().of_leaves(values, _face_of(volume), own)

    def above(
        self, n: int, refined: np.ndarray, below: Any, inside: np.ndarray, leaves: Any
    ) -> Any:
        within = below.reshape(-1, CHILDREN, self.channels + 2).copy()
        within[..., :-2] *= _in_faces(CHILDREN).astype(self.wide)
        return super().above(n, refined, within, inside, leaves)

    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        return super().means(sums, counts, _face_of(volume))


def _in_faces(n: int) -> np.ndarray:
    """Return which faces of a cube each of its n cells lies in, (n, 6) bool, in Morton order."""
    at = morton_decode(np.arange(n, dtype=np.uint64))
    return np.stack([at == 0, at == at.max()], axis=2).reshape(n, -1)


def _face_of(volume: int) -> int:
    """Return the number of faces of voxels in a face of a cube of `volume` voxels."""
    return round(volume ** (1 / 3)) ** 2


class _Areas(_Sums):
    def __init__(self, attribute: Attribute, side: int) -> None:
        super().__init__(attribute, side)
        self.unit = (1 << _bits_left(side, 63)) / (attribute.largest or 1.0)

    def whole(self, values: np.ndarray) -> np.ndarray:
        return np.rint(values.astype(np.float64) * self.unit).astype(self.wide)

    def means(self, sums: np.ndarray, counts: np.ndarray, volume: int) -> np.ndarray:
        # the area of a cell is the sum, not the mean, of those of its voxels
        return sums.astype(np.float64) / self.unit


def _bits_left(side: int, bits: int) -> int:
    """Return the bits of the unit with which the sum over a cube of `side` voxels has `bits`."""
    return min(BITS_OF_UNIT, bits - 3 * (side.bit_length() - 1))


def _floor_of_twice(sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return twice the mean, sums / counts, rounded down to a whole number."""
    whole = sums // counts
    rest = sums - whole * counts
    return whole * 2 + (rest >= counts - rest)


def _rounded(sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return means, rounded to the nearest whole number, halves up."""
    return (_floor_of_twice(sums, counts) + 1) // 2
