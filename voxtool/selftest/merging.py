"""Merged subtrees of extreme octrees, whose numbers are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import MAX_DIM
from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.svo.dag.merge import Subtrees, join, merge
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.links import level_states
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine

if TYPE_CHECKING:
    from voxtool.opencl import Device

BOARD = 64  # voxels along a side of the checkerboard


@case("merged subtrees", "empty, full, one voxel, a cube at dim 65,536 without corners, a "
      "checkerboard, whole and joined of eight: numbers of subtrees", "trees wrong", 0)  # fmt: skip
def subtrees(device: Device, full: bool) -> int:
    grid = Grid((MAX_DIM, MAX_DIM, MAX_DIM), (0, 0, 0), (1, 1, 1))
    collector = Collector(grid)
    collector.add_cubes(np.zeros((1, 3), np.int64), MAX_DIM)
    whole = collector.octree()
    corners = Octree.from_voxels((MAX_DIM - 1) * np.indices((2, 2, 2)).reshape(3, 8).T, grid)
    below = whole.depth - 1
    expected = [
        (Octree.from_voxels(np.empty((0, 3), int), grid), [0] * (below + 1)),
        (whole, [0] * (below + 1)),
        (Octree.from_voxels([(1, 2, MAX_DIM - 1)], grid), [1] * (below + 1)),
        # at each corner there is another part of a cube, down to the brick
        (combine([whole, corners], "difference", device=device), [1, *[8] * below]),
        (Octree.from_dense(np.indices((BOARD,) * 3).sum(axis=0) % 2), [1, 1, 1, 1, 1]),
    ]
    board = Octree.from_dense(np.indices((BOARD // 2,) * 3).sum(axis=0) % 2)
    joined = join([subtrees_of(board) for _ in range(8)])
    wrong = sum(abs(len(rows) - 1) for rows in joined.rows)
    for octree, sizes in expected:
        merged = MergedOctree.of(octree)
        merged.validate()
        wrong += sum(abs(a - b) for a, b in zip(merged.sizes, sizes, strict=True))
        wrong += merged.digest() != octree.digest()
        wrong += merged.expanded().digest() != octree.digest()
        wrong += merged.count != octree.count
    return wrong


def subtrees_of(octree: Octree) -> Subtrees:
    """Return the distinct subtrees of an octree."""
    return merge(level_states(octree.offsets, octree.nodes), octree.bricks)
