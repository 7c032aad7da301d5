"""Shares of faces of voxels against rational arithmetic, formulas and the divergence theorem."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, told
from helpers.fractions import share_by, shares_of
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.files import write_mesh
from voxtool.mesh.topology import volume
from voxtool.selftest.oracles import filled_face
from voxtool.svo.attribution.fraction import plan_fractions, volume_in_units
from voxtool.svo.octree.octree import Octree

SHAPE = (8, 3, 4)
# float32 rounds a number below 1 by 2**-25 at most, after whole numbers of 2**-31; the meshes here
# are small, so that what else a triangle adds is less.
BOUND = 2.0**-25 + 2.0**-31 + 2.0**-32


def grid(shape: tuple[int, int, int] = SHAPE) -> voxtool.Grid:
    return voxtool.Grid(shape, (0, 0, 0), (1, 1, 1))


def dense(octree: Octree) -> np.ndarray:
    return shares_of(octree, "faces")


def check_oracle(octrees: Sequence[Octree], triangles: np.ndarray, turned: bool) -> None:
    """Compare each face of set voxels, of octrees of one request, with rational arithmetic."""
    octree = octrees[0]
    for other in octrees:
        other.validate()
        assert np.array_equal(other.bricks, octree.bricks)
    each = [dense(octree) for octree in octrees]
    for cell in zip(*(axis.tolist() for axis in np.nonzero(octree.to_dense())), strict=True):
        for axis, high in product(range(3), range(2)):
            at = [c + high * (a == axis) for a, c in enumerate(cell)]
            share = share_by(octree.fill, filled_face(triangles, at, axis, turned))
            for number, found in enumerate(each):
                place = (*cell, 2 * axis + high)
                assert abs(found[place] - share) <= BOUND, (number, place)


def check_neighbours(octree: Octree) -> None:
    """Two set voxels have one number for the face between them."""
    found, held = dense(octree), octree.to_dense()
    for axis in range(3):
        own, next_ = (np.moveaxis(found, axis, 0)[part] for part in (np.s_[:-1], np.s_[1:]))
        both = np.moveaxis(held, axis, 0)
        both = both[:-1] & both[1:]
        assert np.array_equal(own[both, 2 * axis + 1], next_[both, 2 * axis])


@settings(max_examples=6)
@given(data=st.data())
def test_every_face_is_that_of_rational_arithmetic(devices, data) -> None:
    vertices, faces = data.draw(meshes.closed_meshes(SHAPE, beyond=2, parts=2))
    fill = data.draw(st.sampled_from(["parity", "nonzero", "winding"]))
    mesh = meshes.mesh_of(vertices / meshes.UNIT, faces)
    octrees = [
        plan_fractions(mesh, grid(), fill=fill, faces=True, device=device).run()
        for device in devices
    ]
    turned = fill != "winding" and volume_in_units(vertices.astype(np.int32), faces) < 0
    check_oracle(octrees, vertices[faces], turned)
    for octree, device in zip(octrees, devices, strict=True):
        check_neighbours(octree)
        plain = plan_fractions(mesh, grid(), fill=fill, device=device).run()
        assert octree.attributes[0] == plain.attributes[0]
        assert np.array_equal(octree.bricks, plain.bricks)


@settings(max_examples=10)
@given(data=st.data())
def test_windows_are_parts_of_the_grid(device, data) -> None:
    """Also along y and z, where parts of the mesh lie before the window."""
    vertices, faces = data.draw(meshes.closed_meshes((16, 8, 8), beyond=4, parts=2))
    low = [data.draw(st.integers(0, n)) for n in (8, 5, 4)]
    mesh = meshes.mesh_of(vertices / meshes.UNIT, faces)
    options = {"fill": "parity", "faces": True, "device": device}
    whole = plan_fractions(mesh, grid((16, 8, 8)), **options).run()
    part = plan_fractions(mesh, grid((16, 8, 8)), window=(low, SHAPE), **options).run()
    x, y, z = (slice(a, a + n) for a, n in zip(low, SHAPE, strict=True))
    assert np.array_equal(part.to_dense(), whole.to_dense()[x, y, z])
    held = part.to_dense()
    assert np.abs(dense(part)[held] - dense(whole)[x, y, z][held]).max(initial=0) <= BOUND


def overlaps(low: float, high: float, n: int) -> np.ndarray:
    """The share of each of n unit intervals that lies within another one."""
    at = np.arange(n)
    return np.clip(np.minimum(at + 1, high) - np.maximum(at, low), 0, 1)


def test_boxes_of_any_offset(device) -> None:
    """Products of overlaps along the axes, in planes strictly within the box: a face that lies in
    the surface is none of it. The box may be inside out."""
    rng, n = np.random.default_rng(3), 16
    for trial in range(12):
        low, high = np.sort(rng.integers(0, n * 256, (2, 3)), axis=0) / 256
        if trial % 2:
            low, high = np.round(low), np.round(high) + 1
        vertices, faces = meshes.box(low, high)
        turned, fill = (faces[:, ::-1], "nonzero") if trial % 3 == 0 else (faces, "winding")
        mesh = meshes.mesh_of(vertices, turned)
        octree = plan_fractions(mesh, grid((n,) * 3), fill=fill, faces=True, device=device).run()
        inside = [overlaps(a, b, n) for a, b in zip(low, high, strict=True)]
        found, held = dense(octree), octree.to_dense()
        assert held.any()
        for axis, side in product(range(3), range(2)):
            at = np.arange(n) + side
            factors = list(inside)
            factors[axis] = ((at > low[axis]) & (at < high[axis])).astype(float)
            expected = np.einsum("i,j,k->ijk", *factors)
            assert np.abs(found[..., 2 * axis + side] - expected)[held].max() <= BOUND
        check_neighbours(octree)


def test_voxels_whose_faces_all_lie_inside_store_none(device) -> None:
    """A box on the sides of voxels stores those at its faces, which are walls, and no fraction."""
    mesh = meshes.mesh_of(*meshes.box(2, 6))
    octree = plan_fractions(mesh, grid((8, 8, 8)), faces=True, device=device).run()
    assert not len(octree.attribute("fraction").values)
    assert len(octree.attribute("faces").values) == 4**3 - 2**3
    found = dense(octree)
    assert found[2, 2, 2].tolist() == [0, 1, 0, 1, 0, 1]
    assert found[5, 3, 3].tolist() == [1, 0, 1, 1, 1, 1]
    assert found[3, 3, 3].tolist() == [1] * 6
    assert not found[1].any()


def test_sections_of_a_ball(device) -> None:
    """Faces in a plane sum up to the section of the ball there."""
    radius, n = 11.3, 26
    mesh = meshes.mesh_of(*meshes.icosphere(5, n / 2 + 0.3, radius))
    octree = plan_fractions(mesh, grid((n,) * 3), faces=True, device=device).run()
    found = dense(octree)
    for axis in range(3):
        sums = found[..., 2 * axis].sum(axis=tuple({0, 1, 2} - {axis}))
        heights = np.arange(n) - (n / 2 + 0.3)
        sections = np.pi * np.maximum(radius**2 - heights**2, 0)
        assert np.abs(sums - sections).max() < 0.004 * np.pi * radius**2


def part_vectors(triangles: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """The area vectors of what triangles have in each voxel, (nx, ny, nz, 3), by clipping in
    float64; no triangle lies in a plane between voxels."""
    found = np.zeros((*shape, 3))
    for triangle in triangles:
        low, high = np.floor(triangle.min(axis=0)), np.ceil(triangle.max(axis=0))
        for cell in product(*(range(int(a), int(b)) for a, b in zip(low, high, strict=True))):
            part = list(triangle)
            for axis, side in product(range(3), (1, -1)):
                part = clipped(part, axis, side, cell[axis] + (side < 0))
            for one, other in pairwise(part[1:]):
                found[cell] += np.cross(one - part[0], other - part[0]) / 2
    return found


def clipped(polygon: list[np.ndarray], axis: int, side: int, bound: int) -> list[np.ndarray]:
    found = []
    for one, other in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = side * (one[axis] - bound), side * (other[axis] - bound)
        found += [one] * int(a >= 0)
        if a * b < 0:
            found.append(one + a / (a - b) * (other - one))
    return found


def test_the_divergence_theorem_holds_in_each_voxel(device) -> None:
    """The faces of what is inside, outward, and the part of the surface there close it."""
    rng, n = np.random.default_rng(6), 20
    for shape in (meshes.icosphere(2, 0.0, 7.4), meshes.torus(), meshes.box(-4, (3, 5, 4.5))):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        q *= np.sign(np.linalg.det(q))
        vertices = shape[0] @ q.T
        vertices *= 8 / np.abs(vertices).max()
        corners = meshes.fixed(vertices + n / 2) / 256
        mesh = meshes.mesh_of(corners, shape[1])
        octree = plan_fractions(mesh, grid((n,) * 3), faces=True, device=device).run()
        found, held = dense(octree), octree.to_dense()
        flux = found[..., 1::2] - found[..., ::2]
        parts = part_vectors(corners[shape[1]], (n, n, n))
        assert np.abs(parts).max() > 0.5
        # each number is rounded to float32
        assert np.abs(flux + parts)[held].max() <= 2 * 2.0**-25 + 2.0**-30


def test_sampling_of_faces(device) -> None:
    """The share of 32 x 32 points of each face that are inside is near the share stored."""
    rng, n, fine = np.random.default_rng(8), 10, 32
    vertices, faces = meshes.torus()
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    vertices = vertices @ (q * np.sign(np.linalg.det(q))).T
    corners = meshes.fixed(vertices * 4 / np.abs(vertices).max() + n / 2) / 256
    mesh = meshes.mesh_of(corners, faces)
    octree = plan_fractions(mesh, grid((n,) * 3), faces=True, device=device).run()
    found, held = dense(octree), octree.to_dense()
    for axis in range(3):
        origin = np.zeros(3)
        origin[axis] = -0.5 / fine  # centres of voxels lie in the planes between coarse ones
        lattice = voxtool.Grid((fine * n,) * 3, tuple(origin), (1 / fine,) * 3)
        points = voxtool.voxelize(mesh, lattice, fill=octree.fill, device=device).to_dense()
        planes = np.moveaxis(points, axis, 0)[::fine]
        shares = planes.reshape(n, n, fine, n, fine).mean(axis=(2, 4))
        shares = np.moveaxis(shares, 0, axis)
        assert ((shares > 0.1) & (shares < 0.9)).sum() > 50
        assert np.abs(found[..., 2 * axis] - shares)[held].max() < 2 / fine


def test_types_are_the_shares_rounded(device) -> None:
    mesh = meshes.mesh_of(*meshes.icosphere(3, 10.0, 7.3))
    made = [
        plan_fractions(mesh, grid((20,) * 3), kind=kind, faces=True, device=device).run()
        for kind in ("f4", "u2", "u1")
    ]
    for octree, most in zip(made[1:], (65535, 255), strict=True):
        assert octree.attribute("faces").default == (most,) * 6
        assert np.abs(dense(octree) - dense(made[0])).max() <= 0.5 / most + 2**-25


def test_needles_that_reach_beyond_the_grid(device) -> None:
    """On the wide path, and before the grid along all axes."""
    far = np.array([[-5, -3000, 1.5], [3.5, 2.5, 3.5], [6000, 3.5, -40], [3.5, 5.5, 4.75]])
    faces = meshes.tetrahedron()[1]
    triangles = meshes.fixed(far)[faces]
    job = plan_fractions(
        meshes.mesh_of(far, faces), grid((9, 7, 6)), fill="parity", faces=True, device=device
    )
    turned = volume_in_units(meshes.fixed(far).astype(np.int32), faces) < 0
    octree = job.run()
    assert octree.count
    check_oracle([octree], triangles, turned)
    assert not job.disagreements


def test_requests(here, device) -> None:
    """The command, its plan, and what does not go together."""
    write_mesh(meshes.mesh_of(*meshes.icosphere(3, 0.0, 1.0)), "ball.ply")
    line = "voxelize ball.ply --dim 24 --mode fraction --face-fractions"
    plan = told(f"{line} --plan --json")
    assert plan["face_fractions"]
    assert "faces of voxels" not in plan["left_out"]
    plain = told("voxelize ball.ply --dim 24 --mode fraction --plan --json")
    assert "faces of voxels" in plain["left_out"]
    assert plan["predicted_device_bytes"] > plain["predicted_device_bytes"]
    assert "of voxels and their faces, of type f4" in run(f"{line} --plan").stdout
    made = told(f"{line} -o a.svo.h5 --json")
    octree = voxtool.read_svo("a.svo.h5")
    assert made["attributes"]["faces"] == octree.attribute("faces").summary()
    mesh_volume = volume(voxtool.load_mesh("ball.ply"))
    assert made["mesh_volume"] == pytest.approx(mesh_volume, rel=1e-13)
    assert made["lattice_volume"] == pytest.approx(mesh_volume, rel=1e-7)
    change = abs(made["lattice_volume"] / made["mesh_volume"] - 1)
    assert f"the mesh's volume by {change:.1e} of it" in run(f"{line} -o a.svo.h5 -v").stderr
    options = {"dim": 24, "mode": "fraction", "face_fractions": True}
    assert octree == voxtool.voxelize("ball.ply", **options, device=device)
    run("svo-info a.svo.h5 --check")
    assert "--face-fractions goes with --mode fraction" in fail(
        "voxelize ball.ply --face-fractions", 2
    )
    with pytest.raises(VoxtoolError, match="face_fractions goes with mode 'fraction'"):
        voxtool.voxelize("ball.ply", face_fractions=True)
