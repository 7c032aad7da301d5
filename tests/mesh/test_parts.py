"""Parts of a mesh, compared with its shells, which edges connect."""

from __future__ import annotations

import numpy as np
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.mesh.loops import find_loops
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.parts import Parts, find_parts
from voxtool.mesh.shells import find_shells
from voxtool.mesh.topology import boundary_of, topology_of
from voxtool.opencl import Device
from voxtool.svo.voxelization.fill.caps import find_boundary


def parts_of(mesh: Mesh, device: Device) -> Parts:
    return find_parts(mesh, mesh.vertices, find_boundary(mesh).edges, device)


def spheres(cut: list[list[int]], split: bool) -> Mesh:
    """Spheres along x without some faces, every second one inside out; `split`: each face has its
    own vertices."""
    vertices, faces = [], []
    for i, holes in enumerate(cut):
        points, triangles = meshes.icosphere(1, (3.0 * i, 0, 0))
        triangles = np.delete(triangles, holes, axis=0)
        vertices.append(points)
        faces.append((triangles[:, ::-1] if i % 2 else triangles) + len(points) * i)
    points, triangles = np.concatenate(vertices), np.concatenate(faces)
    if split:
        points, triangles = points[triangles].reshape(-1, 3), np.arange(3 * len(triangles))
    return Mesh(points, triangles.reshape(-1, 3).astype(np.int32))


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.lists(st.integers(0, 79), max_size=1), min_size=1, max_size=4),
    st.booleans(),
)
def test_volumes_and_boxes_are_those_of_shells(device: Device, cut, split: bool) -> None:
    mesh = spheres(cut, split)
    topology = topology_of(mesh)
    shells = find_shells(mesh, topology, find_loops(mesh, topology))
    parts = parts_of(mesh, device)
    along, order = np.argsort(parts.low[:, 0]), np.argsort(shells.low[:, 0])
    assert np.allclose(parts.volumes[along], shells.volumes[order], rtol=0, atol=1e-12)
    assert np.array_equal(parts.low[along], shells.low[order])
    assert np.array_equal(parts.high[along], shells.high[order])


def test_shells_that_touch_at_a_vertex_are_one_part(device: Device) -> None:
    mesh = meshes.mesh_of(*meshes.join(meshes.box(0, 1), meshes.box(1, 3)))
    parts = parts_of(mesh, device)
    assert parts.volumes.tolist() == [9]
    assert (parts.low.tolist(), parts.high.tolist()) == ([[0, 0, 0]], [[3, 3, 3]])


def test_points_and_segments_are_of_no_part(device: Device) -> None:
    vertices, faces = meshes.tetrahedron()
    proper = meshes.mesh_of(vertices, faces)
    more = meshes.mesh_of(vertices, [[0, 0, 1], *faces, [2, 2, 2]])
    assert not len(boundary_of(proper.faces))
    assert parts_of(more, device).volumes.tolist() == parts_of(proper, device).volumes.tolist()
    nothing = meshes.mesh_of(vertices, [[0, 0, 1]])
    assert len(parts_of(nothing, device).volumes) == 0
