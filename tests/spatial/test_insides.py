"""Sides passed on from few points against a winding number for every point, and solid angles."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers import meshes
from helpers.distance import around
from helpers.meshes import mesh_of
from helpers.signs import winding

from voxtool.adf.construction.survey import Survey
from voxtool.spatial.signed_distance import NUMBERED, SignedDistance
from voxtool.spatial.winding_number import WindingNumber

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

ERROR = 1e-3  # of winding numbers
CLEAR = 1e-12  # beyond this from the surface, its rounding decides no sign


def half_ball() -> meshes.Mesh:
    vertices, faces = meshes.icosphere(3)
    return vertices, faces[vertices[faces][:, :, 2].min(axis=1) >= -1e-9]


def torn_torus() -> meshes.Mesh:
    vertices, faces = meshes.torus(sides=(24, 12))
    return vertices, faces[np.arange(len(faces)) % 10 != 0]


def crossing_balls() -> meshes.Mesh:
    (one, faces), (other, _) = meshes.icosphere(2), meshes.icosphere(2, centre=0.7)
    return np.concatenate([one, other]), np.concatenate([faces, faces[:, ::-1] + len(one)])


def repeated_box() -> meshes.Mesh:
    vertices, faces = meshes.open_box(0, (4, 3, 2))
    return vertices, np.concatenate([faces, faces[:5], faces[2:4, [1, 0, 2]]])


SCENES = {
    "half a ball": half_ball,
    "torn torus": torn_torus,
    "balls that cross": crossing_balls,
    "lidless box, faces repeated": repeated_box,
    "loose triangles": lambda: meshes.random_triangles(np.random.default_rng(3), 60, size=1.0),
}


@cache
def scene(name: str) -> tuple[Mesh, np.ndarray]:
    """A mesh, and points in its box and beside it, some far away, and some on it."""
    mesh, rng = mesh_of(*SCENES[name]()), np.random.default_rng(4)
    low, high = mesh.bounds
    spread = (high - low).max()
    inside = rng.uniform(low - 0.2 * spread, high + 0.2 * spread, (NUMBERED, 3))
    near = around(mesh, rng, 150, 0.02)
    return mesh, np.concatenate([inside, near, 1e3 * near[:50], mesh.vertices[:50]])


@pytest.mark.parametrize("name", SCENES)
def test_sides_are_those_of_every_number(device: Device, name: str) -> None:
    mesh, points = scene(name)
    found = SignedDistance(mesh, "winding", device)(points)
    numbers = WindingNumber(mesh, device)(points)
    assert np.array_equal(found < 0, (numbers > 0.5) & (found != 0))


@pytest.mark.parametrize("name", ["half a ball", "torn torus", "balls that cross"])
def test_sides_are_those_of_solid_angles(device: Device, name: str) -> None:
    mesh, points = scene(name)
    points = points[::3]
    points = np.concatenate([points, points, points])  # at least NUMBERED
    found = SignedDistance(mesh, "winding", device)(points)
    third = len(points) // 3
    numbers = winding(points[:third], mesh.vertices[mesh.faces])
    clear = (np.abs(numbers - 0.5) > ERROR) & (np.abs(found[:third]) > CLEAR)
    assert np.array_equal(found[:third][clear] < 0, numbers[clear] > 0.5)
    assert 0.02 < (numbers > 0.5).mean() < 0.98
    for copy in (found[third : 2 * third], found[2 * third :]):
        assert np.array_equal(copy, found[:third])


def test_few_points_need_a_number(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, points = scene("balls that cross")
    counts, wind = [], WindingNumber.wind

    def counted(self: WindingNumber, n: int, *args: Any) -> None:
        counts.append(n)
        wind(self, n, *args)

    measure = SignedDistance(mesh, "winding", device)
    monkeypatch.setattr(WindingNumber, "wind", counted)
    measure(points)
    assert len(counts) == 4
    assert sum(counts) < len(points) / 3
    measure(points[: NUMBERED - 1])
    assert counts[4:] == [NUMBERED - 1]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_face_that_is_a_point_beside_a_huge_one_has_no_side(device: Device) -> None:
    """In local coordinates its vertices are one, so its normal has no length to rise by."""
    small, huge = np.eye(3), 1e38 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    mesh = mesh_of(np.concatenate([small, huge]), [(0, 1, 2), (3, 4, 5), (3, 5, 6)])
    sides = Survey(mesh, device, signed=True).sides
    sides.find(np.arange(3))
    assert np.isnan(sides.front).tolist() == [True, False, False]
