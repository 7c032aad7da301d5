"""Fractions of voxels of stiff meshes, compared with rational arithmetic."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import oracles, shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.fraction import plan_fractions
from voxtool.svo.layout import BRICK_VOXELS

if TYPE_CHECKING:
    from voxtool.opencl import Device

UNIT = 1 << FIXED_POINT_BITS
SHAPE = (12, 10, 11)
COMPARED = 8, 200  # voxels of a mesh, in the short and in the full self-test
# n parts of triangles D voxels long err by n (2^-41 + 2^-45 D), and float32 by 2^-25: for 16 parts
# of a needle of 4,000 voxels
BOUND = 16 * (2.0**-41 + 2.0**-45 * 4000) + 2.0**-25 + 2.0**-31


def worst(device: Device, vertices: np.ndarray, faces: np.ndarray, scale: float, n: int) -> float:
    """The largest error of n of the cut voxels; vertices are in 1/256 voxel. Infinite if a voxel is
    set that has no part inside, or not set though it has."""
    mesh = mesh_from_arrays(np.asarray(vertices, np.float64) / UNIT * scale, faces)
    grid = Grid(SHAPE, (0.0, 0.0, 0.0), (scale, scale, scale))
    octree = plan_fractions(mesh, grid, fill="parity", device=device).run()
    octree.validate()
    values = octree.values("fraction").of_bricks(slice(None)).astype(np.float64)
    places = octree.levels()[-1].cells[:, None] + BRICK_VOXELS
    held = (places < SHAPE).all(axis=2)
    cells, shares = places[held], values[held]
    order = np.argsort((shares > 0) & (shares < 1), kind="stable")[::-1]
    error = 0.0
    for cell, share in zip(cells[order][:n].tolist(), shares[order][:n].tolist(), strict=True):
        rest = oracles.filled(vertices[faces], cell) % 2
        exact = min(rest, 2 - rest)
        if (share > 0) != (exact >= Fraction(1, 1 << 32)):
            return np.inf
        error = max(error, abs(float(Fraction(share) - exact)))
    return error


@case("fractions of voxels", "needles, slivers, faces on voxel faces, 1e12: rational arithmetic",
      "of a voxel", BOUND)  # fmt: skip
def fractions(device: Device, full: bool) -> float:
    random, errors = np.random.default_rng(8), []
    middle, n = UNIT * np.array(SHAPE) // 2, COMPARED[full]
    for aspect in (1000, 1_000_000):
        way = random.normal(size=3)
        way = np.rint(way / np.abs(way).max() * aspect).astype(np.int64)
        start = middle - way // 3
        corners = start + np.stack([0 * way, np.array([1, 0, 0]), np.array([0, 1, 1]), way])
        errors.append(worst(device, corners, shapes.TETRAHEDRON_FACES, 1.0, n))
    box = shapes.box(UNIT * np.array([2, 3, 1]), UNIT * np.array([7, 7, 7]))
    low = UNIT * np.array([9, 3, 1])
    sliver = shapes.box(low, low + np.array([1, 5 * UNIT, 3]))
    errors.append(worst(device, *shapes.join(box, sliver), 1.0, n))
    ball, faces = shapes.ball(1)
    corners = np.rint((np.asarray(ball, np.float64) * 4.4 + 5.1) * UNIT).astype(np.int64)
    errors.append(worst(device, corners, faces, 1e12, n))
    return max(errors)


CASES = (fractions,)
