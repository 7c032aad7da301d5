"""The leaves of an octree in layers of voxels: slices and comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.memory import check_memory
from voxtool.svo.octree.layout import BRICK_SIDE, unpack_bricks
from voxtool.svo.octree.octree import Octree

OUTSIDE, SET = 0, 1  # a voxel is unset, or SET + the level that holds it


@dataclass(frozen=True)
class Leaves:
    """The nodes of one level that have no children, sorted along their first axis."""

    number: int  # the level
    side: int  # voxels along a side of a node
    corners: np.ndarray  # (N, 3) int32 low corners in voxels, in the order of axes asked for
    inside: np.ndarray  # (N,) bool, False at level 0
    bricks: np.ndarray  # (N,) uint64 at level 0, otherwise empty

    def touching(self, first: int) -> slice:
        """Return the leaves that contain voxel `first` of the first axis."""
        corner = first - first % self.side
        column = self.corners[:, 0]
        return slice(*np.searchsorted(column, [corner, corner + 1]).tolist())


def sorted_leaves(octree: Octree, order: tuple[int, int, int]) -> list[Leaves]:
    """Return the leaves of each level, root first, sorted along axis order[0]."""
    check_memory(64 * len(octree.nodes), "the leaves of the octree")
    found = []
    for level in octree.levels():
        chosen = slice(None) if level.number == 0 else ~level.refined
        corners = level.cells[chosen].astype(np.int32)[:, order]
        by_first = np.argsort(corners[:, 0], kind="stable")
        inside = level.inside[chosen][by_first]
        bricks = octree.bricks[by_first] if level.number == 0 else octree.bricks[:0]
        found.append(Leaves(level.number, level.side, corners[by_first], inside, bricks))
    return found


def paint(
    leaves: list[Leaves], first: int, order: tuple[int, int, int], shape: Sequence[int]
) -> np.ndarray:
    """Return four layers of voxels, (4, a, b) uint8 of OUTSIDE or SET + level, from voxel `first`
    (a multiple of 4) of axis order[0] on; a and b are the other sides of the shape, rounded up."""
    a, b = (-(-shape[axis] // BRICK_SIDE) * BRICK_SIDE for axis in order[1:])
    slab = np.zeros((BRICK_SIDE, a, b), np.uint8)
    for level in leaves:
        here = level.touching(first)
        j, k = level.corners[here, 1:].T // level.side
        m, n = a // level.side, b // level.side  # nodes that lie in the layers
        cells = slab[:, : m * level.side, : n * level.side]
        cells = cells.reshape(BRICK_SIDE, m, level.side, n, level.side).transpose(1, 3, 0, 2, 4)
        if level.number == 0:
            held = (j < m) & (k < n)
            j, k = j[held], k[held]
            voxels = unpack_bricks(level.bricks[here][held])
            cells[j, k] = voxels.transpose(0, *(a + 1 for a in order))  # True is SET
        else:
            chosen = level.inside[here]
            cells[j[chosen], k[chosen]] = SET + level.number
    return slab
