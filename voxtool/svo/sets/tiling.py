"""Sets of voxels as tiles of 16 x 16 x 16, in a frame around a grid: what morphology works on.

The frame is a cube four times as wide as the cube around the grid, which lies at a quarter of it
along each axis, so that a set can grow beyond the grid and its complement has a place. A tile is a
node of level 2. A set is its mixed tiles, as bricks, and its FULL leaves, nodes of level 2 and
above that are wholly set.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Self

import numpy as np

from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.morton import among, distinct, morton_decode, morton_encode, morton_step
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, descend
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS, octree_of_bricks

LEVEL = 2  # of tiles
TILE = BRICK_SIDE << LEVEL  # voxels along a side
BRICKS = 8**LEVEL  # of a tile
BRICK_CELLS = morton_decode(np.arange(BRICKS, dtype=np.uint64))


@dataclass(frozen=True)
class Box:
    """A box of voxels, from one corner up to another, (3,) each, counted from a set's grid."""

    low: np.ndarray
    high: np.ndarray

    def grown(self, reach: tuple[int, ...], times: int = 1) -> Self:
        """Return the box with `times` the reach added on both sides of each axis."""
        by = times * np.array(reach)
        return type(self)(self.low - by, self.high + by)


@dataclass(frozen=True)
class Tiling:
    """A set of voxels.

    Attributes
    ----------
    corner : int
        Where the grid begins along each axis of the frame, in voxels: a power of two.
    codes : (n,) uint64
        Ascending Morton codes of the mixed tiles.
    bricks : (n, 64) uint64
        Their bricks, in Morton order.
    full : list of (m,) uint64
        Morton codes of the FULL leaves, by level from the tiles' to that of the frame.
    """

    corner: int
    codes: np.ndarray
    bricks: np.ndarray
    full: list[np.ndarray]

    @property
    def side(self) -> int:
        """Tiles along a side of the frame."""
        return 1 << (len(self.full) - 1)

    @classmethod
    def of(cls, octree: Octree, reach: int) -> Self:
        """Return the set of an octree, in a frame with room for it to grow by `reach` voxels."""
        room = TILE * (-(-reach // TILE) + 1)
        corner = max(octree.grid.side, 1 << (room - 1).bit_length())
        levels = (4 * corner // TILE).bit_length()
        full = [np.empty(0, np.uint64) for _ in range(levels)]
        bricks, masks = [], []
        for level in octree.levels():
            place = np.uint64(morton_encode(np.full((1, 3), corner // level.side))[0])
            if level.number >= LEVEL:
                full[level.number - LEVEL] = level.codes[level.inside] | place
                continue
            chosen = level.inside if level.number else octree.bricks != 0
            bricks.append(descend(level.codes[chosen] | place, level.number))
            masks.append(
                np.full(len(bricks[-1]), ALL_VOXELS) if level.number else octree.bricks[chosen]
            )
        found = np.concatenate(bricks)
        codes = distinct(found >> np.uint64(3 * LEVEL))
        tiles = np.zeros((len(codes), BRICKS), BRICK)
        places = np.searchsorted(codes, found >> np.uint64(3 * LEVEL))
        tiles[places, (found & np.uint64(BRICKS - 1)).astype(np.int64)] = np.concatenate(masks)
        return cls(corner, codes, tiles, full).normal()

    def normal(self) -> Self:
        """Return the same set without tiles that are empty or FULL among the mixed ones."""
        empty, whole = (self.bricks == 0).all(axis=1), (self.bricks == ALL_VOXELS).all(axis=1)
        mixed = ~(empty | whole)
        if mixed.all():
            return self
        full = [np.sort(np.concatenate([self.full[0], self.codes[whole]])), *self.full[1:]]
        return type(self)(self.corner, self.codes[mixed], self.bricks[mixed], full)

    def complement(self) -> Self:
        """Return the set of the frame's other voxels."""
        held, full = self.codes, []
        for leaves in self.full[:-1]:
            held = np.sort(np.concatenate([held, leaves]))
            parents = distinct(held >> np.uint64(3))
            children = descend(parents)
            full.append(children[~among(held, children)])
            held = parents
        root = np.zeros(0 if len(held) or len(self.full[-1]) else 1, np.uint64)
        return type(self)(self.corner, self.codes, ~self.bricks, [*full, root])

    @cached_property
    def _leaves(self) -> tuple[np.ndarray, np.ndarray]:
        """The first tile of each FULL leaf, ascending, and the leaf's level."""
        levels = np.repeat(np.arange(len(self.full)), [len(codes) for codes in self.full])
        firsts = np.concatenate(self.full) << (3 * levels).astype(np.uint64)
        order = np.argsort(firsts)
        return firsts[order], levels[order]

    def is_full(self, codes: np.ndarray, level: int = 0) -> np.ndarray:
        """Return which nodes, `level` levels above the tiles, lie in a FULL leaf."""
        firsts, levels = self._leaves
        if not len(firsts):
            return np.zeros(len(codes), bool)
        own = codes << np.uint64(3 * level)
        at = np.maximum(np.searchsorted(firsts, own, side="right") - 1, 0)
        held = own - firsts[at] < np.uint64(1) << (3 * levels[at]).astype(np.uint64)
        return held & (levels[at] >= level)

    def bricks_of(self, codes: np.ndarray) -> np.ndarray:
        """Return the bricks of tiles, (n, 64) uint64."""
        bricks = np.zeros((len(codes), BRICKS), BRICK)
        places = np.searchsorted(self.codes, codes)
        mixed = np.append(self.codes, ~np.uint64(0))[places] == codes
        bricks[mixed] = self.bricks[places[mixed]]
        bricks[self.is_full(codes)] = ALL_VOXELS
        return bricks

    def within(self, codes: np.ndarray, box: Box | None, level: int = 0) -> np.ndarray:
        """Return which nodes, `level` levels above the tiles, reach a box."""
        if box is None:
            return np.ones(len(codes), bool)
        side = TILE << level
        low = morton_decode(codes).astype(np.int64) * side - self.corner
        return np.all((low + side > box.low) & (low < box.high), axis=1)

    def boundary(self, box: Box | None = None) -> np.ndarray:
        """Return the ascending codes of the tiles that hold every voxel of the set, or of its part
        in a box, with an unset voxel beside a face: mixed ones, and FULL ones beside a tile that is
        not."""
        kept = np.empty(0, np.uint64)
        for level in range(len(self.full) - 1, -1, -1):
            nodes = np.concatenate([descend(kept), self.full[level]])
            nodes = nodes[self.within(nodes, box, level)]
            bare = np.zeros(len(nodes), bool)
            for axis, step in product(range(3), (-1, 1)):
                beside, within = morton_step(nodes, axis, step, self.side >> level)
                bare |= within & ~self.is_full(beside, level)
            kept = nodes[bare]
        mixed = self.codes[self.within(self.codes, box)]
        return np.sort(np.concatenate([mixed, kept]))

    def around(self, codes: np.ndarray, halo: tuple[int, ...]) -> np.ndarray:
        """Return the ascending codes of the tiles up to `halo` tiles along each axis from those of
        the codes."""
        for axis in range(3):
            found = [codes]
            for step in range(1, halo[axis] + 1):
                for moved, within in (
                    morton_step(codes, axis, sign * step, self.side) for sign in (-1, 1)
                ):
                    found.append(moved[within])
            codes = distinct(np.concatenate(found))
        return codes

    def intersection(self, other: Self) -> Self:
        """Return the voxels that are in both sets."""
        codes = distinct(np.concatenate([self.codes, other.codes]))
        full = [
            distinct(
                np.concatenate(
                    [own[other.is_full(own, level)], others[self.is_full(others, level)]]
                )
            )
            for level, (own, others) in enumerate(zip(self.full, other.full, strict=True))
        ]
        bricks = self.bricks_of(codes) & other.bricks_of(codes)
        return type(self)(self.corner, codes, bricks, full).normal()

    def octree(
        self, grid: Grid, low: np.ndarray, units: str = "", transform: tuple[float, ...] = ()
    ) -> Octree:
        """Return the set's part in a grid as an octree, with mode "solid" and fill "none".

        Parameters
        ----------
        grid : Grid
            The grid of the result.
        low : (3,) int
            Where it begins, in voxels counted from this set's grid: multiples of TILE.
        units, transform : str, tuple
            As in Octree.

        Raises
        ------
        MemoryLimitError
            If the leaves, divided because they do not lie at multiples of their side in the grid,
            do not fit in memory.
        """
        first = (self.corner + np.asarray(low)) // TILE
        box = Box(np.asarray(low), np.asarray(low) + grid.side)
        full, split = [], np.empty(0, np.uint64)
        for level in range(len(self.full) - 1, -1, -1):
            check_memory(8 * 24 * len(split), f"leaves of {TILE << level} voxels a side")
            leaves = np.concatenate([self.full[level], descend(split)])
            leaves = leaves[self.within(leaves, box, level)]
            if level and ((first % (1 << level)).any() or TILE << level > grid.side):
                split = leaves
                continue
            full.append(np.sort(morton_encode(morton_decode(leaves) - (first >> level))))
            split = leaves[:0]
        inside = np.flatnonzero(self.within(self.codes, box))
        codes = morton_encode(morton_decode(self.codes[inside]) - first)
        order = np.argsort(codes)
        masks = self.bricks[inside[order]].ravel()
        held = np.flatnonzero(masks)
        bricks = descend(codes[order], LEVEL)[held]
        top = (grid.side // BRICK_SIDE).bit_length() - 1
        none = codes[:0]
        by_level = [none, *full[::-1], *[none] * top][:top]
        arrays = octree_of_bricks(grid.side, bricks, masks[held], by_level, collapse=True)
        return Octree(grid, "solid", "none", *arrays, units=units, transform=transform)
