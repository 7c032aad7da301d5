"""Set operations on octrees in the largest grid and their comparison, beside sets of Python's
numbers."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import MAX_DIM, OPERATIONS
from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine
from voxtool.svo.sets.compare import compare

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.opencl import Device

FAR = 40_001  # voxels between the origins of two grids: odd, so that no node is another's
SETS = {
    "union": set.__or__,
    "intersection": set.__and__,
    "difference": set.__sub__,
    "xor": set.__xor__,
}


@case("set operations", "a full cube at dim 65,536, corners, grids far apart: sets of numbers",
      "voxels wrong", 0)  # fmt: skip
def operations(device: Device, full: bool) -> int:
    grid = Grid((MAX_DIM, MAX_DIM, MAX_DIM), (0, 0, 0), (1, 1, 1))
    collector = Collector(grid)
    collector.add_cubes(np.zeros((1, 3), np.int64), MAX_DIM)
    whole = collector.octree()
    corners = Octree.from_voxels((MAX_DIM - 1) * np.indices((2, 2, 2)).reshape(3, 8).T, grid)
    without = combine([whole, corners], "difference", device=device)
    without.validate()
    wrong = abs(MAX_DIM**3 - 8 - without.count)
    wrong += _apart(combine([without, whole], "xor", device=device), _voxels(corners, (0, 0, 0)))
    wrong += combine([without, corners], device=device) != whole
    found = compare(corners, without, device=device)
    wrong += found.both.count + (found.first != corners) + (found.second != without)
    rng = np.random.default_rng(7)
    octrees, sets = [], []
    for _ in range(60 if full else 12):
        x, y, z = low = rng.choice((0, FAR), 3).tolist()
        small = Grid((9, 16, 11), (x, y, z), (1, 1, 1))
        octrees.append(Octree.from_voxels(np.argwhere(rng.random(small.shape) < 0.3), small))
        sets.append(_voxels(octrees[-1], low))
    for operation in OPERATIONS:
        found = combine(octrees, operation, device=device)
        wrong += _apart(found, reduce(SETS[operation], sets))
    return int(wrong)


def _voxels(octree: Octree, low: Sequence[int]) -> set[tuple[int, ...]]:
    return {tuple(voxel) for voxel in (octree.occupied() + np.array(low)).tolist()}


def _apart(octree: Octree, expected: set[tuple[int, ...]]) -> int:
    """Return the number of voxels whose state differs from the expected one."""
    return len(_voxels(octree, list(map(int, octree.grid.origin))) ^ expected)
