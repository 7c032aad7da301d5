"""Surfaces with cells of different size: manifold, with the topology of the uniform surface, and
within the tolerance of it at points that are spread over both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.attributes import attributed
from helpers.cli import fail, invoke, told
from helpers.octree import ball, octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.choices import MARCHING_CUBES, SHARP, SURFACE_NETS, VOXEL_FACES
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.files import write_svo
from voxtool.grid import Grid
from voxtool.mesh.topology import check_surface
from voxtool.spatial.distance import TriangleDistance
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.surface.isosurface import Isosurface

SAMPLINGS = ((SURFACE_NETS, "voxel"), (SURFACE_NETS, 0), (MARCHING_CUBES, "voxel"),
             (MARCHING_CUBES, 0), (VOXEL_FACES, "voxel"))  # fmt: skip
ROUNDED = 1 + 1e-9


def topology(surface: Isosurface) -> tuple[int, int]:
    """The shells and the Euler number of a closed, manifold surface without flat faces."""
    found = check_surface(surface.mesh(), weld=False)
    assert found.watertight
    assert found.manifold
    assert found.degenerate_faces == found.duplicate_faces == 0
    assert len(np.unique(surface.faces)) == len(surface.points)
    return found.shells, found.euler


def points_on(surface: Isosurface) -> np.ndarray:
    """Vertices, and points inside of faces."""
    shares = np.random.default_rng(1).dirichlet((1, 1, 1), (6, len(surface.faces)))
    corners = surface.vertices[surface.faces]
    inner = (shares[..., None] * corners).sum(axis=2).reshape(-1, 3)
    return np.concatenate([surface.vertices, inner])


def apart(surface: Isosurface, other: Isosurface, device) -> float:
    """The largest distance of points on each surface from the other."""
    pairs = ((surface, other), (other, surface))
    return max(TriangleDistance(b.mesh(), device)(points_on(a)).max() for a, b in pairs)


def adapted(octree: Octree, tolerance: float, device, **request) -> tuple[Isosurface, Isosurface]:
    """The uniform surface of an octree, and the adaptive one, which keeps its promises."""
    uniform = extract(octree, device=device, **request)
    surface = extract(octree, device=device, adaptive=tolerance, **request)
    told = surface.adaptive
    assert told is not None
    assert topology(surface) == topology(uniform)
    assert told.uniform == len(uniform.faces)
    furthest = apart(surface, uniform, device)
    assert furthest <= tolerance * ROUNDED
    assert told.furthest <= tolerance
    return uniform, surface


@st.composite
def patterns(draw: st.DrawFn) -> np.ndarray:
    """Scattered voxels, boxes, and both: with handles, cavities, and sheets that touch."""
    shape = tuple(draw(st.lists(st.integers(8, 12), min_size=3, max_size=3)))
    random = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    scattered = random.random(shape) < draw(st.sampled_from([0.02, 0.1, 0.5, 0.9]))
    boxes = random.random([3, 3, 3]) < 0.5
    boxes = np.kron(boxes, np.ones((4, 4, 4), bool))[tuple(map(slice, shape))]
    dense = draw(st.sampled_from([scattered, boxes, scattered & boxes, scattered | boxes]))
    dense.flat[0] = True
    return dense


@given(patterns(), st.sampled_from(SAMPLINGS), st.sampled_from([0.005, 0.03, 0.1, 0.4]))
@settings(max_examples=25)
def test_every_pattern_keeps_its_topology(device, dense, sampling, tolerance) -> None:
    octree = octree_from_dense(dense)
    style, level = sampling
    if len(extract(octree, style=style, level=level, device=device).faces):
        adapted(octree, tolerance, device, style=style, level=level)


@pytest.mark.parametrize(("tolerance", "share"), [(0.01, 0.8), (0.03, 0.25), (0.1, 0.08)])
def test_triangles_are_saved(device, tolerance, share) -> None:
    """A ring: what is curved needs smaller cells the smaller the tolerance is."""
    x, y, z = np.indices((40, 40, 16)) + 0.5
    ring = (np.sqrt((x - 20) ** 2 + (y - 20) ** 2) - 12) ** 2 + (z - 8) ** 2 < 25
    uniform, surface = adapted(octree_from_dense(ring), tolerance, device)
    assert topology(surface) == (1, 0)
    assert len(surface.faces) < share * len(uniform.faces)
    assert surface.volume == pytest.approx(uniform.volume, rel=tolerance)


def test_flat_faces_need_few_triangles(device) -> None:
    """A box of voxels keeps its shape; cells grow in powers of two, whatever lies beside them."""
    dense = np.zeros((50, 40, 30), bool)
    dense[3:45, 5:38, 7:21] = True
    uniform, surface = adapted(octree_from_dense(dense), 1e-6, device, style=VOXEL_FACES)
    assert surface.volume == pytest.approx(uniform.volume, rel=1e-12)
    assert len(surface.faces) < len(uniform.faces) / 15
    assert np.array_equal(surface.mesh().bounds, uniform.mesh().bounds)


def test_nothing_is_merged_below_what_merging_moves(device) -> None:
    octree = octree_from_dense(ball((24, 24, 24)))
    uniform, surface = adapted(octree, 1e-9, device)
    assert np.array_equal(surface.points, uniform.points)
    assert np.array_equal(surface.faces, uniform.faces)


def test_faces_look_outward(device) -> None:
    _, surface = adapted(octree_from_dense(ball((40, 40, 40))), 0.03, device)
    corners = surface.vertices[surface.faces] - surface.vertices.mean(axis=0)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(axis=1)).sum(axis=1) > 0).all()


def test_sides_of_voxels_may_differ(device) -> None:
    octree = octree_from_dense(ball((24, 24, 24)))
    octree = replace(octree, grid=Grid((24, 24, 24), (5.0, -1.0, 0.0), (1.0, 0.25, 3.0)))
    uniform, surface = adapted(octree, 0.5, device)
    assert len(surface.faces) < 0.6 * len(uniform.faces)


def test_fractions(device) -> None:
    mesh = meshes.mesh_of(*meshes.icosphere(3, 0.0, 1.0))
    octree = voxtool.voxelize(mesh, dim=40, mode="fraction", device=device)
    uniform, surface = adapted(octree, 0.1 * max(octree.grid.pitch), device)
    assert len(surface.faces) < 0.5 * len(uniform.faces)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "style", "share"),
    [("fandisk", SURFACE_NETS, 0.15), ("spot", MARCHING_CUBES, 0.7), ("suzanne", VOXEL_FACES, 0.9)],
)
def test_models(device, name, style, share) -> None:
    mesh = voxtool.load_mesh(model(f"{name}.obj"))
    octree = voxtool.voxelize(mesh, dim=64, device=device)
    uniform, surface = adapted(octree, 0.5 * max(octree.grid.pitch), device, style=style)
    assert len(surface.faces) < share * len(uniform.faces)


def test_every_device_has_the_same_surface(devices) -> None:
    octree = octree_from_dense(np.random.default_rng(5).random((20, 18, 16)) < 0.9)
    found = {extract(octree, adaptive=0.04, device=device).digest() for device in devices}
    assert len(found) == 1
    assert extract(octree, device=devices[0]).digest() not in found


def test_topology_is_kept_where_no_cell_is_a_disk(device) -> None:
    """Voxels that touch at corners and edges alone, and cavities of one voxel."""
    x, y, z = np.indices((9, 9, 9))
    for dense in ((x + y + z) % 2 == 0, (x % 2 + y % 2 + z % 2 < 3)):
        adapted(octree_from_dense(dense), 1.0, device)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"adaptive": 0}, "adaptive 0: give a length greater than 0"),
        ({"adaptive": float("nan")}, "adaptive nan: give a length"),
        ({"adaptive": "1vox"}, "adaptive '1vox': give a length"),
        ({"adaptive": 1, "style": VOXEL_FACES, "merge": True}, "merged squares cannot be adaptive"),
        ({"adaptive": 1, "style": SHARP}, "a sharp surface cannot be adaptive"),
    ],
)
def test_what_is_refused(device, request_, message) -> None:
    source = meshes.mesh_of(*meshes.icosphere(1, 0.0, 1.0)) if "style" in request_ else None
    source = source if request_.get("style") == SHARP else None
    with pytest.raises(VoxtoolError, match=message):
        plan_extract(octree_from_dense(ball((16, 16, 16))), source=source, **request_)


def test_the_plan(device) -> None:
    octree = octree_from_dense(ball((32, 32, 32)))
    job = plan_extract(octree, adaptive=0.05, device=device)
    plain = plan_extract(octree, device=device)
    began: list[str] = []
    job.run(began.append)
    assert tuple(dict.fromkeys(began)) == job.stages
    assert job.describe()["adaptive_tolerance"] == 0.05
    assert job.cost.device > plain.cost.device
    assert job.cost.host > plain.cost.host == 0
    limit = (job.cost.device + plain.cost.device) // 2
    with pytest.raises(MemoryLimitError, match="choose level"):
        plan_extract(octree, adaptive=0.05, max_memory=limit, device=device).run()
    with pytest.raises(TypeError, match="adaptive: plan another extraction"):
        job.with_(adaptive=1.0)


def test_the_command(here) -> None:
    """Lengths in voxels and world units, the report, and colours that are left out."""
    write_svo(octree_from_dense(ball((24, 24, 24))), "a.svo.h5")
    found = told("extract a.svo.h5 --adaptive 0.5vox --check --json -o a.ply")
    surface = extract(voxtool.read_svo("a.svo.h5"), adaptive=0.05)
    assert found["digest"] == surface.digest()
    assert found["digest"] == told("extract a.svo.h5 --adaptive 0.05 --json -o b.ply")["digest"]
    saved = found["adaptive"]
    assert saved["tolerance"] == 0.05 >= saved["furthest"] > 0
    assert saved["triangles_saved"] == saved["uniform_triangles"] - found["triangles"] > 0
    assert found["check"]["manifold"]
    assert found["check"]["closed"]
    text = invoke("extract a.svo.h5 --adaptive 0.5vox -o a.ply").stderr
    assert f"% of {saved['uniform_triangles']:,} triangles saved, " in text
    assert "away, at most 0.05, " in text
    assert "names no unit" in fail("extract a.svo.h5 --adaptive 2mm -o a.ply")
    for bad in ("0", "-1", "x", "1voxel", "nan"):
        assert "is no length" in fail(f"extract a.svo.h5 --adaptive {bad}", code=2)
    assert "--adaptive is of octrees" in fail("extract bunny.adf.h5 --adaptive 1", code=2)
    write_svo(replace(attributed(), units="mm"), "c.svo.h5")
    text = invoke("extract c.svo.h5 --style voxel-faces --adaptive 0.01cm -o c.glb").stderr
    assert "colours are left out: cells of several colours are merged" in text
