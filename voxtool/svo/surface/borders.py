"""The faces between voxels of different labels, brick by brick on the host.

Only bricks and the sides of inside leaves are visited, so what lies within a leaf, or is empty,
costs nothing. A value is a label plus one, and 0 where no voxel is set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.images.blocks import keys_of
from voxtool.svo.octree.attributes import BITS
from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS
from voxtool.svo.octree.octree import Octree

AXES = np.eye(3, dtype=np.int64)
STEPS = keys_of(AXES).tolist()  # between keys of corners, along each axis
AT_ONCE = 1 << 16  # bricks
EMPTY = ~0  # the place of a brick without set voxels: ~value, as that of a brick within a leaf
# The bits of a brick's voxels that have another one of the brick above them, and of those.
LOWER = [np.flatnonzero(BRICK_VOXELS[:, axis] < BRICK_SIDE - 1) for axis in range(3)]
UPPER = [
    morton_encode(BRICK_VOXELS[bits] + step).astype(np.int64)
    for bits, step in zip(LOWER, AXES, strict=True)
]
# The bits of the first and of the last layer, in one order.
SIDES = [
    [np.flatnonzero(BRICK_VOXELS[:, axis] == at) for at in (0, BRICK_SIDE - 1)] for axis in range(3)
]


class Borders(NamedTuple):
    """The faces between voxels of different values: those across x, y and z one after the other,
    and of each axis in lexicographic order."""

    keys: np.ndarray  # (F,) int64, of keys_of: the low corner of each face
    axes: np.ndarray  # (F,) uint8: the axis that it lies across
    low: np.ndarray  # (F,) values of the voxels below it and above it
    high: np.ndarray


@dataclass(frozen=True)
class Blocks:
    """Bricks that have set voxels, and inside leaves, in Morton order.

    starts, ends : (n,) uint64 codes of bricks, from which and before which each one lies
    places : (n,) int64 a brick's row of `values`, or ~value of a leaf
    codes : (m,) uint64 codes of the bricks
    values : (m, 64) values of their voxels, in the order of the bits
    leaves : levels of leaves: codes of leaves, their places, and bricks along a side
    """

    starts: np.ndarray
    ends: np.ndarray
    places: np.ndarray
    codes: np.ndarray
    values: np.ndarray
    leaves: list[tuple[np.ndarray, np.ndarray, int]]

    @classmethod
    def of(cls, octree: Octree) -> Blocks:
        """Return the blocks of an octree that has labels."""
        label, own = octree.attribute("label"), octree.values("label")
        kept = np.flatnonzero(octree.bricks)
        values = np.zeros((len(kept), BRICK_SIDE**3), np.min_scalar_type(len(label.names)))
        for first in range(0, len(kept), AT_ONCE):
            part = kept[first : first + AT_ONCE]
            set_ = (octree.bricks[part, None] & BITS) != 0
            values[first : first + AT_ONCE][set_] = own.of_bricks(part)[set_].astype(np.int64) + 1
        levels = octree.levels()
        codes = levels[-1].codes[kept]
        of_leaves = own.of_leaves(sum(int(level.inside.sum()) for level in levels[:-1]))
        leaves, count = [], 0
        for level in levels[:-1]:
            inside = level.codes[level.inside]
            found = of_leaves[count : count + len(inside)].astype(np.int64) + 1
            leaves.append((inside << np.uint64(3 * level.number), ~found, 1 << level.number))
            count += len(inside)
        starts = np.concatenate([codes, *(start for start, _, _ in leaves)])
        sizes = [np.full(len(start), side**3, np.uint64) for start, _, side in leaves]
        ends = starts + np.concatenate([np.ones(len(codes), np.uint64), *sizes])
        places = np.concatenate([np.arange(len(codes)), *(place for _, place, _ in leaves)])
        order = np.argsort(starts)
        return cls(starts[order], ends[order], places[order], codes, values, leaves)

    def at(self, cells: np.ndarray) -> np.ndarray:
        """Return the places of bricks by their cells, (n, 3) from -1 on, which may lie beyond the
        octree."""
        found = np.full(len(cells), EMPTY)
        if not len(self.starts):
            return found
        codes = morton_encode(np.maximum(cells, 0))
        near = np.searchsorted(self.starts, codes, "right") - 1
        held = (near >= 0) & (codes < self.ends[near]) & (cells >= 0).all(axis=1)
        found[held] = self.places[near[held]]
        return found

    def layer(self, places: np.ndarray, axis: int, side: int) -> np.ndarray:
        """Return the values of the first or the last layer of bricks, (n, 16)."""
        bits = SIDES[axis][side]
        whole = np.where(places < 0, ~places, 0).astype(self.values.dtype)
        found = np.repeat(whole[:, None], len(bits), axis=1)
        own = places >= 0
        found[own] = self.values[places[own, None], bits]
        return found


def find_borders(blocks: Blocks) -> Borders:
    """Return the faces between voxels of different values."""
    dtype = blocks.values.dtype
    none = np.empty(0, np.int64), np.empty(0, dtype), np.empty(0, dtype)
    found = []
    for axis in range(3):
        pairs = chain(_around_bricks(blocks, axis), _around_leaves(blocks, axis))
        between = (_between(blocks, axis, *pair) for pair in pairs)
        columns = zip(none, *_within(blocks, axis), *between, strict=True)
        keys, low, high = map(np.concatenate, columns)
        order = np.argsort(keys)
        axes = np.full(len(keys), axis, np.uint8)
        found.append((keys[order], axes, low[order], high[order]))
    return Borders(*map(np.concatenate, zip(*found, strict=True)))


Part = tuple[np.ndarray, np.ndarray, np.ndarray]  # keys of faces, values below and above them


def _within(blocks: Blocks, axis: int) -> Iterator[Part]:
    """Yield the faces across an axis between voxels of one brick."""
    corners = keys_of(BRICK_VOXELS[UPPER[axis]].T.astype(np.int64))
    for first in range(0, len(blocks.codes), AT_ONCE):
        values = blocks.values[first : first + AT_ONCE]
        low, high = values[:, LOWER[axis]], values[:, UPPER[axis]]
        brick, pair = np.nonzero(low != high)
        cells = BRICK_SIDE * morton_decode(blocks.codes[first : first + AT_ONCE])
        yield keys_of(cells.T)[brick] + corners[pair], low[brick, pair], high[brick, pair]


def _between(
    blocks: Blocks, axis: int, cells: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Part:
    """Return the faces across an axis between voxels of two bricks, given the cells of the upper
    ones, and the places of both."""
    below, above = blocks.layer(low, axis, 1), blocks.layer(high, axis, 0)
    pair, voxel = np.nonzero(below != above)
    corners = keys_of(BRICK_VOXELS[SIDES[axis][0]].T.astype(np.int64))
    keys = keys_of(BRICK_SIDE * cells.T)[pair] + corners[voxel]
    return keys, below[pair, voxel], above[pair, voxel]


def _around_bricks(blocks: Blocks, axis: int) -> Iterator[Part]:
    """Yield the pairs along an axis of which one is a brick with set voxels, each once: cells of
    the upper ones, and the places of both."""
    step = AXES[axis]
    for first in range(0, len(blocks.codes), AT_ONCE):
        cells = morton_decode(blocks.codes[first : first + AT_ONCE])
        own = np.arange(first, first + len(cells))
        yield cells + step, own, blocks.at(cells + step)
        below = blocks.at(cells - step)
        new = below < 0
        yield cells[new], below[new], own[new]


def _around_leaves(blocks: Blocks, axis: int) -> Iterator[Part]:
    """Yield the pairs along an axis of leaves of different values, or of a leaf and what is empty,
    each once, as of _around_bricks."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    for codes, places, side in blocks.leaves:
        for first in range(0, len(codes) * side**2, AT_ONCE):
            numbers = np.arange(first, min(first + AT_ONCE, len(codes) * side**2))
            leaf, row = np.divmod(numbers, side**2)
            cells = morton_decode(codes[leaf])
            cells[:, b] += row // side
            cells[:, c] += row % side
            own, below = places[leaf], blocks.at(cells - AXES[axis])
            new = below == EMPTY
            yield cells[new], below[new], own[new]
            cells[:, axis] += side
            above = blocks.at(cells)
            new = (above < 0) & (above != own)
            yield cells[new], own[new], above[new]
