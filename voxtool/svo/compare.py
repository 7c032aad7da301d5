"""Differences between two octrees of one grid, and rows of voxels filled beyond the mesh."""

from __future__ import annotations

import numpy as np

from voxtool.errors import GridError
from voxtool.memory import check_memory
from voxtool.svo.layers import OUTSIDE, paint, sorted_leaves
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree
from voxtool.svo.placing import EMPTY, FULL, first_children, masks_of


def count_differences(one: Octree, other: Octree) -> tuple[int, int]:
    """Return how many voxels are set only in the first octree, and only in the second.

    The octrees are traversed together, root first; a leaf of one octree is paired with all
    descendants of the other octree's node.
    """
    if one.grid != other.grid:
        raise GridError(
            "octrees of different grids cannot be compared: voxelize both on one grid, with --like"
        )
    first = second = 0
    nodes = np.zeros(1, np.int64), np.zeros(1, np.int64)
    for d in range(one.depth - 1):
        a, b = (
            first_children(octree.child_words(d), node)
            for octree, node in zip((one, other), nodes, strict=True)
        )
        leaves = (a < 0) & (b < 0)
        volume = (BRICK_SIDE << (one.depth - 1 - d)) ** 3
        first += volume * int(np.count_nonzero(leaves & (a == FULL) & (b == EMPTY)))
        second += volume * int(np.count_nonzero(leaves & (a == EMPTY) & (b == FULL)))
        nodes = tuple(
            np.where(child < 0, child, child + np.arange(8)[:, None])[:, ~leaves].T.ravel()
            for child in (a, b)
        )
    a, b = (masks_of(octree.bricks, node) for octree, node in zip((one, other), nodes, strict=True))
    first += int(np.bitwise_count(a & ~b).sum(dtype=np.int64))
    second += int(np.bitwise_count(b & ~a).sum(dtype=np.int64))
    return first, second


def leaking_rows(octree: Octree) -> np.ndarray:
    """Return the rows along x whose last voxel is set, (n, 2) int64 y, z in ascending order.

    If the mesh ends before that voxel, the rows cross it an odd number of times, and the parity
    rule fills them beyond the mesh.
    """
    nx, ny, nz = octree.grid.shape
    check_memory(2 * BRICK_SIDE * (ny + 3) * (nz + 3), "the last four layers of voxels")
    first = (nx - 1) // BRICK_SIDE * BRICK_SIDE
    slab = paint(sorted_leaves(octree, (0, 1, 2)), first, (0, 1, 2), octree.grid.shape)
    return np.argwhere(slab[nx - 1 - first, :ny, :nz] != OUTSIDE)
