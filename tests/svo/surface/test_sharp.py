"""Sharp surfaces: crossings of links against the octree's voxels, features against the model's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.cli import fail, run, write_obj
from helpers.octree import octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st
from svo.voxelization.test_voxelize import lattice_grid, lattice_mesh

import voxtool
from voxtool.errors import MeshError, VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.surface.isosurface import LATTICE, NEAREST, Isosurface
from voxtool.svo.surface.sharp import REACH, find_crossings
from voxtool.svo.surface.sharp_edges import SPACING
from voxtool.svo.surface.untangle import untangle, wrong_faces

SHAPES = st.sampled_from([(16, 16, 16), (9, 17, 12)])
SHARP_EDGE = np.cos(np.radians(30))


def sharp(device: Device, mesh: Mesh, dim: int) -> tuple[Isosurface, float]:
    """The sharp surface of a mesh, checked, and its pitch."""
    octree = voxtool.voxelize(mesh, dim=dim, device=device)
    surface = extract(octree, style="sharp", source=mesh, device=device)
    found = surface.check()
    assert found["closed"]
    assert found["degenerate_faces"] == 0
    assert found["self_intersecting_faces"] == found["undecided_faces"] == 0
    assert not wrong_faces(surface, device).any()
    return surface, octree.grid.pitch[0]


def creases(mesh: Mesh) -> np.ndarray:
    """(n, 2, 3) ends of the edges between faces whose normals are more than 30 degrees apart."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    _, name = np.unique(mesh.vertices, axis=0, return_inverse=True)
    edges = np.sort(name.reshape(-1)[mesh.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    pairs = order.reshape(-1, 2)  # of a closed mesh, whose edges have two faces
    assert (edges[pairs[:, 0]] == edges[pairs[:, 1]]).all()
    apart = (normals[pairs[:, 0] // 3] * normals[pairs[:, 1] // 3]).sum(axis=1)
    chosen = pairs[apart < SHARP_EDGE, 0]
    return np.stack([corners[chosen // 3, chosen % 3], corners[chosen // 3, (chosen + 1) % 3]], 1)


def along(ends: np.ndarray, n: int) -> np.ndarray:
    """Points along edges, spread by length."""
    rng = np.random.default_rng(1)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    edge, t = rng.choice(len(ends), n, p=lengths / lengths.sum()), rng.random((n, 1))
    return ends[edge, 0] * (1 - t) + ends[edge, 1] * t


def distances(device: Device, mesh: Mesh, points: np.ndarray) -> np.ndarray:
    return np.abs(voxtool.distance(mesh, points, fill="none", device=device))


def plate(holes: int = 32) -> Mesh:
    """A plate minus a round bar through it, in closed form: top and bottom rings between a square
    and a circle, the square's sides and the hole's."""
    turns = np.arange(holes) * (2 * np.pi / holes) + np.pi / 4
    circle = 0.5 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    square = circle / np.abs(circle).max(axis=1, keepdims=True)
    rings = [np.c_[ring, np.full(holes, z)] for z in (-0.3, 0.3) for ring in (square, circle)]
    a, b = np.arange(holes), (np.arange(holes) + 1) % holes

    def strip(first: int, second: int) -> np.ndarray:
        p, q = first * holes, second * holes
        return np.concatenate([np.c_[p + a, p + b, q + a], np.c_[p + b, q + b, q + a]])

    faces = np.concatenate([strip(2, 3), strip(1, 0), strip(0, 2), strip(3, 1)])
    return meshes.mesh_of(np.concatenate(rings), faces)


def turned(mesh: Mesh, seed: int) -> Mesh:
    """The mesh in a random rotation, moved by a random share of a voxel."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    return replace(mesh, vertices=mesh.vertices @ q.T + rng.uniform(0, 0.03, 3))


# ---- crossings


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=12)
def test_links_are_crossed_an_odd_number_of_times_where_voxels_differ(
    device: Device, data: st.DataObject, shape: tuple[int, int, int]
) -> None:
    """Along every axis, with ties: parity along x decides the voxels, y and z must agree. Links
    beyond the grid are left out: meshes that leave it go on there."""
    drawn = data.draw(meshes.closed_meshes(shape))
    mesh, grid = lattice_mesh(*drawn), lattice_grid(shape)
    dense = voxtool.voxelize(mesh, grid, fill="parity", device=device).to_dense()
    found = find_crossings(device, mesh, grid)
    for axis, name in enumerate("xyz"):
        nx, ny, nz = (shape[(axis + i) % 3] for i in range(3))
        keys = found[f"keys_{name}"].get()[: found["counts"][axis]]
        assert (np.diff(keys.astype(np.int64)) >= 0).all()
        bits = found["key_bits"][axis]
        row, place = (keys >> bits).astype(int), (keys >> 2 & ((1 << bits - 2) - 1)).astype(int) - 1
        counts = np.zeros((nz * ny, nx + 2), int)
        np.add.at(counts, (row, place + 1), 1)
        voxels = np.transpose(dense, [(axis + 2) % 3, (axis + 1) % 3, axis]).reshape(nz * ny, nx)
        assert np.array_equal(counts[:, 2:-1] % 2 == 1, voxels[:, 1:] != voxels[:, :-1])
    surface = extract(
        voxtool.voxelize(mesh, grid, fill="parity", device=device),
        style="sharp", source=mesh, device=device,
    )  # fmt: skip
    if len(surface.faces):
        assert surface.check()["closed"]


# ---- features


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["cube", "plate minus bar"])
def test_edges_of_turned_solids_stay(device: Device, kind: str, seed: int) -> None:
    solid = meshes.mesh_of(*meshes.box((-1, -1, -1), (1, 1, 1))) if kind == "cube" else plate()
    mesh = turned(solid, seed)
    surface, pitch = sharp(device, mesh, 48)
    assert surface.features is not None
    assert surface.features.open == 0
    assert_features_kept(device, mesh, surface, pitch)


def assert_features_kept(device: Device, mesh: Mesh, surface: Isosurface, pitch: float) -> None:
    """In voxels, median 0.02 and at most half of one, though corners and edges pass cells whose
    voxels are all alike."""
    there = distances(device, surface.mesh(), along(creases(mesh), 3000)) / pitch
    back = distances(device, mesh, along(creases(surface.mesh()), 3000)) / pitch
    for found in (there, back):
        assert np.median(found) <= 0.02
        assert found.max() <= 0.5
    assert surface.features
    assert surface.features.farthest
    assert abs(surface.features.farthest[0] / pitch - there.max()) <= SPACING / 2


@pytest.mark.parametrize(("angle", "least"), [(60, 0.0), (20, 1.0), (5, 2.5)])
def test_how_far_thin_edges_are_is_said(device: Device, angle: float, least: float) -> None:
    """A wedge whose tip no voxel's centre meets: where it is half a voxel thick or less."""
    height = np.tan(np.radians(angle))
    corners = [(x, y * height, z) for x, y in ((0, 0), (1, 0), (1, 1)) for z in (0, 1)]
    faces = [(0, 4, 2), (1, 3, 5), (0, 2, 3), (0, 3, 1), (2, 4, 5), (2, 5, 3), (0, 1, 5), (0, 5, 4)]
    mesh = turned(voxtool.mesh_from_arrays(np.array(corners, float), faces), 1)
    octree = voxtool.voxelize(mesh, dim=96, device=device)
    job = plan_extract(octree, style="sharp", source=mesh, device=device)
    surface = job.run()
    assert surface.features
    assert surface.features.farthest
    distance, place = surface.features.farthest
    assert least <= distance / surface.pitch <= 1.5 + 0.5 / height
    assert distances(device, surface.mesh(), np.array([place])) == distance
    assert any("before sharp edges" in note for note in job.notes(surface)) == (
        distance > surface.pitch
    )
    # edges inside the solid, of parts that overlap, do not count
    inner = meshes.join(meshes.box((0, 0, 0), (9, 9, 9)), meshes.box((3, 3, 3), (6, 6, 6)))
    both = meshes.mesh_of(*inner)
    solid = voxtool.voxelize(both, dim=40, fill="nonzero", device=device)
    found = extract(solid, style="sharp", source=both, device=device).features
    assert found
    assert found.farthest
    assert found.farthest[0] < 0.5 * solid.grid.pitch[0]


@pytest.mark.slow
def test_fandisk(device: Device) -> None:
    mesh = voxtool.load_mesh(model("fandisk.obj"))
    surface, pitch = sharp(device, mesh, 128)
    there = distances(device, surface.mesh(), along(creases(mesh), 10_000)) / pitch
    back = distances(device, mesh, along(creases(surface.mesh()), 10_000)) / pitch
    assert max(np.median(there), np.median(back)) <= 0.02
    assert max(there.max(), back.max()) <= 0.5


def test_a_box_on_the_lattice_is_itself(device: Device) -> None:
    """Corners, edges and sides of a box that lies anywhere between the voxels: exact but for the
    rounding to 2**-14, since every plane and every crossing is."""
    low, high = np.array([3.25, 2.75, 4.0625]), np.array([11.75, 13.25, 12.8125])
    mesh = meshes.mesh_of(*meshes.box(low.tolist(), high.tolist()))
    grid = Grid((16, 16, 16), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    octree = voxtool.voxelize(mesh, grid, device=device)
    surface = extract(octree, style="sharp", source=mesh, device=device)
    assert surface.features is not None
    assert surface.features.constrained == surface.features.open == 0
    assert surface.check()["volume"] == pytest.approx(np.prod(high - low), rel=1e-4)
    np.testing.assert_allclose(surface.vertices.min(axis=0), low, rtol=0, atol=1 / LATTICE)
    np.testing.assert_allclose(surface.vertices.max(axis=0), high, rtol=0, atol=1 / LATTICE)


def test_an_apex_of_many_faces_and_a_thin_sheet(device: Device) -> None:
    """A cone of 60 faces keeps its apex; a sheet of a third of a voxel is closed where voxels are,
    and both its sides are where they were."""
    n = 60
    turns = np.arange(n) * (2 * np.pi / n)
    base = np.c_[np.cos(turns), np.sin(turns), np.zeros(n)]
    a, b = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([np.c_[a, b, np.full(n, n)], np.c_[b, a, np.full(n, n + 1)]])
    mesh = turned(meshes.mesh_of(np.concatenate([base, [(0, 0, 1.5), (0, 0, 0)]]), faces), 3)
    surface, pitch = sharp(device, mesh, 48)
    assert distances(device, surface.mesh(), mesh.vertices[n : n + 1])[0] <= 0.5 * pitch

    sheet = meshes.mesh_of(*meshes.box((1.9, 1.9, 7.4), (13.9, 13.9, 7.7)))
    grid = Grid((16, 16, 16), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    octree = voxtool.voxelize(sheet, grid, device=device)
    thin = extract(octree, style="sharp", source=sheet, device=device)
    assert thin.check()["closed"]
    np.testing.assert_allclose(np.unique(thin.vertices[:, 2].round(3)), [7.4, 7.7], atol=1e-3)


# ---- self-intersections


def test_tangled_surfaces_come_apart(device: Device) -> None:
    """A net of random voxels whose vertices lie anywhere in their cells: what is moved is nearer to
    home, and quads have one of their two diagonals."""
    rng = np.random.default_rng(1)
    octree = octree_from_dense(rng.random((12, 12, 12)) < 0.1)
    net = voxtool.extract(octree, style="surface-nets", device=device)
    cells = (net.points - LATTICE // 2) // LATTICE * LATTICE + LATTICE // 2
    anywhere = rng.integers(NEAREST, LATTICE - NEAREST, net.points.shape)
    tangled = replace(net, points=(cells + anywhere).astype(np.int32))
    before = wrong_faces(tangled, device)
    found = untangle(tangled, [net.points], device)
    assert found.crossed == found.undecided == 0
    assert not wrong_faces(found.surface, device).any()
    assert found.surface.check()["closed"]
    assert 0 < np.count_nonzero(found.moved) < np.count_nonzero(before > 0)
    far, left = (np.abs(s.points - net.points).sum(axis=1) for s in (tangled, found.surface))
    assert (left[found.moved] <= 0.8 * far[found.moved]).all()
    assert np.array_equal(found.surface.points[~found.moved], tangled.points[~found.moved])
    diagonal = np.sort(found.surface.faces[::2, [0, 2]], axis=1)
    a, b, c, d = *net.faces[::2].T, net.faces[1::2, 2]
    same, other = (
        (diagonal == np.sort(np.stack(ends, axis=1), axis=1)).all(axis=1)
        for ends in ((a, c), (b, d))
    )
    assert (same ^ other).all()
    assert same.any()
    assert other.any()


def test_what_cannot_be_mended_is_counted(device: Device) -> None:
    """All homes of a ball in one place of their cells, through each other: the number of faces is
    that of a test of all."""
    ball = meshes.mesh_of(*meshes.icosphere(2))
    net = voxtool.extract(
        voxtool.voxelize(ball, dim=16, device=device), style="surface-nets", device=device
    )
    mirrored = net.points[::-1].copy()
    found = untangle(replace(net, points=mirrored), [mirrored], device)
    wrong = wrong_faces(found.surface, device)
    assert found.crossed == np.count_nonzero(wrong == 1) > 0
    assert not found.moved.any()


# ---- links without crossings


def test_vertices_stay_in_their_cells_and_open_ones_relax(device: Device) -> None:
    """The source of another place: no link is crossed, so vertices are those of surface nets."""
    octree = voxtool.voxelize(meshes.mesh_of(*meshes.box((2, 3, 4), (12, 11, 13))), dim=24)
    far = meshes.mesh_of(*meshes.box((-50, -50, -50), (-40, -40, -40)))
    surface = extract(octree, style="sharp", source=far, device=device)
    nets = extract(octree, style="surface-nets", device=device)
    assert surface.features is not None
    assert surface.features.open == len(surface.points)
    assert np.array_equal(surface.points, nets.points)


def test_a_hole_is_closed_smoothly_beside_features(device: Device) -> None:
    mesh = turned(meshes.mesh_of(*meshes.open_box((-1, -1, -1), (1, 1, 1))), 5)
    octree = voxtool.voxelize(mesh, dim=40, device=device)
    surface, pitch = sharp(device, mesh, 40)
    assert surface.features is not None
    assert 0 < surface.features.open < len(surface.points) / 4
    nets = extract(octree, style="surface-nets", device=device)
    assert np.abs(surface.points - nets.points).max() <= (1 + REACH) * LATTICE
    there = distances(device, surface.mesh(), mesh.vertices) / pitch
    assert np.sort(there)[3] <= 0.5  # the corners away from the hole


def test_relaxation_is_planned_for_sources_that_may_miss_links(device: Device) -> None:
    solid = replace(meshes.mesh_of(*meshes.box((0, 0, 0), (2, 3, 4))), source_sha256="1")
    hole = replace(meshes.mesh_of(*meshes.open_box((0, 0, 0), (2, 3, 4))), source_sha256="2")
    within = Grid((8, 8, 8), (0.25, 0.25, 0.25), (0.25, 0.25, 0.25))
    whole, cut = (
        voxtool.voxelize(solid, grid, device=device) for grid in (Grid.fit(solid, 16), within)
    )
    for octree, source, needed in (
        (whole, solid, False),
        (cut, solid, True),  # the border closes it
        (whole, hole, True),
        (voxtool.voxelize(hole, dim=16, device=device), hole, True),
    ):
        job = plan_extract(octree, style="sharp", source=source, device=device)
        began: list[str] = []
        surface = job.run(began.append)
        assert set(began) == set(job.stages)
        assert ("relax" in job.stages) == needed
        assert surface.features is not None
        assert surface.features.open == 0 or needed


# ---- requests


def test_refusals(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    vertices, faces = meshes.box((0, 0, 0), (2, 3, 4))
    write_obj(Path("box.obj"), vertices, faces)
    write_obj(Path("other.obj"), vertices * 2, faces)
    run("voxelize box.obj --dim 16")
    run("extract box.svo.h5 --style sharp --source box.obj -o sharp.obj --check")
    assert len(voxtool.load_mesh("sharp.obj").faces) > 100
    assert "was not made from it" in fail("extract box.svo.h5 --style sharp --source other.obj", 3)
    assert "--source" in fail("extract box.svo.h5 --style sharp", 2)
    assert "--source" in fail("extract box.svo.h5 --source box.obj", 2)
    with pytest.raises(MeshError, match="was not made from it"):
        voxtool.extract("box.svo.h5", style="sharp", source="other.obj", device=device)
    with pytest.raises(VoxtoolError, match="give its source"):
        voxtool.extract("box.svo.h5", style="sharp", device=device)
    with pytest.raises(VoxtoolError, match="voxels as samples"):
        voxtool.extract("box.svo.h5", style="sharp", level=0, source="box.obj", device=device)
    run("voxelize box.obj --dim 16 --normalize unit -o unit.svo.h5")
    placed = voxtool.extract("unit.svo.h5", style="sharp", source="box.obj", device=device)
    assert placed.features is not None
    assert placed.features.open == 0


def test_sharp_surfaces_of_the_deepest_grids_are_those_of_shallow_ones(device: Device) -> None:
    """Links beyond the last voxel of 65,536 are crossed, too."""
    mesh = turned(meshes.mesh_of(*meshes.box((0, 0, 0), (7, 7, 7))), 2)
    mesh = Mesh(np.floor((mesh.vertices - mesh.bounds[0]) * 256) / 256 + 0.25, mesh.faces)
    found = []
    for dim, corner in ((16, 0), (65_536, 65_520)):
        grid = Grid((dim,) * 3, (-float(corner),) * 3, (1.0, 1.0, 1.0))
        octree = voxtool.voxelize(mesh, grid, device=device)
        surface = extract(octree, style="sharp", source=mesh, device=device)
        found.append((surface.points.astype(np.int64) - corner * LATTICE, surface.faces))
    full = meshes.mesh_of(*meshes.box((65_519.75,) * 3, (65_536.25,) * 3))
    octree = voxtool.voxelize(full, Grid((65_536,) * 3, (0, 0, 0), (1, 1, 1)), device=device)
    assert octree.count == 16**3
    surface = extract(octree, style="sharp", source=full, device=device)
    assert surface.features
    assert surface.features.open == 0
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
