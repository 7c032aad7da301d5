"""Shells and patches: volumes, what is flipped, and which shell holds which."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.files.meshes.mesh import load_mesh
from voxtool.mesh.loops import find_loops
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.shells import Patches, Shells, find_patches, find_shells
from voxtool.mesh.topology import topology_of, volume
from voxtool.opencl import Device
from voxtool.spatial.fill_rule import meeting_faces
from voxtool.spatial.nesting import Nesting, nest
from voxtool.spatial.self_intersections import crossing_shells

MOEBIUS = [(i, (i + 1) % 5, (i + 2) % 5) for i in range(5)]  # five vertices, five triangles


def mesh_of(pair) -> Mesh:
    vertices, faces = pair
    return Mesh(np.asarray(vertices, np.float64), np.asarray(faces).astype(np.int32))


def shells_of(mesh: Mesh) -> Shells:
    topology = topology_of(mesh)
    return find_shells(mesh, topology, find_loops(mesh, topology))


def patches_of(mesh: Mesh) -> Patches:
    return find_patches(mesh, topology_of(mesh))


def turned(pair):
    vertices, faces = pair
    return vertices, faces[:, ::-1]


# Shells


def test_shells_of_a_scene() -> None:
    mesh = mesh_of(
        meshes.join(
            meshes.open_box(0, (4, 3, 2)), meshes.icosphere(2, 20), turned(meshes.box(9, 11))
        )
    )
    shells = shells_of(mesh)
    assert shells.faces.tolist() == [320, 12, 10]
    assert shells.closed.tolist() == [True, True, False]
    assert shells.consistent.all()
    assert shells.loops.tolist() == [0, 0, 1]
    sphere = volume(mesh_of(meshes.icosphere(2)))
    assert shells.volumes == pytest.approx([sphere, -8, 24], rel=1e-12)
    assert shells.low.tolist()[1:] == [[9, 9, 9], [0, 0, 0]]
    assert shells.high.tolist()[1:] == [[11, 11, 11], [4, 3, 2]]
    assert (shells.of == np.repeat([2, 0, 1], [10, 320, 12])).all()


def test_what_has_no_volume() -> None:
    flipped = meshes.box(0, 2)
    flipped[1][3] = flipped[1][3, ::-1]
    book = (np.random.default_rng(0).random((5, 3)), [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    for pair, closed in ((flipped, True), (book, False), ((book[0], MOEBIUS), False)):
        shells = shells_of(mesh_of(pair))
        assert shells.closed.tolist() == [closed]
        assert shells.consistent.tolist() == [False]
        assert math.isnan(shells.volumes[0])


def test_faces_that_are_points_or_segments_are_of_no_shell() -> None:
    vertices, faces = meshes.tetrahedron()
    mesh = mesh_of((vertices, [[0, 0, 1], *faces, [2, 2, 2]]))
    shells, patches = shells_of(mesh), patches_of(mesh)
    for of in (shells.of, patches.of):
        assert of.tolist() == [-1, 0, 0, 0, 0, -1]
    only = mesh_of((vertices, [[0, 0, 1]]))
    assert len(shells_of(only).faces) == len(patches_of(only).areas) == 0


def test_the_volume_of_the_bunny_is_that_with_its_holes_capped() -> None:
    mesh = load_mesh(model("stanford-bunny.obj"))
    loops = find_loops(mesh, topology_of(mesh))
    middles = (loops.low + loops.high) / 2
    apex = len(mesh.vertices) + np.repeat(np.arange(len(middles)), loops.sizes)
    caps = np.stack([apex, loops.edges[:, 1], loops.edges[:, 0]], axis=1)
    capped = mesh_of((np.concatenate([mesh.vertices, middles]), np.concatenate([mesh.faces, caps])))
    assert not len(find_loops(capped, topology_of(capped)).edges)
    assert shells_of(mesh).volumes == pytest.approx([volume(capped)], rel=1e-9)


# Patches


def test_a_cube_with_flipped_faces() -> None:
    vertices, faces = meshes.box(0, 2)
    faces[[4, 5]] = faces[[4, 5], ::-1]  # one side
    patches = patches_of(mesh_of((vertices, faces)))
    assert patches.areas.tolist() == [20, 4]
    assert patches.flipped.tolist() == [False, True]
    assert np.flatnonzero(patches.of == 1).tolist() == [4, 5]
    assert not patches.one_sided.any()


def test_patches_that_agree_are_one() -> None:
    for pair in (meshes.box(0, 1), turned(meshes.box(0, 1)), meshes.torus(), meshes.open_box(0, 1)):
        patches = patches_of(mesh_of(pair))
        assert len(patches.areas) == 1
        assert not (patches.flipped | patches.one_sided).any()


def test_a_moebius_band_has_one_side() -> None:
    vertices = np.random.default_rng(0).random((5, 3))
    far = meshes.box(10, 11)
    far[1][0] = far[1][0, ::-1]
    patches = patches_of(mesh_of(meshes.join((vertices, np.array(MOEBIUS)), far)))
    band = np.unique(patches.of[:5])
    assert patches.one_sided[band].all()
    assert not patches.flipped[band].any()
    assert np.count_nonzero(patches.flipped) == 1  # of the box
    assert patches.flipped[patches.of[5]]


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.45))
@settings(max_examples=60)
def test_what_was_flipped_is_found(seed: int, share: float) -> None:
    """Faces of a sphere turned over at random, less than half of its area."""
    vertices, faces = meshes.icosphere(2)
    rng = np.random.default_rng(seed)
    over = rng.permutation(len(faces))[: int(share * len(faces))]
    faces[over] = faces[over, ::-1]
    patches = patches_of(mesh_of((vertices, faces)))
    assert np.flatnonzero(patches.flipped[patches.of]).tolist() == sorted(over.tolist())
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    for patch, area in enumerate(patches.areas):
        assert area == pytest.approx(areas[patches.of == patch].sum(), rel=1e-12)


# Nesting


def nesting_of(mesh: Mesh, device: Device) -> Nesting:
    shells = shells_of(mesh)
    crossing, clear = crossing_shells(device, mesh, shells.of, meeting_faces(mesh, device))
    return nest(mesh, shells, crossing[clear], device)


def nested(device: Device, *parts) -> Nesting:
    mesh = mesh_of(meshes.join(*parts))
    return nesting_of(mesh, device)


def test_spheres_in_spheres(device: Device) -> None:
    """Numbers are by faces: the finest is the first."""
    balls = [
        meshes.icosphere(3, 0, 10.0), meshes.icosphere(2, (1, 0, 0), 5.0),
        turned(meshes.icosphere(1, (2, 0, 0), 2.0)), meshes.icosphere(0, (-6, 0, 0), 1.0),
    ]  # fmt: skip
    found = nested(device, *balls)
    assert found.parents.tolist() == [-1, 0, 1, 0]
    assert found.depths.tolist() == [0, 1, 2, 1]


def test_what_is_open_or_overlaps_holds_nothing(device: Device) -> None:
    within = meshes.tetrahedron((4, 4, 4), (5, 4, 4), (4, 5, 4), (4, 4, 5))
    assert nested(device, meshes.box(0, 9), within).parents.tolist() == [-1, 0]
    assert nested(device, meshes.open_box(0, 9), within).parents.tolist() == [-1, -1]
    assert nested(device, meshes.box(0, 9), meshes.box(4, 13)).parents.tolist() == [-1, -1]
    # within the box of a torus, but in its hole
    assert nested(device, meshes.torus(), meshes.octahedron(0, 0.5)).parents.tolist() == [-1, -1]
    at_the_tube = meshes.octahedron((2, 0, 0), 0.5)
    assert nested(device, meshes.torus(), at_the_tube).parents.tolist() == [-1, 0]


@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
@settings(max_examples=15)
def test_octahedra(device: Device, seed: int, n: int) -> None:
    """Parents of random octahedra are innermost among those that hold them by their norm."""
    rng = np.random.default_rng(seed)
    radii = np.sort(rng.uniform(0.5, 10, n))[::-1]
    centres = rng.uniform(-5, 5, (n, 3))
    centres[1:] *= rng.choice([0.1, 1], (n - 1, 1))
    mesh = mesh_of(
        meshes.join(
            *(
                meshes.octahedron(centre, radius) if rng.random() < 0.5
                else turned(meshes.octahedron(centre, radius))
                for centre, radius in zip(centres, radii, strict=True)
            )
        )
    )  # fmt: skip
    # a vertex c + r e is in another where |c + r e - c'| < r' in the norm of the octahedron
    arms = np.concatenate([np.eye(3), -np.eye(3)])
    tips = centres[:, None] + radii[:, None, None] * arms
    apart = np.abs(tips[None] - centres[:, None, None]).sum(axis=-1)
    holds = (apart < radii[:, None, None]).all(axis=-1) & ~np.eye(n, dtype=bool)
    found = nesting_of(mesh, device)
    for shell, parent in enumerate(found.parents.tolist()):
        if parent < 0:  # octahedra that intersect may both hold it: then it has either as parent
            assert not holds[:, shell].any()
            assert found.depths[shell] == 0
        else:
            assert holds[parent, shell]
            assert not (holds[parent] & holds[:, shell]).any()  # none is between them
            assert found.depths[shell] == found.depths[parent] + 1
