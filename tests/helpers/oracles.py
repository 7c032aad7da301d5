"""The oracles of voxelization: those of the selftest, and those of octree nodes and fill rules."""

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from voxtool.selftest.oracles import (
    HALF,
    UNIT,
    crossings,
    filled,
    polygons,
    solid,
    surface6,
    surface26,
    to_dense,
    touched,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from voxtool.selftest.oracles import Cell

__all__ = ["filled", "solid", "surface6", "surface26", "to_dense"]
NODE = 8  # voxels along a side of a level 1 node


class OctreeNodes(NamedTuple):
    """Cells of octree nodes by level, counted in nodes: cell (i, j, k) of level L spans the voxels
    [i, i+1) * 4 * 2**L along x, and so on.

    refined : level -> nodes with children, from level 1 to the root's.
    inside : level -> leaves wholly set, from level 1 to the root's.
    """

    refined: dict[int, set[Cell]]
    inside: dict[int, set[Cell]]


def active_nodes(triangles: Iterable, shape: Sequence[int], solid: bool) -> set[Cell]:
    """Level 1 nodes, counted in nodes, whose closed cube of 8 voxels touches a triangle; for a
    solid the cube is half a voxel longer at both ends along x (eq. 3.6)."""
    slabs = []
    for axis, n in enumerate(shape):
        wider = HALF if solid and axis == 0 else 0
        count = -(-n // NODE)
        ends = [(i * NODE * UNIT, (i + 1) * NODE * UNIT) for i in range(count)]
        slabs.append([(low - wider, high + wider) for low, high in ends])
    return {cell for t in polygons(triangles) for cell in touched(t, slabs)}


def expected_octree_nodes(active: set[Cell], voxels: np.ndarray) -> OctreeNodes:
    """The nodes that the contract of the octree asks for.

    active : level 1 nodes that the stages of [voCCeL] make active.
    voxels : bool, indexed [x, y, z], of the grid's shape; beyond it nothing is set.
    """
    side = max(NODE, 1 << (max(voxels.shape) - 1).bit_length())
    top = (side // NODE).bit_length()  # the root's level
    cells = [tuple(map(int, cell)) for cell in np.argwhere(voxels)]
    refined, full = {}, {}
    for level in range(1, top + 1):
        size = 4 << level
        counts = Counter(tuple(i // size for i in cell) for cell in cells)
        mixed = {cell for cell, count in counts.items() if count < size**3}
        full[level] = set(counts) - mixed
        refined[level] = mixed | {tuple(i >> (level - 1) for i in cell) for cell in active}
    inside = {}
    for level in range(1, top + 1):
        nodes = {(0, 0, 0)} if level == top else _children(refined[level + 1])
        inside[level] = (nodes & full[level]) - refined[level]
    return OctreeNodes(refined, inside)


def _children(nodes: set[Cell]) -> set[Cell]:
    corners = list(product((0, 1), repeat=3))
    return {(2 * i + a, 2 * j + b, 2 * k + c) for i, j, k in nodes for a, b, c in corners}


def numbers(triangles: Iterable, shape: Sequence[int]) -> np.ndarray:
    """The number of crossings that enter, by the triangle's side that is seen from -x, less those
    that leave, up to each voxel; indexed [x, y, z]."""
    found = np.zeros(shape, np.int64)
    for j, k, x, way in crossings(triangles, shape):
        for i in range(shape[0]):
            if x < (UNIT * i + HALF, 1, 0, 0):
                found[i, j, k] += way
    return found


def boundary(triangles: np.ndarray) -> list[tuple[tuple, tuple, int]]:
    """The boundary edges of (N, 3, 3) triangles, by positions: (p, q, n) where n triangles more run
    from p to q than from q to p, and n is not 0."""
    net: Counter[tuple] = Counter()
    for triangle in triangles.tolist():
        corners = [tuple(corner) for corner in triangle]
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
            net[min(p, q), max(p, q)] += (p < q) - (p > q)
    return [(p, q, n) for (p, q), n in sorted(net.items()) if n]


def counted(triangles: np.ndarray) -> np.ndarray:
    """The triangles that count where directions do: opposite ones on the same corners cancel, and
    of equal ones that are left the first alone, unless the boundary would be longer."""
    times: Counter[tuple] = Counter()
    for triangle in triangles.tolist():
        corners = [tuple(corner) for corner in triangle]
        first = corners.index(min(corners))
        times[tuple(corners[first:] + corners[:first])] += 1
    net = {(a, b, c): n - times[a, c, b] for (a, b, c), n in list(times.items())}
    once = np.array([t for t, n in net.items() if n > 0]).reshape(-1, 3, 3)
    every = np.array([t for t, n in net.items() for _ in range(n)]).reshape(-1, 3, 3)
    lengths = [sum(abs(n) for *_, n in boundary(some)) for some in (once, every)]
    return once if lengths[0] <= lengths[1] else every


def flood(surface: np.ndarray, gap: int) -> np.ndarray:
    """The voxels that the outside cannot reach through a surface, by paths across faces, edges and
    corners of voxels: it stays ceil(gap / 2) voxels away and then grows by as many."""
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
    """The voxels and the 26 around each."""
    for axis in range(3):
        padded = np.moveaxis(np.pad(dense, [(int(a == axis),) * 2 for a in range(3)]), axis, 0)
        dense = np.moveaxis(padded[:-2] | padded[1:-1] | padded[2:], 0, axis)
    return dense
