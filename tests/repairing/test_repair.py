"""Repair: closed, manifold, without self-intersections, and near the mesh."""

from __future__ import annotations

import numpy as np
import pytest
import wrecks
from conftest import model
from helpers import meshes

import voxtool
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.repairing.fit import cells_of, fit, onto_planes
from voxtool.repairing.measure import outer_faces
from voxtool.repairing.targets import Level
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.sampling import SurfaceSampler
from voxtool.svo.surface.isosurface import LATTICE

# What each fault needs; for the others, auto takes a rule that suits.
FILLS = {"sheets": "flood"}
FEW = [("holes", "torus"), ("flipped", "sphere"), ("overlapped", "torus"), ("apart", "box"),
       ("sheets", "sphere"), ("noisy", "two")]  # fmt: skip


def certified(fault: str, shape: str, seed: int, dim: int, device=None) -> voxtool.Repaired:
    """The repair of a wreck, whose shells and genus are those of the shape; but fins through the
    hole of a torus may divide it."""
    _, shells, genus = wrecks.SHAPES[shape]
    fixed = voxtool.repair(
        wrecks.wreck(fault, shape, seed), dim=dim, fill=FILLS.get(fault, "auto"),
        keep_components=shells, device=device,
    )  # fmt: skip
    assert fixed.faults == ""
    assert fixed.checked["shells"] == shells
    if (fault, shape) != ("sheets", "torus"):
        assert fixed.checked["genus"] == genus
    return fixed


@pytest.mark.parametrize(("fault", "shape"), FEW)
def test_wrecks(device, fault: str, shape: str) -> None:
    fixed = certified(fault, shape, 0, 32, device)
    whole = voxtool.mesh_from_arrays(*wrecks.SHAPES[shape][0])
    volume = voxtool.repair(whole, fixed.grid, device=device).checked["volume"]
    added = 0.25 if fixed.fill == "flood" else 0.05  # half a voxel all around
    assert abs(fixed.checked["volume"] / volume - 1) < added
    mesh = voxtool.mesh_from_arrays(*wrecks.wreck(fault, shape))
    to_mesh, to_result = (TriangleDistance(m, device) for m in (mesh, fixed.mesh()))
    # on the mesh means on the mesh: all that is within a step of the lattice
    step = fixed.grid.pitch[0] / LATTICE
    assert np.count_nonzero(to_mesh(fixed.vertices) <= step) >= fixed.on_target > 0
    # no sample is beyond the bounds, which are close to each other
    for one, other, way in ((fixed.mesh(), to_mesh, "result_to_mesh"),
                            (mesh, to_result, "mesh_to_result")):  # fmt: skip
        found = fixed.distances[way]
        samples = np.concatenate([*SurfaceSampler(one, "").samples(5000), one.vertices])
        assert other(samples).max() <= found["max_upper"]
        assert 0 <= found["max_upper"] - found["max"] <= 1.001 * fixed.distances["tolerance"]
    outer = fixed.distances["outer_mesh_to_result"]
    assert outer["max"] <= fixed.distances["mesh_to_result"]["max_upper"]


@pytest.mark.soak
@pytest.mark.parametrize("shape", wrecks.SHAPES)
@pytest.mark.parametrize("fault", wrecks.FAULTS)
@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3))])
def test_all_wrecks(fault: str, shape: str, seed: int) -> None:
    fixed = certified(fault, shape, seed, 64)
    assert fixed.distances["result_to_mesh"]["mean"] < fixed.grid.pitch[0]


@pytest.mark.parametrize("name", ["suzanne", "teapot"])
def test_bad_models(name: str) -> None:
    fixed = voxtool.repair(model(f"{name}.obj"), dim=64)
    assert fixed.faults == ""
    assert fixed.on_target > 0.95 * len(fixed.vertices)
    assert fixed.distances["result_to_mesh"]["mean"] < 0.1 * fixed.grid.pitch[0]


@pytest.mark.soak
@pytest.mark.long
@pytest.mark.parametrize("name", ["suzanne", "teapot", "stanford-bunny", "dragon"])
def test_bad_models_finely(name: str) -> None:
    fixed = voxtool.repair(model(f"{name}.obj"), dim=300)
    assert fixed.faults == ""


def test_closed_meshes_are_followed(device) -> None:
    """A sphere's repair has its volume, and no point is farther than a tenth of a voxel."""
    ball = meshes.icosphere(4)
    fixed = voxtool.repair(ball, dim=40, device=device)
    assert fixed.fill == "parity"
    assert fixed.on_target > 0.98 * len(fixed.vertices)
    for way in ("result_to_mesh", "mesh_to_result", "outer_mesh_to_result"):
        assert fixed.distances[way]["max_upper"] < 0.2 * fixed.grid.pitch[0]
    volume = voxtool.repair(ball, dim=80, device=device).checked["volume"]
    assert abs(fixed.checked["volume"] / volume - 1) < 0.005


def test_inside_out_and_cavities(device) -> None:
    """Shells inside out are solid; a cavity stays one; the result is wound outwards."""
    vertices, faces = meshes.icosphere(2)
    assert voxtool.repair((vertices, faces[:, ::-1]), dim=24, device=device).checked["volume"] > 3.5
    hollow = meshes.join((vertices, faces), (0.5 * vertices, faces[:, ::-1]))
    found = voxtool.repair(hollow, dim=32, device=device).checked
    assert found["shells"] == 2
    assert abs(found["volume"] / (4 / 3 * np.pi * 7 / 8) - 1) < 0.1
    reversed_ = hollow[0], hollow[1][:, ::-1]
    assert voxtool.repair(reversed_, dim=32, device=device).checked == found


def test_parts_that_overlap_are_united_whichever_way_they_point(device) -> None:
    """One part inside out, one part with a cavity: the voxels are those of parts that agree."""
    vertices, faces = meshes.icosphere(2)
    core, other = (0.5 * vertices, faces[:, ::-1]), vertices + np.array((1.3, 0.1, 0.2))
    proper = meshes.join((vertices, faces), core, (other, faces))
    one = meshes.join((vertices, faces), core, (other, faces[:, ::-1]))
    first = meshes.join((vertices, faces[:, ::-1]), (core[0], faces), (other, faces))
    wanted = voxtool.repair(proper, dim=32, device=device)
    assert (wanted.checked["shells"], wanted.checked["genus"]) == (2, 0)
    for mesh in (one, first):
        found = voxtool.repair(mesh, dim=32, device=device)
        assert found.voxels == wanted.voxels
        assert (found.checked["shells"], found.checked["genus"]) == (2, 0)
        assert abs(found.checked["volume"] / wanted.checked["volume"] - 1) < 1e-4


def test_the_outer_surface_is_measured_apart(device) -> None:
    """A sheet and a ball inside a box, whose large faces are divided, are no outer surface."""
    mesh = voxtool.mesh_from_arrays(*meshes.join(
        meshes.box((0, 0, 0), (4, 4, 4)), meshes.icosphere(1, (2.0, 2.0, 2.0), 0.8)
    ))  # fmt: skip
    fixed = voxtool.repair(mesh, dim=32, device=device)
    pitch, found = fixed.grid.pitch[0], fixed.distances
    pieces, outer = outer_faces(mesh, voxtool.voxelize(mesh, fixed.grid, device=device), device)
    corners = pieces.vertices[pieces.faces]
    edges = corners - np.roll(corners, 1, axis=1)
    assert np.sqrt((edges**2).sum(axis=2)).max() <= 4 * pitch
    on_box = ((corners == 0) | (corners == 4)).any(axis=2).all(axis=1)
    assert np.array_equal(outer, on_box)
    assert found["outer_mesh_to_result"]["max_upper"] < 1.2 * pitch
    assert found["mesh_to_result"]["max"] > 1.1


def test_vertices_stay_in_their_cells(device) -> None:
    mesh = voxtool.mesh_from_arrays(*wrecks.wreck("noisy", "torus"))
    octree = voxtool.voxelize(mesh, dim=24, fill="winding", device=device)
    net = voxtool.extract(octree, style="surface-nets", device=device)
    fitted = fit(net, [Level(TriangleDistance(mesh, device))], device)
    low, high = cells_of(net.points)
    assert ((fitted.surface.points >= low) & (fitted.surface.points <= high)).all()
    assert (fitted.surface.points != net.points).any()


def test_points_of_planes_in_boxes() -> None:
    """The nearest point of a plane in a box, against many points of the plane."""
    rng = np.random.default_rng(3)
    n = 200
    normals = rng.normal(size=(n, 3))
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    points, places = rng.uniform(0, 64, (2, n, 3))
    low, high = np.zeros((n, 3)), np.full((n, 3), 64.0)
    found = onto_planes(points, places, normals, low, high)
    assert (np.abs(((found - places) * normals).sum(axis=1)) < 1e-3).all()
    others = rng.uniform(0, 64, (20000, 3))
    for i in range(n):
        across = others - np.outer((others - places[i]) @ normals[i], normals[i])
        within = across[((across >= 0) & (across <= 64)).all(axis=1)]
        nearest = np.sqrt(((within - points[i]) ** 2).sum(axis=1)).min(initial=np.inf)
        assert np.sqrt(((found[i] - points[i]) ** 2).sum()) <= nearest + 1e-3


def test_resolution_and_components() -> None:
    two = wrecks.SHAPES["two"][0]
    fixed = voxtool.repair(two, tolerance=0.25, keep_components=1)
    assert fixed.grid.pitch[0] == 0.25 / np.sqrt(3)
    assert (fixed.components, fixed.checked["shells"]) == (2, 1)
    assert fixed.vertices[:, 0].max() < 1.5
    again = voxtool.repair(two, fixed.grid, keep_components=1)
    assert again == fixed
    assert again.digest() == fixed.digest()


def test_refusals() -> None:
    ball = meshes.icosphere(1)
    with pytest.raises(VoxtoolError, match="keep 1 or more"):
        voxtool.repair(ball, keep_components=0)
    with pytest.raises(GridError):
        voxtool.repair(ball, dim=64, tolerance=1)
    with pytest.raises(VoxtoolError, match="repair needs cubes"):
        voxtool.repair(ball, voxtool.Grid((16, 16, 16), (-2, -2, -2), (0.25, 0.25, 0.5)))
    sheet = ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    none = pytest.raises(VoxtoolError, match="no voxel of dim 16 is inside by winding")
    with none, pytest.warns(voxtool.MeshWarning, match="encloses nothing"):
        voxtool.repair(sheet, dim=16, fill="winding")
    with pytest.raises(MemoryLimitError, match="choose --dim"):
        voxtool.repair(ball, dim=1024, max_memory=150_000_000)


def test_the_plan_predicts_the_result() -> None:
    job = voxtool.plan_repair(meshes.icosphere(4), dim=64)
    found = job.run()
    assert 0.8 < job.plan.vertices / len(found.vertices) < 1.25
    assert list(job.stages)[-2:] == ["distances", "check"]
    assert job.describe()["predicted_triangles"] == 2 * job.plan.vertices
