"""Queries of octrees at points, and beside planes between voxels."""

from __future__ import annotations

from fractions import Fraction
from math import floor
from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.queries.query import OctreeQuery

if TYPE_CHECKING:
    from voxtool.opencl import Device

BOARD = 64  # voxels along a side of the checkerboard
ORIGIN, PITCH = (1e5 / 3, -1e-3, 0.1), (0.1, 1e-7 / 3, 3.0)


@case("nearest set voxels", "points around random voxels, in an octree and merged, against all of "
      "them", "points wrong", 0)  # fmt: skip
def nearest(device: Device, full: bool) -> int:
    rng = np.random.default_rng(2)
    grid = Grid((BOARD, BOARD, BOARD), (0, 0, 0), (1, 1, 1))
    voxels = np.unique(rng.integers(0, BOARD, (400, 3)), axis=0)
    octree = Octree.from_voxels(voxels, grid)
    # on a lattice of half voxels squares are exact, and many are equal
    places = rng.integers(-BOARD, 4 * BOARD, (4000 if full else 300, 3)) / 2
    squares = ((places[:, None] - voxels - 0.5) ** 2).sum(axis=2)
    expected = voxels[squares.argmin(axis=1)]
    wrong = 0
    for each in (octree, MergedOctree.of(octree)):
        found = OctreeQuery(each, device=device, nearest=True)(places)
        wrong += int(np.count_nonzero((found.nearest != expected).any(axis=1)))
    return wrong


@case("points in voxels", "points beside the planes of a checkerboard, in an octree and merged, "
      "against rational arithmetic", "points wrong", 0)  # fmt: skip
def points(device: Device, full: bool) -> int:
    board = np.indices((BOARD,) * 3).sum(axis=0) % 2
    octree = Octree.from_dense(board, ORIGIN, PITCH)
    rng = np.random.default_rng(1)
    places = np.array(ORIGIN) + rng.integers(-1, BOARD + 2, (20_000 if full else 500, 3)) * PITCH
    places = np.nextafter(places, rng.choice([-np.inf, np.inf], places.shape))
    expected = [_in_board(place) for place in places.tolist()]
    wrong = 0
    for each in (octree, MergedOctree.of(octree)):
        found = OctreeQuery(each, 0, device)(places)
        wrong += int(np.count_nonzero(found.contains != expected))
        wrong += int(np.count_nonzero(found.coverage != np.where(found.outside, 0, 0.5)))
    return wrong


def _in_board(place: list[float]) -> bool:
    """Return whether a point lies in a set voxel of the board."""
    rows = zip(place, ORIGIN, PITCH, strict=True)
    voxel = [floor((Fraction(p) - Fraction(o)) / Fraction(s)) for p, o, s in rows]
    return min(voxel) >= 0 and max(voxel) < BOARD and sum(voxel) % 2 == 1
