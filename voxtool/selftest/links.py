"""Links of lattices that cross the wall, compared with rational arithmetic."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import LATTICES
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.solvers.wall_links import CROSSED, STEPS, WallLinks, plan_wall_links
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

UNIT = 1 << FIXED_POINT_BITS
SOME = 7  # one of this many links is compared


@case(
    "links to walls",
    "octahedra: rational arithmetic",
    "of a link",
    2**-24,
)
def links(device: Device, full: bool) -> float:
    """Each link that there is, by the set of voxels, and where some of them enter the solid."""
    worst, size = 0.0, 24 if full else 12
    grid = Grid((size, size, size), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    for shift in (0, 37):
        centre = np.array([UNIT * size // 2 + UNIT // 2 + shift] * 3)
        radius = UNIT * (size // 2 - 2)
        vertices, faces = shapes.octahedron(centre, radius)
        mesh = mesh_from_arrays(np.asarray(vertices, float) / UNIT, faces)
        octree = voxelize(mesh, grid, fill="parity", device=device)
        for lattice, wide in product(LATTICES, (False, True)):
            job = plan_wall_links(octree, mesh, lattice, device=device)
            found = job.with_(wide=wide).run()
            if found.count != expected_count(octree.to_dense(), LATTICES[lattice]):
                return np.inf
            worst = max(worst, worst_place(found, centre, radius))
    return worst


def expected_count(dense: np.ndarray, count: int) -> int:
    """Return the number of links from unset to set voxels."""
    padded = np.pad(dense, 1)
    found = 0
    for step in STEPS[1:count].astype(int):
        ends = tuple(slice(1 + s, 1 + s + n) for s, n in zip(step, dense.shape, strict=True))
        found += int(np.count_nonzero(padded[ends] & ~dense))
    return found


def worst_place(found: WallLinks, centre: np.ndarray, radius: int) -> float:
    """Return the largest error of some places, infinite if one is not there."""
    worst = 0.0
    for row, link in np.argwhere(found.flags)[::SOME].tolist():
        start = UNIT * found.voxels[row].astype(int) + UNIT // 2 - centre
        step = UNIT * STEPS[link].astype(int)
        place = Fraction(0)
        for signs in product((-1, 1), repeat=3):  # a face: signs . x <= radius
            height, slope = radius - int(np.dot(signs, start)), int(np.dot(signs, step))
            if height < 0 and slope:
                place = max(place, Fraction(height, slope))
        if found.flags[row, link] != CROSSED:
            return np.inf
        worst = max(worst, abs(float(place) - float(found.places[row, link])))
    return worst


CASES = (links,)
