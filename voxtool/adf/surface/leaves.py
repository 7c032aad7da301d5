"""The leaves that a surface of a field may pass, and their vertices.

A vertex is inside where its value is below the offset, by more than the rounding of distances: so
vertices on the surface have one side, not those that rounding gives them. Leaves that share a
vertex may have different values there: hanging vertices are rounded, and a field may have cracks.
The finest leaf decides; of several, the last along the Morton curve. Vertices on the sides of the
cube are outside, so that a surface that leaves the cube is closed there.

A leaf is near the surface if it lies in a cell of a coarse grid, or beside one, where some value is
inside and some is not. All leaves at a vertex whose values disagree are near, and all leaves at an
edge that the surface crosses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from voxtool.adf.field.cells import cell_of
from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.raycast import refined_children
from voxtool.adf.surface.thin import ROUNDING, beside_thin, join_specks
from voxtool.morton import morton_decode

GRID_LEVEL = 8  # of the coarse grid, at most
COORDINATE_BITS = 21  # bits of a vertex, in edges of the deepest leaves
CORNERS = np.indices((2, 2, 2)).reshape(3, 8)[::-1].T  # x, y, z of the corners; x changes fastest


@dataclass(frozen=True)
class Leaves:
    """All leaves of a field, along the Morton curve.

    codes : (n,) uint64, the Morton codes of their low corners, in edges of the deepest leaves.
    levels : (n,) int64; blocks : (n,) int64, the blocks they are children of; octants : (n,) int64.
    """

    depth: int
    codes: np.ndarray
    levels: np.ndarray
    blocks: np.ndarray
    octants: np.ndarray

    @classmethod
    def of(cls, field: DistanceField) -> Leaves:
        """Return the leaves of a field."""
        parents, depth = field.blocks.astype(np.uint64), field.depth
        bits = np.unpackbits(refined_children(field)[:, None], axis=1, bitorder="little")
        blocks, octants = np.nonzero(bits == 0)
        levels = cell_of(parents)[0] + 1
        leading = np.uint64(1) << (3 * levels - 3).astype(np.uint64)
        shift = (3 * (depth - levels)).astype(np.uint64)
        codes = (parents ^ leading)[blocks] << np.uint64(3) | octants.astype(np.uint64)
        codes <<= shift[blocks]
        order = np.argsort(codes)  # all differ
        blocks, octants = blocks[order], octants[order]
        return cls(depth, codes[order], levels[blocks], blocks, octants)

    @cached_property
    def corners(self) -> np.ndarray:
        """(n, 3) int64: their low corners, in edges of the deepest leaves."""
        return morton_decode(self.codes)

    def at(self, codes: np.ndarray) -> np.ndarray:
        """Return the leaves that contain the cells of the deepest level with these codes."""
        return np.searchsorted(self.codes, codes, side="right") - 1

    def cells(self, some: np.ndarray) -> np.ndarray:
        """Return the cells of some leaves at their levels, (k, 3) int64."""
        return self.corners[some] >> (self.depth - self.levels[some])[:, None]


@dataclass(frozen=True)
class Vertices:
    """The vertices of the leaves near a surface.

    leaves : (k,) int64, these leaves; corners : (k, 8) int64, their vertices, x changes fastest.
    places : (v, 3) int64, in edges of the deepest leaves; values : (v,) float64, less the offset;
    inside : (v,) bool. Those that are inside though their values are not are beside thin parts.
    """

    leaves: np.ndarray
    corners: np.ndarray
    places: np.ndarray
    values: np.ndarray
    inside: np.ndarray


def vertices_near(field: DistanceField, leaves: Leaves, offset: np.float32) -> Vertices:
    """Return the vertices of the leaves near the surface at an offset, in sides."""
    below = field.voxels < offset - ROUNDING
    thin = offset >= 0 and field.reached.get("thin")
    if thin:
        below |= beside_thin(field, offset)
    near = _near(leaves, below)
    near = near[np.argsort(leaves.levels[near], kind="stable")]  # of equal ones, the last decides
    depth, x, y, z = leaves.depth, *CORNERS[leaves.octants[near]].T
    block = leaves.blocks[near]
    values, inner = (
        np.stack([of[block, z + k, y + j, x + i] for i, j, k in CORNERS], axis=1)
        for of in (field.voxels, below)
    )
    shift = depth - leaves.levels[near]
    places = (leaves.cells(near)[:, None] + CORNERS) << shift[:, None, None]
    keys = (places[..., 2] << COORDINATE_BITS | places[..., 1]) << COORDINATE_BITS | places[..., 0]
    order = np.argsort(keys.ravel())
    first = np.diff(keys.ravel()[order], prepend=-1) != 0
    numbers = np.empty(keys.size, np.int64)
    numbers[order] = np.cumsum(first) - 1
    if not len(near):
        return Vertices(near, keys, places[:, 0], values[:, 0].astype(np.float64), inner[:, 0])
    chosen = np.maximum.reduceat(order, np.flatnonzero(first))
    places, found = places.reshape(-1, 3)[chosen], values.ravel()[chosen]
    inside = inner.ravel()[chosen] & ((places > 0) & (places < 1 << depth)).all(axis=1)
    less, corners = found.astype(np.float64) - np.float64(offset), numbers.reshape(-1, 8)
    if thin:
        join_specks(corners, shift == 0, keys.ravel()[chosen], less, inside)
    return Vertices(near, corners, places, less, inside)


def _near(leaves: Leaves, inside: np.ndarray) -> np.ndarray:
    """Return the leaves near the surface, ascending, given which vertices of blocks are inside."""
    flags = _sides(inside)[:, leaves.blocks, leaves.octants]
    top = min(leaves.depth, GRID_LEVEL)
    levels = np.minimum(leaves.levels, top)
    places = leaves.corners >> (leaves.depth - levels)[:, None]
    x, y, z = places.T
    flat = ((x << levels) + y << levels) + z  # of the grid of each leaf's level
    own = [np.flatnonzero(levels == level) for level in range(top + 1)]
    some = np.zeros((2, 1, 1, 1), bool)  # inside, and outside
    for level in range(1, top + 1):
        for axis in (1, 2, 3):
            some = some.repeat(2, axis)
        for held, side in zip(some.reshape(2, -1), flags[:, own[level]], strict=True):
            held[flat[own[level]][side]] = True
    for axis in (1, 2, 3):
        ends = np.moveaxis(some, axis, 0)[:, 1]
        ends[0] = ends[-1] = True  # the sides of the cube are outside
    for axis in (1, 2, 3):
        spread = np.moveaxis(some.copy(), axis, 0)
        one = np.moveaxis(some, axis, 0)
        spread[1:] |= one[:-1]
        spread[:-1] |= one[1:]
        some = np.moveaxis(spread, 0, axis)
    near, found = some[0] & some[1], np.zeros(len(leaves.codes), bool)
    for level in range(top, 0, -1):
        found[own[level]] = near.reshape(-1)[flat[own[level]]]
        for axis in range(3):
            pairs = np.moveaxis(near, axis, 0)
            near = np.moveaxis(pairs[::2] | pairs[1::2], 0, axis)
        near = np.ascontiguousarray(near)
    return np.flatnonzero(found)


def _sides(inside: np.ndarray) -> np.ndarray:
    """Return whether some corner of each child of (n, 3, 3, 3) blocks is inside, and outside,
    (2, n, 8) bool."""
    found = []
    for part in (inside, ~inside):
        for axis in (1, 2, 3):
            part = np.moveaxis(part, axis, 0)
            part = np.moveaxis(part[:-1] | part[1:], 0, axis)
        found.append(part.reshape(-1, 8))
    return np.stack(found)
