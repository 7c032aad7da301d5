"""The device's answer whether a mesh is watertight, against the sorted edges of the host."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.mesh import topology, watertight
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device

POINTS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-0.0, 0, 0), (1, 0, 0)], float)
WHOLE = [[0, 2, 1], [4, 1, 3], [1, 2, 3], [2, 0, 3]]  # a tetrahedron of two vertices at a position


@given(
    more=st.lists(st.lists(st.integers(0, 5), min_size=3, max_size=3), max_size=6),
    whole=st.booleans(),
)
@settings(max_examples=100, deadline=None)
def test_any_faces(device: Device, more: list[list[int]], whole: bool) -> None:
    mesh = Mesh(POINTS, np.array(WHOLE * whole + more, np.int32).reshape(-1, 3))
    assert watertight.watertight(mesh, device) == topology.watertight(mesh)


def fan(sides: int) -> tuple[np.ndarray, np.ndarray]:
    """A double cone about a polygon: two vertices with `sides` edges."""
    angles = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    i = np.arange(sides)
    up, down = np.full(sides, sides), np.full(sides, sides + 1)
    faces = [np.stack([i, np.roll(i, -1), up], 1), np.stack([np.roll(i, -1), i, down], 1)]
    return np.concatenate([[[0, 0, 1], [0, 0, -1]], rim]), (np.concatenate(faces) + 2) % (sides + 2)


@pytest.mark.parametrize("shape", ["sphere", "soup", "star", "fan"])
def test_large_meshes(device: Device, shape: str) -> None:
    """Closed, with one face fewer, and with one turned. A list of the star does not fit at its
    vertex, and the fan is left to the host."""
    sizes = {"star": 200, "fan": 2000}
    vertices, faces = fan(sizes[shape]) if shape in sizes else meshes.icosphere(3)
    if shape == "soup":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    turned = faces.copy()
    turned[7] = turned[7, ::-1]
    for some, expected in ((faces, True), (faces[1:], False), (turned, False)):
        mesh = Mesh(vertices, np.ascontiguousarray(some, np.int32))
        assert watertight.watertight(mesh, device) is expected


@pytest.mark.parametrize("copies", [2, 3])
def test_a_fan_of_repeated_faces(device: Device, copies: int) -> None:
    """Every edge has several faces in each direction."""
    vertices, faces = fan(100)
    mesh = Mesh(vertices, np.tile(faces, (copies, 1)).astype(np.int32))
    assert not watertight.watertight(mesh, device)


def test_faces_without_area_have_no_edges(device: Device) -> None:
    assert not watertight.watertight(
        Mesh(POINTS, np.array([[0, 4, 1], [2, 2, 3]], np.int32)), device
    )
