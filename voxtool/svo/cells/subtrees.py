"""The cells of an octree: cubes that divide its grid, each read as a subtree with what lies around
it. The octree may be in memory, in a file, or merged."""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from voxtool.arrays import Slices
from voxtool.errors import MemoryLimitError, human
from voxtool.grid import Grid
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK_SIDE, LINK, NODE_BYTES, descend
from voxtool.svo.octree.links import EMPTY, FULL, REFINED, states_of
from voxtool.svo.octree.octree import Octree

GAP = 4096  # items between two groups that are read at once
EIGHT = np.arange(8)
AROUND = 4  # cells along a side of the cube around a cell, which is its second along each axis


class Cut(NamedTuple):
    """An octree that is cut out of another one, and where that has its leaves and bricks."""

    octree: Octree
    inside: np.ndarray  # (L,) int64 indices of the nodes of its inside leaves, in its order
    bricks: np.ndarray  # (n,) int64 indices of the first bricks of its groups of eight


class Cells:
    """The cells of an octree.

    Attributes
    ----------
    octree : OctreeContent
        The octree.
    side : int
        Voxels along a side of a cell: a power of two from 8 up to the octree's side.
    along : int
        Cells along a side of the octree.
    states, links : (along**3,) uint8, uint32
        The states of the cells' nodes in Morton order, and of the refined ones the first children,
        or in a merged octree the subtree; a cell in a leaf has the state of the leaf.
    """

    def __init__(self, octree: OctreeContent, side: int) -> None:
        self.octree, self.side = octree, side
        self.along = octree.grid.side // side
        self.level = (side // BRICK_SIDE).bit_length() - 1
        states, links = self._root()
        for d in range(1, octree.depth - self.level):
            refined = np.flatnonzero(states == REFINED)
            found = self._children(d, links[refined])
            below = (8 * refined[:, None] + EIGHT).ravel()
            states, links = np.repeat(states, 8), np.zeros(8 * len(states), np.uint32)
            states[below], links[below] = found
        self.states, self.links = states, links

    @property
    def refined(self) -> int:
        """Number of cells that have nodes of their own below them."""
        return int(np.count_nonzero(self.states == REFINED))

    def _root(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the state and the link of the root, (1,) each."""
        if isinstance(self.octree, MergedOctree):
            return np.full(1, self.octree.root, np.uint8), np.zeros(1, np.uint32)
        word = self.octree.nodes[0:1]["child"]
        return states_of(word), word & LINK

    def _children(self, d: int, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states and the links of the groups of eight nodes, d levels below the root, to
        which links lead."""
        octree = self.octree
        if isinstance(octree, MergedOctree):
            return octree.children_of(d - 1, links)
        words = groups_of(octree.nodes, octree.offsets[d] + links.astype(np.int64))["child"]
        return states_of(words), words & LINK

    def _bricks(self, links: np.ndarray) -> np.ndarray:
        """Return the groups of eight bricks to which links lead."""
        if isinstance(self.octree, MergedOctree):
            return self.octree.bricks_of(links)
        return groups_of(self.octree.bricks, links.astype(np.int64))

    def states_of(self, first: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Return the states of the cells of a box, from one cell to another one."""
        steps = np.indices(tuple(last - first + 1)).reshape(3, -1).T
        return self.states[morton_encode(first + steps).astype(np.int64)]

    def mixed(self) -> np.ndarray:
        """Return the cells that have a refined cell around them, or full and empty ones, (n, 3)
        int64 coordinates, in Morton order; also those beyond the low sides, whose coordinates are
        -1."""
        padded = np.full((self.along + 3,) * 3, EMPTY, np.uint8)
        x, y, z = morton_decode(np.arange(len(self.states), dtype=np.uint64)).T + 2
        padded[x, y, z] = self.states
        size = self.along + 1  # the cells from -1 on, whose neighbours begin at -2
        parts = [
            padded[i : i + size, j : j + size, k : k + size]
            for i, j, k in product(range(3), repeat=3)
        ]
        least, most = np.minimum.reduce(parts), np.maximum.reduce(parts)
        cells = np.argwhere((least != most) | (most == REFINED)) - 1
        return cells[np.argsort(self.keys(cells))]

    def keys(self, cells: np.ndarray) -> np.ndarray:
        """Return the (n,) uint64 Morton codes of cells in a cube that holds -1 too."""
        return morton_encode(cells + self.along)

    def around(self, cell: np.ndarray, margin: int) -> Octree:
        """Return the octree of the cube around a cell: AROUND cells a side, of which it is the
        second along each axis. Refined nodes that are not within `margin` voxels of the cell are
        empty in it."""
        return self.cut(cell - 1, AROUND, self.side - margin, 2 * self.side + margin)

    def cut(
        self,
        corner: np.ndarray,
        along: int,
        low: int | np.ndarray,
        high: int | np.ndarray,
        most: float = math.inf,
    ) -> Octree:
        """Return the octree of a cube of `along` cells a side from cell `corner` on. Refined nodes
        that do not reach its voxels from `low` to `high` are empty in it, as is what lies beyond
        the octree. MemoryLimitError if it takes more than `most` bytes."""
        levels, links = self._cut(corner, along, low, high, most)
        return self._octree(along, levels, links[-1])

    def cut_of_whole(self, low: np.ndarray, high: np.ndarray, most: float = math.inf) -> Cut:
        """Return the cut of the whole octree, which is one cell and not merged, with the places
        of its parts."""
        levels, links = self._cut(np.zeros(3, np.int64), 1, low, high, most)
        places = [np.zeros(1, np.int64)]
        for start, own in zip(self.octree.offsets[1:].astype(np.int64), links[:-1], strict=False):
            places.append((start + own[:, None] + EIGHT).ravel())
        inside = [own[states == FULL] for own, states in zip(places, levels, strict=True)]
        bricks = links[-1].astype(np.int64)
        return Cut(self._octree(1, levels, links[-1]), np.concatenate(inside), bricks)

    def _octree(self, along: int, levels: list[np.ndarray], links: np.ndarray) -> Octree:
        """Return the octree of nodes with these states, given the links to its bricks."""
        octree, grid = self.octree, cube(along * self.side)
        return Octree.of_states(grid, octree.mode, octree.fill, levels, self._bricks(links))

    def _cut(
        self,
        corner: np.ndarray,
        along: int,
        low: int | np.ndarray,
        high: int | np.ndarray,
        most: float,
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the states of the nodes of `cut`, by level from the root down, and of each level
        from that of cells down the links of its refined nodes."""
        cells = corner + morton_decode(np.arange(along**3, dtype=np.uint64))
        held = ((cells >= 0) & (cells < self.along)).all(axis=1)
        places = morton_encode(cells[held]).astype(np.int64)
        states, links = np.full(len(cells), EMPTY, np.uint8), np.zeros(len(cells), np.uint32)
        states[held], links[held] = self.states[places], self.links[places]
        levels = [np.full(8**d, REFINED, np.uint8) for d in range(along.bit_length() - 1)]
        followed = []
        codes, size = np.arange(len(cells), dtype=np.uint64), 0
        for number in range(self.level, 0, -1):
            side = BRICK_SIDE << number
            place = morton_decode(codes) * side
            near = (place + side > low) & (place < high)
            states[(states == REFINED) & ~near.all(axis=1)] = EMPTY
            levels.append(states)
            refined = np.flatnonzero(states == REFINED)
            size += NODE_BYTES * 8 * len(refined)
            if size > most:
                raise MemoryLimitError(
                    f"a part of an octree takes more than {human(int(most))} (see --max-memory)"
                )
            codes, links = descend(codes[refined]), links[refined]
            followed.append(links)
            if number > 1:
                states, links = self._children(self.octree.depth - number, links)
        return levels, followed


def cube(side: int) -> Grid:
    """Return the grid of a cube by itself, whose voxels have side 1."""
    return Grid((side, side, side), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def groups_of(array: np.ndarray | Slices, starts: np.ndarray) -> np.ndarray:
    """Return the groups of eight items of an array that begin at (n,) places, one after the
    other. Groups that lie near each other are read at once."""
    if not len(starts):
        return array[0:0]
    steps = np.diff(starts)
    parts = []
    for run in np.split(starts, np.flatnonzero((steps < 0) | (steps > GAP)) + 1):
        read = array[int(run[0]) : int(run[-1]) + 8]
        parts.append(read[((run - run[0])[:, None] + EIGHT).ravel()])
    return np.concatenate(parts)
