"""The rule of "auto" for meshes that are not consistent, and the share of the outer surface."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import wrecks
from helpers import meshes

import voxtool
from voxtool.grid import Grid
from voxtool.spatial.sampling import SurfaceSampler
from voxtool.svo.voxelization.kept_share import outer_surface, share_of
from voxtool.svo.voxelization.plan import COMPARISON
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

CAVITY = meshes.icosphere(1, 0, 2.5)
SHELLS = (
    meshes.icosphere(2, 0, 4.0),
    (CAVITY[0], CAVITY[1][:, ::-1]),
    meshes.torus((8, 0, 0)),
)


def closed() -> Mesh:
    """A sphere with a cavity, and a torus that overlaps neither."""
    return meshes.mesh_of(*meshes.join(*SHELLS))


def turned(mesh: Mesh, wrong: np.ndarray) -> Mesh:
    return replace(mesh, faces=np.where(wrong[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces))


def damaged() -> dict[str, Mesh]:
    mesh, rng = closed(), np.random.default_rng(5)
    some, patch = rng.random(len(mesh.faces)) < 0.5, np.arange(len(mesh.faces)) % 100 < 40
    doubled = np.concatenate([mesh.faces, np.roll(mesh.faces, 1, axis=1)])
    both = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
    return {
        "faces turned": turned(mesh, some),
        "patches turned": turned(mesh, patch),
        "both sides": replace(mesh, faces=both),
        "doubled and turned": turned(replace(mesh, faces=doubled), rng.random(len(doubled)) < 0.5),
    }


@pytest.mark.parametrize("kind", list(damaged()))
def test_what_was_closed_is_filled_as_before(kind: str, device: Device) -> None:
    mesh = closed()
    grid = Grid.fit(mesh, 40)
    job = plan_voxelize(damaged()[kind], grid, device=device)
    octree = job.run()
    assert octree == voxelize(mesh, grid, fill="parity", device=device)
    assert octree.fill == "winding"
    assert (job.plan.stages[0] == COMPARISON) == (kind != "both sides")  # whose copies are closed
    assert job.inside is not None
    assert "turned outward" in job.inside.why
    assert job.notes(octree)[0].endswith(job.inside.why)


def test_consistent_meshes_pay_nothing(device: Device) -> None:
    """Closed, open, and repeated: nothing is oriented, and no rule is compared."""
    mesh = closed()
    vertices, faces = meshes.icosphere(2)
    for found, fill in (
        (mesh, "parity"),
        (meshes.mesh_of(*meshes.open_box(0, 5)), "winding"),
        (meshes.mesh_of(vertices, faces[1:]), "winding"),
        (meshes.mesh_of(vertices, np.concatenate([faces, faces])), "winding"),
    ):
        job = plan_voxelize(found, Grid.fit(found, 32), device=device)
        assert (job.plan.fill, job.plan.choice, job.mesh) == (fill, "", found)
        assert COMPARISON not in job.plan.stages
        assert "choice" not in job.plan.scene()


@pytest.mark.parametrize("fin", [False, True])
def test_parts_that_overlap_are_not_flooded_to_a_crust(fin: bool, device: Device) -> None:
    """Through holes the flood reaches walls between the parts: a crust keeps them, a solid loses
    them. Edges of three faces are no reason to take the crust."""
    vertices, faces = meshes.join(meshes.icosphere(2), meshes.icosphere(2, (1.0, 0.2, 0.1), 0.9))
    faces = np.delete(faces, np.arange(0, len(faces), 17), axis=0)
    if fin:
        faces = np.concatenate([faces, [[*faces[100, 1::-1], faces[101, 2]]]])
    proper = meshes.mesh_of(vertices, faces)
    mesh = turned(proper, np.arange(len(faces)) % 5 == 0)
    grid = Grid.fit(mesh, 24)
    job = plan_voxelize(mesh, grid, device=device)
    octree = job.run()
    assert octree == voxelize(proper, grid, fill="winding", device=device)
    assert "the rest is inside" in job.plan.choice


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_a_car_keeps_its_surface(share: float, device: Device) -> None:
    mesh = meshes.mesh_of(*wrecks.car(), name="car")
    mesh = turned(mesh, np.random.default_rng(1).random(len(mesh.faces)) < share)
    grid = Grid.fit(mesh, 128)
    flooded, wound = (voxelize(mesh, grid, fill=f, device=device) for f in ("flood", "winding"))
    surface = voxelize(mesh, grid, "surface26", device=device)
    outer = outer_surface(surface, flooded, device)
    assert not share_of(outer, wound, device).enough
    job = plan_voxelize(mesh, grid, device=device)
    assert job.plan.fill == "flood"
    assert "winding numbers keep" in job.plan.choice
    assert share_of(outer, job.run(), device).enough


def test_the_choice_does_not_depend_on_the_grid(device: Device) -> None:
    """A gap is as long in the world at any dim; windows, as of tiles, have the choice of all."""
    mesh = meshes.mesh_of(*wrecks.sheet((0.0, 0.0, 0.0), (6, 0, 2), (0, 5, 1)), name="sheet")
    jobs = {dim: plan_voxelize(mesh, Grid.fit(mesh, dim), device=device) for dim in (30, 128, 400)}
    assert len({job.plan.choice for job in jobs.values()}) == 1
    assert {dim: job.plan.rule for dim, job in jobs.items()} == {
        30: "flood+gap1", 128: "flood+gap3", 400: "flood+gap10",
    }  # fmt: skip
    window = (0, 0, 0), (16, 16, 16)
    part = plan_voxelize(mesh, Grid.fit(mesh, 128), window=window, device=device)
    assert (part.plan.rule, part.inside) == ("flood+gap3", jobs[128].inside)


def test_an_empty_result_names_a_rule(device: Device) -> None:
    flat = meshes.mesh_of(*wrecks.sheet((0.0, 0.0, 0.0), (6, 0, 0), (0, 5, 0)))
    with pytest.warns(voxtool.MeshWarning, match="choose fill flood"):
        voxelize(flat, Grid.fit(flat, 16), fill="winding", device=device)
    vertices, faces = meshes.open_box(0, 5)
    inward = meshes.mesh_of(vertices, faces[:, ::-1])
    with pytest.warns(voxtool.MeshWarning, match="choose fill auto, which turns its faces outward"):
        voxelize(inward, Grid.fit(inward, 16), fill="winding", device=device)
    assert voxelize(inward, Grid.fit(inward, 16), device=device) == voxelize(
        meshes.mesh_of(vertices, faces), Grid.fit(inward, 16), device=device
    )


def samples(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points by area, and the voxels that an area of 1 touches there, but for its edges."""
    sampler = SurfaceSampler(mesh, "")
    at = (np.arange(count) + 0.5) / count * sampler.area[-1]
    a, b, c = mesh.vertices[mesh.faces[np.searchsorted(sampler.area, at)]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    weights = np.abs(normal).sum(axis=1) / np.sqrt((normal**2).sum(axis=1))
    return next(sampler.samples(count)), weights


@pytest.mark.parametrize("lost", ["nothing", "one part", "all of one half"])
def test_shares_by_samples(lost: str, device: Device) -> None:
    """Distances from samples of the surface to centres of outside voxels, and to the sides of the
    result's boundary, one by one."""
    ball, box = (
        meshes.icosphere(3, (10, 10, 10), 8.0),
        meshes.box((20.3, 3.2, 3.4), (29.1, 16.8, 16.6)),
    )
    hidden = meshes.icosphere(1, (10, 10, 10), 3.0)
    mesh = meshes.mesh_of(*meshes.join(ball, box, hidden))
    grid = Grid((32, 24, 24), (-1.0, -2.0, -2.0), (1.0, 1.0, 1.0))
    flooded = voxelize(mesh, grid, fill="flood", device=device)
    result = flooded.to_dense()
    if lost == "one part":
        result[20:] = False
    elif lost == "all of one half":
        result[:, 12:] = False
    outer = outer_surface(voxelize(mesh, grid, "surface26", device=device), flooded, device)
    found = share_of(outer, voxtool.Octree.from_dense(result, grid.origin, grid.pitch), device)

    points, weights = samples(mesh, 4000)
    points = points - grid.origin
    outside = np.argwhere(~flooded.to_dense()) + 0.5
    visible = np.array([((outside - p) ** 2).sum(axis=1).min() <= 3 for p in points])
    sides = [
        (np.argwhere(np.diff(result, axis=axis)), axis) for axis in range(3)
    ]  # voxels whose upper side along an axis is part of the boundary
    low = np.concatenate([cells + np.eye(3)[axis] for cells, axis in sides])
    size = np.concatenate([np.tile(1 - np.eye(3)[axis], (len(cells), 1)) for cells, axis in sides])
    kept = np.array(
        [
            (np.maximum(np.maximum(low - p, p - low - size), 0) ** 2).sum(axis=1).min() <= 1.5**2
            for p in points
        ]
    )
    expected = weights[kept & visible].sum() / weights[visible].sum()
    assert abs(found.kept / found.outer - expected) < 0.04  # half a voxel along the cut is 0.03
    assert found.enough == (lost == "nothing")
