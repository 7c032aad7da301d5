"""Fractions of voxels and of their faces, of stiff meshes, compared with rational arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import FINEST_BITS, Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.mesh.topology import volume
from voxtool.selftest import oracles, shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.fraction import plan_fractions
from voxtool.svo.octree.layout import BRICK_VOXELS

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree

UNIT = 1 << FINEST_BITS  # a voxel: vertices are in units of the finest lattice
SHAPE = (12, 10, 11)
COMPARED = 8, 200  # voxels of a mesh, in the short and in the full self-test
# n parts of triangles D voxels long err by n (2^-41 + 2^-46 D), and float32 by 2^-25: for 16 parts
# of a needle of 4,000 voxels
BOUND = 16 * (2.0**-41 + 2.0**-46 * 4000) + 2.0**-25 + 2.0**-31


def made(
    device: Device, vertices: np.ndarray, faces: np.ndarray, scale: float
) -> tuple[Octree, np.ndarray, np.ndarray, np.ndarray]:
    """Return the octree of a mesh, whose vertices are in 1 / UNIT voxel; the voxels of its bricks,
    their fractions, and the shares of their faces."""
    mesh = mesh_from_arrays(np.asarray(vertices, np.float64) / UNIT * scale, faces)
    grid = Grid(SHAPE, (0.0, 0.0, 0.0), (scale, scale, scale))
    octree = plan_fractions(mesh, grid, fill="parity", faces=True, device=device).run()
    octree.validate()
    values, shares = (octree.values(name).of_bricks(slice(None)) for name in ("fraction", "faces"))
    places = octree.levels()[-1].cells[:, None] + BRICK_VOXELS
    held = (places < SHAPE).all(axis=2)
    return octree, places[held], values[held].astype(np.float64), shares[held].astype(np.float64)


def inside(total: Fraction) -> Fraction:
    """Return the share inside by parity, from the integral of the winding number."""
    return min(total % 2, 2 - total % 2)


def worst(device: Device, vertices: np.ndarray, faces: np.ndarray, scale: float, n: int) -> float:
    """Return the largest error of n of the cut voxels. Infinite if a voxel is set that has no part
    inside, or not set though it has."""
    _, cells, shares, _ = made(device, vertices, faces, scale)
    order = np.argsort((shares > 0) & (shares < 1), kind="stable")[::-1]
    error = 0.0
    for cell, share in zip(cells[order][:n].tolist(), shares[order][:n].tolist(), strict=True):
        exact = inside(oracles.filled(vertices[faces], cell, UNIT))
        if (share > 0) != (exact >= Fraction(1, 1 << 32)):
            return np.inf
        error = max(error, abs(float(Fraction(share) - exact)))
    return error


def worst_face(
    device: Device, vertices: np.ndarray, faces: np.ndarray, scale: float, n: int
) -> float:
    """Return the largest error of the faces of n of the set voxels, cut ones first."""
    _, cells, shares, found = made(device, vertices, faces, scale)
    order = np.argsort((shares > 0) + 0.5 * (found % 1 > 0).any(axis=1), kind="stable")[::-1]
    turned = volume(mesh_from_arrays(vertices.astype(np.float64), faces)) < 0
    error = 0.0
    for at in order[: min(n, int((shares > 0).sum()))].tolist():
        for axis, high in product(range(3), range(2)):
            cell = cells[at].copy()
            cell[axis] += high
            place = cell.tolist(), axis, turned, UNIT
            exact = inside(oracles.filled_face(vertices[faces], *place))
            error = max(error, abs(float(Fraction(found[at, 2 * axis + high]) - exact)))
    return error


@case("fractions of voxels", "needles, plates, faces on voxel faces, 1e12: rational arithmetic",
      "of a voxel", BOUND)  # fmt: skip
def fractions(device: Device, full: bool) -> float:
    return max(worst(device, *mesh, COMPARED[full]) for mesh in stiff_meshes())


@case("faces of voxels", "needles, plates, faces on voxel faces, 1e12: rational arithmetic",
      "of a face", BOUND)  # fmt: skip
def faces(device: Device, full: bool) -> float:
    return max(worst_face(device, *mesh, COMPARED[full]) for mesh in stiff_meshes())


def stiff_meshes() -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Yield vertices in 1 / UNIT voxel, faces, and the size of a voxel."""
    random = np.random.default_rng(8)
    middle, small = UNIT * np.array(SHAPE) // 2, UNIT // 256
    for aspect in (1000, 1_000_000):
        way = random.normal(size=3)
        way = np.rint(way / np.abs(way).max() * aspect).astype(np.int64)
        across = np.stack([0 * way, np.array([1, 0, 0]), np.array([0, 1, 1]), way])
        corners = middle + (across - way // 3) * small
        yield corners, np.asarray(shapes.TETRAHEDRON_FACES), 1.0
    box = shapes.box(UNIT * np.array([2, 3, 1]), UNIT * np.array([7, 7, 7]))
    low = UNIT * np.array([9, 3, 1])
    sliver = shapes.box(low, low + np.array([small, 5 * UNIT, 3 * small]))
    yield *shapes.join(box, sliver), 1.0
    plate, faces = shapes.box(UNIT * np.array([1, 1, 4]), UNIT * np.array([11, 9, 4]) + [0, 0, 70])
    yield plate + random.integers(-20, 21, plate.shape), faces, 1.0
    ball, faces = shapes.ball(1)
    corners = np.rint((np.asarray(ball, np.float64) * 4.4 + 5.1) * UNIT).astype(np.int64)
    yield corners, faces, 1e12


CASES = (fractions, faces)
