"""Offsets, hollow solids, thick surfaces and drains, of shapes whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.repairing.walls import beyond, plate, within
from voxtool.spatial.distance import TriangleDistance
from voxtool.svo.octree.octree import Octree

BALL = meshes.icosphere(4)
DIM = 48
LEAST = 0.992  # the least radius of the facets of BALL


def radii(fixed: voxtool.Repaired) -> np.ndarray:
    return np.sqrt((fixed.vertices**2).sum(axis=1))


@pytest.mark.parametrize("offset", [0.25, -0.4])
def test_offsets_of_a_ball(device, offset: float) -> None:
    fixed = voxtool.repair(BALL, dim=DIM, offset=offset, device=device)
    assert fixed.faults == ""
    assert (fixed.checked["shells"], fixed.checked["genus"]) == (1, 0)
    pitch = fixed.grid.pitch[0]
    away = np.abs(radii(fixed) - (1 + offset))
    assert away.max() < 0.5 * pitch
    assert np.quantile(away, 0.9) < 1.1 * (1 - LEAST)
    assert fixed.on_target > 0.98 * len(fixed.vertices)


def test_a_hollow_ball_keeps_its_outer_surface(device) -> None:
    solid = voxtool.repair(BALL, dim=DIM, device=device)
    fixed = voxtool.repair(BALL, dim=DIM, shell=0.3, device=device)
    assert fixed.faults == ""
    assert (fixed.checked["shells"], fixed.wall["cavities"], fixed.wall["closed"]) == (2, 1, 1)
    outer = {tuple(p) for p in fixed.surface.points[radii(fixed) > 0.85].tolist()}
    assert outer == set(map(tuple, solid.surface.points.tolist()))
    inner = radii(fixed)[radii(fixed) < 0.85]
    assert np.quantile(np.abs(inner - 0.7), 0.9) < 1.1 * (1 - LEAST)
    assert 0.28 < fixed.wall["thinnest"] <= 0.3 + 1e-3


def test_drains_reach_the_cavity(device) -> None:
    """Two holes through the wall: one shell, a handle, and air along their axes."""
    drains = [(0, 0, 2, 0.2), (1, 0, 0, 0.15)]
    job = voxtool.plan_repair(BALL, dim=DIM, shell=0.2, drains=drains, device=device)
    fixed = job.run()
    assert fixed.faults == ""
    assert (fixed.checked["shells"], fixed.checked["genus"], fixed.wall["closed"]) == (1, 1, 0)
    for x, y, z, radius in drains:
        axis = np.array([x, y, z]) / max(x, z)
        along = fixed.vertices @ axis
        beside = np.sqrt(radii(fixed) ** 2 - along**2)
        ahead = (along > 0) & (beside < 1.5 * radius)
        assert beside[ahead].min() > radius - 0.5 * fixed.grid.pitch[0]
        on_hole = ahead & (along < 0.95) & (along > 0.85)
        # the hole follows a facet's normal, up to 5 degrees beside the ball's
        assert np.median(np.abs(beside[on_hole] - radius)) < 0.15 * np.sin(np.radians(5))


def test_a_cavity_without_a_drain_is_a_warning() -> None:
    two = meshes.join(BALL, meshes.icosphere(3, (3.0, 0.0, 0.0)))
    with pytest.warns(voxtool.MeshWarning, match="1 of 2 cavities without a drain"):
        fixed = voxtool.repair(two, dim=64, shell=0.3, drains=[(0, 0, 1, 0.2)])
    assert (fixed.checked["shells"], fixed.wall["closed"]) == (3, 1)


def test_a_thick_sheet(device) -> None:
    """A square becomes a plate with flat sides; its volume is that of the rounded plate."""
    square = ([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)], [(0, 1, 2), (0, 3, 2)])
    fixed = voxtool.repair(square, dim=48, thicken=0.2, device=device)
    assert fixed.faults == ""
    assert (fixed.checked["shells"], fixed.checked["genus"]) == (1, 0)
    inner = ((fixed.vertices[:, :2] > 0.1) & (fixed.vertices[:, :2] < 1.9)).all(axis=1)
    assert np.abs(np.abs(fixed.vertices[inner, 2]) - 0.1).max() < 1e-5
    volume = 4 * 0.2 + 8 * np.pi * 0.1**2 / 2 + 4 / 3 * np.pi * 0.1**3
    assert abs(fixed.checked["volume"] / volume - 1) < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_sets_by_distance(device, seed: int) -> None:
    """Every voxel of the sets, against the distances of all centres."""
    rng = np.random.default_rng(seed)
    mesh = voxtool.mesh_from_arrays(*meshes.join(
        meshes.icosphere(1, rng.uniform(-1, 1, 3).tolist(), 1.5),
        meshes.box((0, 0, 0), rng.uniform(1, 3, 3).tolist()),
    ))  # fmt: skip
    grid = voxtool.Grid.fit(mesh, 28, margin=8)
    octree = voxtool.voxelize(mesh, grid, fill="winding", device=device)
    surface = voxtool.repair(mesh, grid, fill="winding", device=device).mesh()
    distance = TriangleDistance(surface, device)
    centres = grid.to_world(np.indices(grid.shape).reshape(3, -1).T + 0.5)
    far, held = distance(centres), octree.to_dense().ravel()
    for reach in (0.7 * grid.pitch[0], 2.3 * grid.pitch[0], 5 * grid.pitch[0]):
        for change, expected in ((within, held | (far <= reach)), (beyond, held & (far > reach))):
            found = change(octree, distance, reach, device)
            assert found == Octree.from_dense(
                expected.reshape(grid.shape), grid.origin, grid.pitch
            ), (change, reach)
    onto, reach = TriangleDistance(mesh, device), 1.2 * grid.pitch[0]
    touched = voxtool.voxelize(mesh, grid, "surface26", device=device)
    near = (onto(centres) <= reach).reshape(grid.shape)
    assert plate(touched, onto, reach, device) == Octree.from_dense(near, grid.origin, grid.pitch)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"shell": 0.05}, r"wall 0\.05 is 0\.6 voxels of 0\.08333, of 2 at least: give 0\.1667 or"),
        ({"thicken": 0.05}, r"wall 0\.05 is 0\.6 voxels"),
        (
            {"offset": 0.07},
            r"offset 0\.07 is 0\.84 voxels of 0\.08333, of 0\.866 at least: give 0\.07217",
        ),
        ({"offset": -0.001}, r"offset -0\.001 is 0\.012 voxels"),
        ({"shell": 0.3, "offset": 1.0}, "exclude each other"),
        ({"drains": [(0, 0, 1, 0.3)]}, "drains go with a shell"),
        ({"shell": 0.3, "drains": [(0, 0, 1, 0.01)]}, "a radius of"),
        ({"shell": 0.3, "drains": [(0, 0, 1)]}, "give x, y, z"),
        ({"shell": float("nan")}, "not finite"),
        ({"shell": 0.99}, "leaves no cavity"),
        ({"offset": -1.5}, "nothing is left"),
        ({"offset": 20.0}, "128 voxels that are allowed"),
        ({"shell": 1e300}, "128 voxels that are allowed"),
    ],
)
def test_refusals(request_: dict, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message):
        voxtool.repair(BALL, dim=32, **request_)
