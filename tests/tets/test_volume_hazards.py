"""What may go wrong on a ray: what is left over in memory, an eye on a vertex, rays beside edges of
notches, many entries, values beyond the ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_volume import (
    SIX,
    Pictures,
    grid_corners,
    grid_points,
    mesh_of,
    ramp,
    rays_of,
    reference_picture,
    tet_grid,
)

from voxtool.camera import Camera
from voxtool.choices import METHODS
from voxtool.errors import MemoryLimitError
from voxtool.opencl import Device
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction

NEAR = 2e-5
GREY = TransferFunction(np.array([0.0]), np.full((1, 3), 0.5), np.array([0.7]))
LAYER = TransferFunction(np.array([0.5, 0.8, 1.1]), np.eye(3), np.array([0.0, 9.0, 0.0]))


def wavy(points: np.ndarray) -> np.ndarray:
    return np.sin(3 * points[:, 0]) + points[:, 1] * points[:, 2]


def layered_meshes() -> dict[str, tuple[UnstructuredMesh, str]]:
    """Of each layout one whose first blocks of cells LAYER leaves out."""
    shape = (7, 6, 8)
    points, cells = tet_grid(shape, seed=9, holes=0.1)
    diagonal = points.sum(axis=1)
    corners = grid_corners(shape)
    straight = grid_points(shape) / (np.array(shape) / 2) - 1
    boxes = ("hexahedron", corners[:, [0, 4, 6, 2, 1, 5, 7, 3]])
    middles = straight[corners].mean(axis=1).sum(axis=1)
    linear = mesh_of(points, cells, diagonal)
    return {
        "linear": (linear, "raycast"),
        "anchored": (linear, "projection"),
        "constant": (mesh_of(points, cells, [diagonal[cells].mean(axis=1)]), "raycast"),
        "hexahedra": (UnstructuredMesh(straight, [boxes], [middles], "s"), "hexahedra"),
    }


@pytest.mark.parametrize("kind", ["linear", "anchored", "constant", "hexahedra"])
@pytest.mark.parametrize("method", METHODS)
def test_what_memory_held_before_never_shows(device, kind, method, monkeypatch) -> None:
    """NaN, infinity, huge numbers and denormals in new memory: the same picture."""
    empty, words = Device.empty, [0]

    def dirty(self, size, dtype):
        array = empty(self, size, dtype)
        count = -(-max(size * np.dtype(dtype).itemsize, 4) // 4)
        self.write(array, np.full(count, words[0], np.uint32))
        return array

    mesh, layout = layered_meshes()[kind]
    volume = Pictures(build_tet(mesh, layout), device)
    assert not volume.scene(LAYER).blocks[0]
    views = [
        rays_of(mesh, "iso", None, (19, 17)),
        Camera((0.35, 0.35, 0.4), (0.1, -0.3, 0.2), fov=100.0).rays(19, 17),
    ]
    monkeypatch.setattr(Device, "empty", dirty)
    for rays in views:
        for integrator in ("linear", "average", "sampled:2", "preintegrated"):
            pictures = []
            for word in (0, 0x7FC00000, 0x7F800000, 0xFF7FFFFF, 1):
                words[0] = word
                pictures.append(volume.render(rays, LAYER, method, integrator))
            assert pictures[0].any()
            assert np.isfinite(pictures[0]).all()
            assert len({picture.tobytes() for picture in pictures}) == 1, integrator


@pytest.mark.parametrize("holes", [0.0, 0.4])
def test_an_eye_on_vertices_edges_and_faces(device, holes) -> None:
    """Cells meet there that are no neighbours of each other, where others are gone."""
    points, cells = tet_grid((4, 4, 4), seed=2, holes=holes)
    mesh, transfer = mesh_of(points, cells, wavy(points)), ramp(-1.5, 1.5, 2.0)
    volume, random = Pictures(build_tet(mesh), device), np.random.default_rng(3)
    for corners in points[cells[random.permutation(len(cells))[:8]]]:
        for count in (1, 2, 3):
            eye = corners[:count].mean(axis=0)
            way = random.normal(size=3)
            rays = Camera(tuple(eye), tuple(eye + way), fov=120.0).rays(24, 20)
            error = np.abs(volume.render(rays, transfer) - reference_picture(mesh, transfer, rays))
            # a ray along a face that begins on it may have either side
            assert np.count_nonzero(error.max(axis=2) > 1e-3) <= 1
            assert np.sort(error.max(axis=2).ravel())[-3] < 1e-3


@pytest.mark.parametrize("way", [(1, -1, 0), (1, 2, 0), (1, 1, 0), (0, 0, 1)])
def test_rays_through_the_edges_of_notches(device, way) -> None:
    """Rays straight through the edges between boxes of which a third is gone. A ray on an edge may
    have what is on either side, but it must not end there."""
    shape = (8, 8, 8)
    kept = np.random.default_rng(0).random(512) > 0.3
    points = grid_points(shape) / 4 - 1
    mesh = mesh_of(points, grid_corners(shape)[kept][:, SIX].reshape(-1, 4), points[:, 0])
    eye = tuple(-5.0 * np.array(way))
    up = (0, 1, 0) if way == (0, 0, 1) else (0, 0, 1)
    rays = Camera(eye, (0, 0, 0), up, fov=None, height=49 * 0.125 * 0.5**0.5).rays(49, 49)
    found = Pictures(build_tet(mesh), device).render(rays, GREY)
    error = np.full((49, 49), np.inf)
    for x, y in ((0, 0), (1, 2), (2, -1), (-1, -2), (-2, 1), (1, -2), (-1, 2), (2, 1), (-2, -1)):
        aside = 1e-5 * (x * rays.right + y * rays.down)
        wanted = reference_picture(mesh, GREY, replace(rays, origin=rays.origin + aside))
        error = np.minimum(error, np.abs(found - wanted).max(axis=2))
    assert error.max() < 1e-4


def test_many_entries_are_sorted(device) -> None:
    """A thousand cells behind each other that are no neighbours, in any order."""
    depths = np.random.default_rng(5).permutation(1000)
    corners = np.array([(-1, -1, 0), (3, -1, 0), (-1, 3, 0), (0, 0, 0.5)])
    points = (corners + depths[:, None, None] * (0, 0, 1)).reshape(-1, 3)
    cells = np.arange(4000).reshape(-1, 4)
    mesh = mesh_of(points, cells, np.repeat(depths % 7, 4))
    transfer = ramp(0, 6, 0.02, steps=7)
    for z in (-9.0, 1009.0):
        rays = Camera((0, 0, z), (0, 0, 500), fov=None, height=0.1).rays(3, 3)
        wanted = reference_picture(mesh, transfer, rays)
        found = Pictures(build_tet(mesh), device).render(rays, transfer)
        assert 0.5 < wanted[..., 3].max() < 1
        assert np.abs(found - wanted).max() < 5e-3


def test_more_entries_than_are_counted_are_refused(device) -> None:
    points, cells = tet_grid((2, 2, 2), seed=1)
    mesh = mesh_of(points, cells, wavy(points))
    volume = Pictures(build_tet(mesh), device)
    with pytest.raises(MemoryLimitError, match="smaller picture"):
        volume.render(rays_of(mesh, "iso", None), GREY, max_entries=10)


def test_pictures_beyond_memory_are_refused_at_once(device, monkeypatch) -> None:
    points, cells = tet_grid((2, 2, 2), seed=1)
    mesh = mesh_of(points, cells, wavy(points))
    volume = Pictures(build_tet(mesh), device)
    monkeypatch.setattr(device, "info", replace(device.info, max_allocation=16 * 40 * 32 - 1))
    for method in METHODS:
        with pytest.raises(MemoryLimitError, match="40 x 32 pixels"):
            volume.render(rays_of(mesh, "iso", None), GREY, method)


@pytest.mark.parametrize("fov", [None, 40.0])
def test_opaque_pictures_end_at_one(device, fov) -> None:
    """No colour and no alpha beyond 1, by any integrator, however opaque."""
    points, cells = tet_grid((3, 3, 3), seed=6)
    for scalars in (wavy(points), [wavy(points[cells].mean(axis=1))]):
        mesh = mesh_of(points, cells, scalars)
        volume, rays = Pictures(build_tet(mesh), device), rays_of(mesh, "iso", fov)
        for extinction in (1e2, 1e6, 1e20):
            white = replace(ramp(-1.5, 1.5, extinction), colours=np.ones((4, 3)))
            for method in METHODS:
                for integrator in ("linear", "average", "sampled:3", "preintegrated"):
                    found = volume.render(rays, white, method, integrator)
                    assert found.min() >= 0
                    assert found[..., 3].max() <= 1
                    assert found.max() <= 1 + 1e-6
