"""Fractions of meshes that no lattice holds: against rational arithmetic, of the mesh and of that
on its lattice, volumes of thin plates, and exact sums."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from helpers import meshes
from helpers.fractions import share_by, shares_of

import voxtool
from voxtool.grid import FINEST_BITS, FIXED_POINT_BITS
from voxtool.selftest.oracles import filled, filled_face
from voxtool.svo.attribution.fraction import LATTICE_BITS, plan_fractions, volume_in_units
from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.octree.stored_volume import WHOLE, stored_volume

SHAPE = (8, 3, 4)
FLOAT = 2.0**-25 + 2.0**-31  # rounding to float32, after that to whole numbers of 2**-31
REAL = 1 << 60  # units of a voxel in which the float64 vertices of these tests are whole numbers
UNIT = 1 << FINEST_BITS


def grid(shape: tuple[int, int, int] = SHAPE) -> voxtool.Grid:
    return voxtool.Grid(shape, (0, 0, 0), (1, 1, 1))


def whole_numbers(points: np.ndarray, unit: int) -> np.ndarray:
    """Points in voxels as Python's whole numbers of 1 / unit, ties to even."""
    numbers = [round(Fraction(v) * unit) for v in points.ravel().tolist()]
    return np.array(numbers, object).reshape(points.shape)


def turned(rng: np.random.Generator) -> np.ndarray:
    """A rotation."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def solids(rng: np.random.Generator) -> list[meshes.Mesh]:
    """A tetrahedron, a turned box and a plate of 0.01 voxel, in the grid of SHAPE."""
    middle, found = np.array(SHAPE) / 2, [meshes.tetrahedron(*rng.uniform(0, 1, (4, 3)) * SHAPE)]
    for size in (np.array([2.5, 1.5, 2]), np.array([3, 2, 0.01])):
        corners, faces = meshes.box(-size / 2, size / 2)
        found.append((corners @ turned(rng).T + middle, faces))
    return found


def test_voxels_are_those_of_the_mesh(devices) -> None:
    """Exact for the mesh on its lattice, and as near to the mesh itself as the lattice."""
    rng = np.random.default_rng(0)
    for vertices, faces in solids(rng):
        mesh = meshes.mesh_of(vertices, faces)
        lattice = whole_numbers(vertices, UNIT)[faces]
        real = whole_numbers(vertices, REAL)[faces]
        found = [plan_fractions(mesh, grid(), fill="parity", device=one).run() for one in devices]
        each = [(shares_of(octree, "fraction"), octree.to_dense()) for octree in found]
        cut = np.argwhere((each[0][0] > 0) & (each[0][0] < 1))
        for cell in map(
            tuple, [*rng.choice(cut, 9).tolist(), *rng.integers(SHAPE, size=(5, 3)).tolist()]
        ):
            share = share_by("parity", filled(lattice, cell, UNIT))
            true = share_by("parity", filled(real, cell, REAL))
            assert abs(share - true) <= 8 / UNIT
            for shares, masks in each:
                assert abs(float(Fraction(shares[cell]) - share)) <= FLOAT
                assert masks[cell] == (share >= Fraction(1, 2 * WHOLE))


def test_faces_are_those_of_the_mesh_on_its_lattice(device) -> None:
    rng = np.random.default_rng(7)
    for vertices, faces in solids(rng):
        mesh, lattice = meshes.mesh_of(vertices, faces), whole_numbers(vertices, UNIT)[faces]
        octree = plan_fractions(mesh, grid(), fill="parity", faces=True, device=device).run()
        found = shares_of(octree, "faces")
        for cell in rng.choice(np.argwhere(octree.to_dense()), 8).tolist():
            for axis, high in product(range(3), range(2)):
                at = [c + high * (a == axis) for a, c in enumerate(cell)]
                share = share_by("parity", filled_face(lattice, at, axis, unit=UNIT))
                assert abs(found[(*cell, 2 * axis + high)] - float(share)) <= FLOAT


def test_large_triangles_that_are_nearly_parallel_to_sides(device) -> None:
    """Plates of some hundred voxels that leave a plane between voxels by a few units: clipping of
    rounded corners would find them on its wrong side."""
    rng, n = np.random.default_rng(11), 250
    for axis in range(3):
        corners, faces = meshes.box([3, 3, 0], [n - 3, n - 3, 2])
        vertices = corners * UNIT + rng.integers(-7, 8, corners.shape)
        vertices[:, 2] += UNIT  # its faces are at about 1 and 3
        vertices = vertices[:, np.roll([0, 1, 2], axis)]
        shape = tuple(np.roll([n, n, 5], axis).tolist())
        mesh = meshes.mesh_of(vertices / UNIT, faces)
        job = plan_fractions(mesh, grid(shape), fill="winding", faces=True, device=device)
        octree = job.run()
        assert not job.disagreements
        for cell, found, own in shares_of_some(octree, rng, 4):
            share = share_by("winding", filled(vertices[faces], cell, UNIT))
            assert abs(found - float(share)) <= FLOAT + 2.0**-38
            for one, high in product(range(3), range(2)):
                at = [c + high * (a == one) for a, c in enumerate(cell)]
                share = share_by("winding", filled_face(vertices[faces], at, one, unit=UNIT))
                assert abs(own[2 * one + high] - float(share)) <= FLOAT + 2.0**-38


def shares_of_some(octree: voxtool.Octree, rng: np.random.Generator, n: int) -> Iterator[tuple]:
    """Yield cut voxels of n bricks, with their fractions and the shares of their faces."""
    cells = octree.levels()[-1].cells
    values = [octree.values(name) for name in ("fraction", "faces")]
    for at in rng.choice(np.flatnonzero(octree.attribute("fraction").masks), n).tolist():
        (own,), (faces,) = (value.of_bricks(slice(at, at + 1)) for value in values)
        bit = int(rng.choice(np.flatnonzero((own > 0) & (own < 1))))
        yield (cells[at] + BRICK_VOXELS[bit]).tolist(), float(own[bit]), faces[bit]


@pytest.mark.parametrize("thickness", [0.1, 0.01, 0.001, 1e-5])
def test_thin_plates_keep_their_volume(device, thickness: float) -> None:
    """At odd angles, of any thickness: within what rounding moves their faces."""
    rng, n = np.random.default_rng(2), 40
    for trial in range(3):
        size = np.array([18, 13, thickness])
        corners, faces = meshes.box(-size / 2, size / 2)
        mesh = meshes.mesh_of(corners @ turned(rng).T + n / 2 + rng.uniform(-1, 1, 3), faces)
        octree = plan_fractions(mesh, grid((n,) * 3), device=device).run()
        error = abs(stored_volume(octree) / size.prod() - 1)
        assert error <= 3**0.5 / UNIT / thickness, trial
        assert octree.plan["mesh_volume_voxels"] == pytest.approx(size.prod(), rel=1e-8)


def test_fractions_add_up_to_the_volume_on_the_lattice(device) -> None:
    """To the rounding of each cut voxel's share to 2**-31."""
    rng = np.random.default_rng(4)
    for vertices, faces in (meshes.icosphere(3, 0.0, 17.3), meshes.torus(0.0, 11, 6.1)):
        mesh = meshes.mesh_of(vertices @ turned(rng).T + 21.234, faces)
        job = plan_fractions(mesh, grid((43,) * 3), device=device)
        solid, found = job.shares()
        own = found.voxels[(found.voxels > 0) & (found.voxels < WHOLE)]
        whole = solid.count  # the solid's voxels that are touched give way to what their share says
        masks = np.bitwise_count(solid.bricks & found.touched).sum(dtype=np.int64)
        whole += int(np.count_nonzero(found.voxels == WHOLE)) - int(masks)
        bits = job.plan.solid.bits
        fixed = job.grid.to_fixed(mesh.vertices, bits)
        volume = Fraction(volume_in_units(fixed, mesh.faces), 6 << 3 * bits)
        error = abs(Fraction(int(own.sum(dtype=np.int64)), WHOLE) + whole - volume)
        assert error <= Fraction(len(own), 2 * WHOLE)
        assert float(error) < 8 * len(own) ** 0.5 / WHOLE  # roundings are independent


def test_a_mesh_on_the_coarse_lattice_has_the_same_fractions_on_both(device) -> None:
    """By 64-bit integers, as where a mesh reaches millions of voxels, and by 128-bit ones."""
    vertices, faces = meshes.icosphere(2, 8.1, 7.3)
    mesh = meshes.mesh_of(meshes.fixed(vertices) / 256, faces)
    options = {"fill": "parity", "faces": True, "device": device}
    coarse = plan_fractions(mesh, grid((16, 16, 16)), bits=FIXED_POINT_BITS, **options)
    fine = plan_fractions(mesh, grid((16, 16, 16)), **options)
    assert (coarse.plan.solid.wide, fine.plan.solid.wide) == (False, True)
    assert coarse.run().digest() == fine.run().digest()


def test_the_lattice_of_a_plan(device) -> None:
    mesh = meshes.mesh_of(*meshes.box(1.0, 7))
    for dim, bits in ((8, 20), (512, 20), (513, 19), (1024, 19), (4096, 17), (65536, 13)):
        assert grid((dim, 8, 8)).finest_bits(mesh.bounds) == bits
    for reach, bits in ((512, 20), (513, 19), (1e5, 12), (3e6, FIXED_POINT_BITS), (1e300, 8)):
        assert grid((8, 8, 8)).finest_bits(np.array([[0.0, 0, -reach]])) == bits
    job = plan_fractions(mesh, grid((8, 8, 8)), device=device)
    assert job.plan.as_dict()[LATTICE_BITS] == job.run().plan[LATTICE_BITS] == 20
    assert ("lattice", "vertices are rounded to 2^-20 of a voxel") in job.plan.rows()
    assert plan_fractions(mesh, grid((600, 8, 8)), device=device).plan.solid.bits == 19
