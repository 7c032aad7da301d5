"""Fractions against rational arithmetic, exact volumes, and formulas of spheres and boxes."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from helpers import meshes
from helpers.fractions import share_by, shares_of
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.errors import MeshError, VoxtoolError
from voxtool.selftest.oracles import filled
from voxtool.svo.attribution.fraction import (
    LATTICE_BITS,
    LATTICE_VOLUME,
    MESH_VOLUME,
    plan_fractions,
    volume_in_units,
)
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import WHOLE, stored_volume

SHAPE = (8, 3, 4)
# float32 rounds a number below 1 by 2**-25 at most, after whole numbers of 2**-31.
BOUND = Fraction(1, 1 << 25) + Fraction(1, 1 << 31)
TOTALS = {"f4": 1e-6, "u2": 1e-5, "u1": 1e-3}


def dense(octree: Octree) -> np.ndarray:
    return shares_of(octree, "fraction")


def check_oracle(octrees: Sequence[Octree], triangles: np.ndarray) -> None:
    """Compare each voxel of octrees of one request with rational arithmetic; triangles in 1/256
    voxel from the grid."""
    for octree in octrees:
        octree.validate()
    each = [(dense(octree), octree.to_dense()) for octree in octrees]
    for cell in product(*map(range, octrees[0].grid.shape)):
        share = share_by(octrees[0].fill, filled(triangles, cell))
        for number, (found, masks) in enumerate(each):
            told = number, cell, found[cell], float(share)
            assert abs(Fraction(found[cell]) - share) <= BOUND, told
            assert masks[cell] == (share >= Fraction(1, 2 * WHOLE)), told


def grid(shape: tuple[int, int, int] = SHAPE) -> voxtool.Grid:
    return voxtool.Grid(shape, (0, 0, 0), (1, 1, 1))


@settings(max_examples=5)
@given(data=st.data())
def test_every_voxel_is_that_of_rational_arithmetic(devices, data) -> None:
    vertices, faces = data.draw(meshes.closed_meshes(SHAPE, parts=1))
    fill = data.draw(st.sampled_from(["parity", "nonzero", "winding"]))
    mesh = meshes.mesh_of(vertices / meshes.UNIT, faces)
    jobs = [plan_fractions(mesh, grid(), fill=fill, device=device) for device in devices]
    check_oracle([job.run() for job in jobs], vertices[faces])
    assert not any(job.disagreements for job in jobs)


@settings(max_examples=10)
@given(data=st.data())
def test_windows_are_parts_of_the_grid(device, data) -> None:
    vertices, faces = data.draw(meshes.closed_meshes((16, 8, 8), beyond=4, parts=2))
    low = [data.draw(st.integers(0, n)) for n in (8, 5, 4)]
    mesh = meshes.mesh_of(vertices / meshes.UNIT, faces)
    options = {"mode": "fraction", "fill": "parity", "device": device}
    whole = voxtool.voxelize(mesh, grid((16, 8, 8)), **options)
    part = voxtool.voxelize(mesh, grid((16, 8, 8)), window=(low, SHAPE), **options)
    x, y, z = (slice(a, a + n) for a, n in zip(low, SHAPE, strict=True))
    assert np.array_equal(dense(part), dense(whole)[x, y, z])


def test_the_nodes_are_those_of_the_solid(device) -> None:
    mesh = meshes.mesh_of(*meshes.icosphere(3, 20.0, 15.3))
    octree = voxtool.voxelize(mesh, grid((40, 40, 40)), "fraction", device=device)
    solid = voxtool.voxelize(mesh, grid((40, 40, 40)), device=device, with_surface=True)
    assert np.array_equal(octree.nodes, solid.nodes)
    assert not (octree.bricks & ~solid.bricks).any()
    found = octree.attribute("fraction")
    assert found.masks is not None
    assert not (found.masks & ~octree.bricks).any()
    assert ((found.values > 0) & (found.values < 1)).all()
    assert found.default == 1


def rotated(
    box: tuple[np.ndarray, np.ndarray], turns: np.ndarray, move: np.ndarray
) -> voxtool.Mesh:
    q, _ = np.linalg.qr(turns)
    q *= np.sign(np.linalg.det(q))
    return meshes.mesh_of(box[0] @ q.T + move, box[1])


@pytest.mark.parametrize("kind", TOTALS)
def test_sums_are_the_exact_volume(device, kind) -> None:
    rng = np.random.default_rng(5)
    shapes = [meshes.icosphere(3, 0.0, 24.7), meshes.torus(), meshes.box(-9, (11, 20, 17))]
    for shape in shapes:
        mesh = rotated(shape, rng.normal(size=(3, 3)), rng.uniform(-1, 1, 3))
        places = voxtool.Grid.fit(mesh, 61)
        job = voxtool.plan_voxelize(mesh, places, "fraction", fraction_type=kind, device=device)
        octree = job.run()
        bits = octree.plan[LATTICE_BITS]
        fixed = places.to_fixed(mesh.vertices, bits)
        exact = volume_in_units(fixed, mesh.faces) / (6 << 3 * bits)
        assert octree.plan[LATTICE_VOLUME] == exact
        assert octree.plan[MESH_VOLUME] == pytest.approx(exact, rel=1e-6)
        assert stored_volume(octree) == pytest.approx(exact, rel=TOTALS[kind])
        assert octree.attribute("fraction").values.dtype == np.dtype(f"<{kind}")
        assert not job.disagreements


def test_types_are_the_shares_rounded(device) -> None:
    mesh = meshes.mesh_of(*meshes.icosphere(3, 10.0, 7.3))
    octrees = [
        voxtool.voxelize(mesh, grid((20, 20, 20)), "fraction", fraction_type=kind, device=device)
        for kind in TOTALS
    ]
    exact = dense(octrees[0])
    for octree, most in zip(octrees[1:], (65535, 255), strict=True):
        assert np.array_equal(octree.bricks, octrees[0].bricks)
        assert np.abs(dense(octree) - exact).max() <= 0.5 / most + 2**-25


def test_boxes_of_any_offset(device) -> None:
    """A box that is parallel to the axes: products of overlaps along them."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        low, high = np.sort(rng.integers(0, 16 * 256, (2, 3)), axis=0) / 256
        octree = voxtool.voxelize(
            meshes.mesh_of(*meshes.box(low, high)), grid((16, 16, 16)), "fraction",
            device=device, fill="winding",
        )  # fmt: skip
        overlaps = [
            np.clip(np.minimum(np.arange(1, 17), b) - np.maximum(np.arange(16), a), 0, 1)
            for a, b in zip(low, high, strict=True)
        ]
        expected = np.einsum("i,j,k->ijk", *overlaps)
        assert np.abs(dense(octree) - expected).max() <= BOUND
        assert np.array_equal(octree.to_dense(), expected > 0)


def test_two_boxes_that_share_a_face(device) -> None:
    """No volume is lost or doubled, whether the face lies on a voxel's side or in voxels."""
    for at in (8, 7.5, 8 + 1 / 256, 8 + 2**-20):
        parts = [meshes.box(3, (at, 12.25, 11)), meshes.box((at, 3, 3), (13, 12.25, 11))]
        octree = voxtool.voxelize(
            meshes.mesh_of(*meshes.join(*parts)), grid((16, 16, 16)), "fraction",
            device=device, fill="winding",
        )  # fmt: skip
        one = voxtool.voxelize(
            meshes.mesh_of(*meshes.box(3, (13, 12.25, 11))), grid((16, 16, 16)), "fraction",
            device=device,
        )  # fmt: skip
        assert np.array_equal(dense(octree), dense(one)), at
        assert stored_volume(octree) == 10 * 9.25 * 8


def test_touching_is_not_filling(device) -> None:
    """Voxels beside a box whose faces lie on voxel sides are touched, and not set."""
    octree = voxtool.voxelize(
        meshes.mesh_of(*meshes.box(2, 6)), grid((8, 8, 8)), "fraction", device=device
    )
    assert octree.count == 64
    assert not len(octree.attribute("fraction").values)


def test_holes_are_closed_by_caps(device) -> None:
    mesh = meshes.mesh_of(*meshes.open_box((2.5, 2.25, 2), (9.5, 11.125, 12)))
    job = voxtool.plan_voxelize(mesh, grid((14, 14, 14)), "fraction", device=device)
    octree = job.run()
    closed = meshes.mesh_of(*meshes.box((2.5, 2.25, 2), (9.5, 11.125, 12)))
    whole = voxtool.voxelize(closed, grid((14, 14, 14)), "fraction", device=device)
    assert np.array_equal(dense(octree), dense(whole))
    assert octree.fill == "winding"
    assert stored_volume(octree) == 7 * 8.875 * 10
    assert "1 hole closed by 2 cap triangles" in job.notes(octree)[0]


def test_overlaps_and_turned_parts_follow_the_rule(device) -> None:
    one, other = meshes.box(2, (9, 9, 9.5)), meshes.box(6, (13, 13, 13.25))
    turned = (one[0], one[1][:, ::-1])
    volumes = 7 * 7 * 7.5, 7 * 7 * 7.25
    common = 3 * 3 * 3.5
    expected = {
        "parity": sum(volumes) - 2 * common,
        "nonzero": sum(volumes) - common,
        "winding": sum(volumes) - common,
    }
    for fill, volume in expected.items():
        for first in (one, turned) if fill == "parity" else (one,):
            mesh = meshes.mesh_of(*meshes.join(first, other))
            job = plan_fractions(mesh, grid((16, 16, 16)), fill=fill, device=device)
            assert stored_volume(job.run()) == volume
            assert not job.disagreements


def test_faces_that_bound_nothing_are_a_warning(device) -> None:
    mesh = meshes.mesh_of(*meshes.open_box(2.5, 12.5, 0))
    job = plan_fractions(mesh, grid((16, 16, 16)), fill="parity", device=device)
    with pytest.warns(voxtool.MeshWarning) as found:
        job.run()
    assert "do not bound what parity fills" in str(found[-1].message)


def test_refusals(device) -> None:
    mesh = meshes.mesh_of(*meshes.box(2, 6))
    with pytest.raises(MeshError, match="a flood fills whole voxels"):
        voxtool.voxelize(mesh, grid(), "fraction", fill="flood", device=device)
    with pytest.raises(VoxtoolError, match="no surface, gap"):
        voxtool.voxelize(mesh, grid(), "fraction", gap=2, device=device)
    with pytest.raises(VoxtoolError, match="fraction type 'f8' is unknown"):
        voxtool.voxelize(mesh, grid(), "fraction", fraction_type="f8", device=device)
    with pytest.raises(VoxtoolError, match="goes with mode 'fraction'"):
        voxtool.voxelize(mesh, grid(), "solid", fraction_type="u1", device=device)
    with pytest.raises(voxtool.MemoryLimitError, match="dim"):
        voxtool.voxelize(mesh, dim=512, mode="fraction", device=device, max_memory=100_000)


def test_drivers_agree_and_far_large_meshes_keep_their_volume(device) -> None:
    """A needle and a plate that reach far beyond the grid, which take the wide path."""
    needle = np.array([[3.5, 3.25, 3.5], [6000, 3.5, 3.25], [3.5, 3.5, 4.75], [3.25, 5.5, 3.5]])
    mesh = meshes.mesh_of(needle, meshes.tetrahedron()[1])
    triangles = meshes.fixed(needle)[meshes.tetrahedron()[1]]
    if volume_in_units(meshes.fixed(needle), mesh.faces) < 0:
        mesh = meshes.mesh_of(needle, mesh.faces[:, ::-1])
        triangles = triangles[:, ::-1]
    job = plan_fractions(mesh, grid((9, 7, 6)), fill="parity", device=device)
    check_oracle([job.run()], triangles)


def test_fractions_of_deep_grids_are_those_of_shallow_ones(device) -> None:
    """Rows are walked only near the mesh, along all axes; the vertices lie on both lattices."""
    vertices, faces = meshes.tetrahedron((9, 8, 7), (60, 11, 12), (14, 55, 9), (13, 17, 61))
    found = {}
    for dim, corner in ((64, (0, 0, 0)), (65_536, (1024, 65_472, 64)), (4096, (64, 0, 4032))):
        grid = voxtool.Grid((dim,) * 3, tuple(-c for c in corner), (1, 1, 1))
        octree = voxtool.voxelize(
            (vertices, faces), grid, mode="fraction", face_fractions=True, device=device
        )
        values = [octree.attribute(name).values for name in ("fraction", "faces")]
        found[dim] = octree.occupied() - corner, *values
    assert len(found[64][0]) > 10_000
    for dim in (4096, 65_536):
        for own, near in zip(found[dim], found[64], strict=True):
            np.testing.assert_array_equal(own, near)
