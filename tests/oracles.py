"""The oracles of voxelization: those that the selftest has, too, and those of the fill rules."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from voxtool.selftest.oracles import (
    HALF,
    UNIT,
    OctreeNodes,
    active_nodes,
    crossings,
    expected_octree_nodes,
    solid,
    surface6,
    surface26,
    to_dense,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = [
    "OctreeNodes",
    "active_nodes",
    "boundary",
    "expected_octree_nodes",
    "flood",
    "numbers",
    "solid",
    "surface6",
    "surface26",
    "to_dense",
]


def numbers(triangles: Iterable, shape: Sequence[int]) -> np.ndarray:
    """Of each voxel, indexed [x, y, z], how many of these crossings enter, by the triangle's side
    that is seen from -x, less those that leave."""
    found = np.zeros(shape, np.int64)
    for j, k, x, way in crossings(triangles, shape):
        for i in range(shape[0]):
            if x < (UNIT * i + HALF, 1, 0, 0):
                found[i, j, k] += way
    return found


def boundary(triangles: np.ndarray) -> list[tuple[tuple, tuple, int]]:
    """The edges of (N, 3, 3) triangles, by positions, with the number of times that they run from
    one end to the other less that of the way back, where that is not 0."""
    net: Counter[tuple] = Counter()
    for triangle in triangles.tolist():
        corners = [tuple(corner) for corner in triangle]
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
            net[min(p, q), max(p, q)] += (p < q) - (p > q)
    return [(p, q, n) for (p, q), n in sorted(net.items()) if n]


def flood(surface: np.ndarray, gap: int) -> np.ndarray:
    """What the outside cannot reach through a surface, by paths between voxels that share a corner:
    it stays ceil(gap / 2) voxels away and then grows by as many."""
    steps = -(-gap // 2)
    pad = 2 * steps + 2
    barrier = np.pad(surface, pad)
    for _ in range(steps):
        barrier = _grown(barrier)
    outside = np.zeros_like(barrier)
    outside[0, 0, 0] = True
    while not np.array_equal(outside, grown := outside | (_grown(outside) & ~barrier)):
        outside = grown
    for _ in range(steps):
        outside |= _grown(outside) & barrier
    inside = ~outside
    return inside[pad:-pad, pad:-pad, pad:-pad]


def _grown(dense: np.ndarray) -> np.ndarray:
    """With the 26 voxels around each."""
    for axis in range(3):
        padded = np.moveaxis(np.pad(dense, [(int(a == axis),) * 2 for a in range(3)]), axis, 0)
        dense = np.moveaxis(padded[:-2] | padded[1:-1] | padded[2:], 0, axis)
    return dense
