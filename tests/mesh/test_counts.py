"""The device's counts of edges, shells and others, against those of the host."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.mesh import counts, topology
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device

POINTS = np.array([
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-0.0, 0, 0), (1, 0, 0),
    (2, 0, 0), (3, 0, 0), (1, 1e-300, 0), (2, 1e-17, 3e-17),
], float)  # fmt: skip
WHOLE = [[0, 2, 1], [4, 1, 3], [1, 2, 3], [2, 0, 3]]  # a tetrahedron of two vertices at a position


def same(mesh: Mesh, device: Device) -> None:
    assert counts.check_topology(mesh, device) == topology.check_topology(mesh)


@given(
    more=st.lists(st.lists(st.integers(0, 9), min_size=3, max_size=3), max_size=12),
    whole=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_any_faces(device: Device, more: list[list[int]], whole: bool) -> None:
    same(Mesh(POINTS, np.array(WHOLE * whole + more, np.int32).reshape(-1, 3)), device)


@pytest.mark.parametrize("sides", [100, 250, 2000])
@pytest.mark.parametrize("copies", [1, 2, 3])
def test_fans(device: Device, sides: int, copies: int) -> None:
    """Edges of several faces in each direction, and a vertex with too many sides for a list."""
    angles = 2 * np.pi * np.arange(sides) / sides
    rim = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    i = np.arange(sides) + 1
    faces = np.stack([0 * i, i, np.roll(i, -1)], axis=1)
    faces = np.concatenate([faces, faces[::3], faces[: sides // 2, ::-1]])
    mesh = Mesh(np.concatenate([[[0, 0, 1]], rim]), np.tile(faces, (copies, 1)).astype(np.int32))
    same(mesh, device)


@pytest.mark.parametrize("shells", [1, 5])
def test_shells(device: Device, shells: int) -> None:
    """Closed, without some faces, with some turned, with every corner a vertex of its own."""
    pair = meshes.icosphere(3)
    vertices, faces = meshes.join(*[(pair[0] + 3.0 * i, pair[1]) for i in range(shells)])
    turned = faces.copy()
    turned[7::31] = turned[7::31, ::-1]
    for some in (
        faces,
        faces[::2],
        turned,
        faces[np.random.default_rng(1).permutation(len(faces))],
    ):
        mesh = Mesh(vertices, np.ascontiguousarray(some, np.int32))
        same(mesh, device)
        same(
            Mesh(
                vertices[some].reshape(-1, 3), np.arange(some.size, dtype=np.int32).reshape(-1, 3)
            ),
            device,
        )
