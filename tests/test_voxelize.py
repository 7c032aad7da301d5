"""The voxelizer against the oracles, analytic solids and invariants, on every device."""

from __future__ import annotations

import meshes
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.octree import Octree, morton_decode
from voxtool.svo.voxelize import plan_voxelize, voxelize

MODES = ("surface26", "surface6", "solid")
SHAPES = st.sampled_from([(8, 8, 8), (16, 16, 16), (16, 9, 5), (7, 12, 16), (24, 20, 30)])


def lattice_grid(shape) -> Grid:
    """A grid whose units are the world's."""
    return Grid(tuple(shape), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def lattice_mesh(vertices, faces) -> Mesh:
    """A mesh of vertices given in 1/256 voxel."""
    return Mesh(
        np.ascontiguousarray(np.asarray(vertices, np.float64).reshape(-1, 3) / 256),
        np.ascontiguousarray(faces, np.int32),
    )


def run(device, mesh, shape, mode, **options) -> Octree:
    octree = voxelize(lattice_mesh(*mesh), lattice_grid(shape), mode, device=device, **options)
    octree.validate()
    return octree


def assert_contract(octree: Octree, triangles, solid: bool) -> None:
    """The octree refines exactly the nodes that its contract names."""
    active = oracles.active_nodes(triangles, octree.grid.shape, solid)
    expected = oracles.expected_octree_nodes(active, octree.to_dense())
    for level in octree.levels():
        if level.number == 0:
            continue
        cells = morton_decode(level.codes)
        assert {tuple(c) for c in cells[level.refined].tolist()} == expected.refined[level.number]
        assert {tuple(c) for c in cells[level.inside].tolist()} == expected.inside[level.number]


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=60)
def test_any_triangles_agree_with_the_oracles(device: Device, data, shape) -> None:
    vertices, faces = data.draw(meshes.fixed_triangles(shape))
    triangles = vertices[faces]
    for mode in MODES:
        octree = run(device, (vertices, faces), shape, mode)
        expected = getattr(oracles, mode)(triangles, shape)
        assert {tuple(v) for v in octree.occupied().tolist()} == expected, mode
        assert octree.count == len(expected)
        assert_contract(octree, triangles, mode == "solid")


@given(data=st.data(), shape=SHAPES)
@settings(max_examples=40)
def test_closed_meshes_agree_with_the_oracles(device: Device, data, shape) -> None:
    vertices, faces = data.draw(meshes.closed_meshes(shape))
    triangles = vertices[faces]
    solid = run(device, (vertices, faces), shape, "solid")
    assert {tuple(v) for v in solid.occupied().tolist()} == oracles.solid(triangles, shape)
    assert_contract(solid, triangles, True)
    both = run(device, (vertices, faces), shape, "solid", with_surface=True)
    surface = run(device, (vertices, faces), shape, "surface26")
    assert np.array_equal(both.to_dense(), solid.to_dense() | surface.to_dense())
