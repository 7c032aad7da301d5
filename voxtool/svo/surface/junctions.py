"""The vertices of a surface between several labels: corners of voxels, or surface nets.

The quadrilaterals are the faces between voxels of different labels. Their corners are the cells of
eight voxels that do not all have one label, and each cell has one vertex: the corner itself, or a
vertex of surface nets, which moves as in dual.py, by the same constants. Where three labels or more
meet, an edge of the net has three or four quadrilaterals: a junction, which passes the side of a
cell. A vertex of two junctions or more begins at the mean of the middles of those sides, not of the
crossings, and moves along the junctions alone. Otherwise the border between two labels would pull a
groove into the surface around both.

All of it is integer arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from voxtool.svo.surface.borders import STEPS, Borders
from voxtool.svo.surface.isosurface import LATTICE, NEAREST
from voxtool.svo.surface.plan import RELAXATIONS

KEY_BITS, KEY = 21, (1 << 21) - 1  # of a coordinate of a corner's key
SLOTS = 12  # edges of a cell, which join the centres of its voxels: 4 along each axis
WAYS = 6  # neighbours of a cell: below and above it along each axis


def _quad_signs() -> np.ndarray:
    """Return on which side of each of its corners a quadrilateral's middle lies, (SLOTS, 3) of -1,
    0 and 1, for the axis that it lies across and the corner's place in it."""
    found = np.zeros((SLOTS, 3), np.int64)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        found[4 * axis : 4 * axis + 4, b] = (1, -1, -1, 1)
        found[4 * axis : 4 * axis + 4, c] = (1, 1, -1, -1)
    return found


class _Tables(NamedTuple):
    """Tables by the set of edges of a cell that are crossed, one bit for each edge."""

    means: np.ndarray  # (4096, 3) int32: where its vertex begins, from the cell's low corner
    ways: np.ndarray  # (4096, WAYS) bool: the neighbours towards which its vertex moves


def _tables() -> _Tables:
    signs = _quad_signs()
    crossed = (np.arange(1 << SLOTS)[:, None] >> np.arange(SLOTS) & 1).astype(np.int64)
    count = np.maximum(crossed.sum(axis=1), 1)[:, None]
    sums = crossed @ ((signs + 1) * (LATTICE // 2))
    faces = [signs[:, way // 2] == (1 if way % 2 else -1) for way in range(WAYS)]
    around = np.stack([crossed[:, face].sum(axis=1) for face in faces], axis=1)
    junctions = around > 2
    passed = junctions.sum(axis=1)[:, None]
    several = passed > 1
    middles = np.full((WAYS, 3), LATTICE // 2)
    middles[np.arange(WAYS), np.arange(WAYS) // 2] = np.arange(WAYS) % 2 * LATTICE
    sums = np.where(several, junctions.astype(np.int64) @ middles, sums)
    count = np.where(several, passed, count)
    means = np.clip((2 * sums + count) // (2 * count), NEAREST, LATTICE - NEAREST)
    return _Tables(means.astype(np.int32), np.where(several, junctions, around > 0))


TABLES = _tables()


class Net(NamedTuple):
    """The cells of a surface, and its quadrilaterals."""

    cells: np.ndarray  # (V, 3) int32: the corners of voxels in the middle of the cells
    quads: np.ndarray  # (F, 4) int32: counter-clockwise seen from above, the lowest first


def net_of(borders: Borders) -> Net:
    """Return the cells and the quadrilaterals of the faces between labels."""
    corners = np.empty((len(borders.keys), 4), np.int64)
    for axis in range(3):
        own = borders.axes == axis
        b, c = STEPS[(axis + 1) % 3], STEPS[(axis + 2) % 3]
        corners[own] = borders.keys[own, None] + np.array([0, b, b + c, c])
    keys, quads = np.unique(corners, return_inverse=True)
    cells = np.stack([keys >> 2 * KEY_BITS, keys >> KEY_BITS & KEY, keys & KEY], axis=1)
    return Net(cells.astype(np.int32), quads.reshape(-1, 4).astype(np.int32))


def corner_points(net: Net) -> np.ndarray:
    """Return the vertices in the middle of the cells, (V, 3) int32 in 1 / LATTICE of a voxel."""
    return net.cells * np.int32(LATTICE)


def relaxed_points(net: Net, axes: np.ndarray, rounds: int = RELAXATIONS) -> np.ndarray:
    """Return the vertices of surface nets, (V, 3) int32 in 1 / LATTICE of a voxel."""
    crossed = _crossed_edges(net, axes)
    ways = TABLES.ways[crossed]
    links = _links(net, axes)
    own = np.arange(len(net.cells), dtype=np.int32)
    bias = np.zeros((len(own), 3), np.int32)  # of neighbours above and below, in cells
    for way in range(WAYS):
        links[way] = np.where(ways[:, way], links[way], own)
        bias[:, way // 2] += np.where(ways[:, way], way % 2 * 2 - 1, 0).astype(np.int32)
    bias *= LATTICE
    twice = 2 * np.maximum(ways.sum(axis=1, dtype=np.int32), 1)[:, None]
    at = TABLES.means[crossed]
    for _ in range(rounds):
        apart = bias - WAYS * at
        for link in links:
            apart += at[link]
        at = np.clip(at + np.sign(apart) * (np.abs(apart) // twice), NEAREST, LATTICE - NEAREST)
    return net.cells * np.int32(LATTICE) + (at - LATTICE // 2)


def _crossed_edges(net: Net, axes: np.ndarray) -> np.ndarray:
    """Return which edges of each cell are crossed, a bit for each of SLOTS, (V,) int16."""
    found = np.zeros(len(net.cells), np.int16)
    for axis in range(3):
        quads = net.quads[axes == axis]
        for place in range(4):  # no cell is twice at one place
            found[quads[:, place]] |= np.int16(1 << (4 * axis + place))
    return found


def _links(net: Net, axes: np.ndarray) -> np.ndarray:
    """Return the neighbours of each cell with which it shares an edge of a quadrilateral,
    (WAYS, V) int32; 0 where there is none."""
    links = np.zeros((WAYS, len(net.cells)), np.int32)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        quads = net.quads[axes == axis].T
        for along, low, high in ((b, 0, 1), (b, 3, 2), (c, 0, 3), (c, 1, 2)):
            links[2 * along + 1][quads[low]] = quads[high]
            links[2 * along][quads[high]] = quads[low]
    return links


def split(quads: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return two triangles for each quadrilateral, (F, 2, 3) int32: along its shorter diagonal, or
    along the other one if a triangle would have no area."""
    corners = [points[quads[:, place]].astype(np.int64) for place in range(4)]
    first = _squared(corners[2] - corners[0]) > _squared(corners[3] - corners[1])
    rolled = [np.where(first[:, None], corners[(i + 1) % 4], corners[i]) for i in range(4)]
    first ^= _flat(*rolled[:3]) | _flat(rolled[0], rolled[2], rolled[3])
    turned = np.where(first[:, None], quads[:, [1, 2, 3, 0]], quads)
    return turned[:, [[0, 1, 2], [0, 2, 3]]]


def _squared(v: np.ndarray) -> np.ndarray:
    x, y, z = v.T
    return x * x + y * y + z * z


def _flat(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return which triangles have no area, (n,) bool."""
    (px, py, pz), (qx, qy, qz) = (b - a).T, (c - a).T
    return (py * qz == pz * qy) & (pz * qx == px * qz) & (px * qy == py * qx)
