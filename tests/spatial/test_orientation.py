"""Faces turned outward: lines against rational crossings, and meshes whose directions are known."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import model
from helpers import meshes

from voxtool.files.meshes.mesh import load_mesh
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.crossings import count_crossings
from voxtool.spatial.orientation import orient

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device


def reversed_where(mesh: Mesh, wrong: np.ndarray) -> Mesh:
    faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)
    return replace(mesh, faces=np.ascontiguousarray(faces))


def determinant(a, b, c) -> Fraction:
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        - a[1] * (b[0] * c[2] - b[2] * c[0])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def crossed(point, along, triangles) -> tuple[int, int]:
    """How many triangles a line crosses ahead of a point and behind it, in rational arithmetic."""
    d, found = [Fraction(x) for x in along.tolist()], [0, 0]
    p = [Fraction(x) for x in point.tolist()]
    for triangle in triangles.tolist():
        a, b, c = ([Fraction(x) - y for x, y in zip(v, p, strict=True)] for v in triangle)
        sides = [determinant(d, *ends) for ends in ((a, b), (b, c), (c, a))]
        assert 0 not in sides
        if len({side > 0 for side in sides}) == 1:
            found[determinant(a, b, c) * sum(sides) < 0] += 1
    return found[0], found[1]


def test_crossings_on_both_sides_of_a_point(device: Device) -> None:
    rng = np.random.default_rng(3)
    vertices, faces = meshes.random_triangles(rng, 60)
    mesh = meshes.mesh_of(vertices, faces)
    tree = build_tree(device, mesh)
    triangles = tree.frame.local(mesh.vertices)[mesh.faces]
    own = np.repeat(np.arange(60), 2)
    points, along = triangles[own].mean(axis=1), rng.standard_normal((120, 3))
    ahead, behind = count_crossings(device, mesh, tree, points, along, own)
    expected = [
        crossed(p, d, np.delete(triangles, i, axis=0))
        for p, d, i in zip(points, along, own.tolist(), strict=True)
    ]
    assert list(zip(ahead.tolist(), behind.tolist(), strict=True)) == expected
    assert (ahead.max(), behind.max()) > (3, 3)


def test_a_line_through_edges_and_vertices_crosses_a_closed_mesh_evenly(device: Device) -> None:
    """Lines from the middles of a grid's triangles through its vertices and along its edges."""
    mesh = meshes.mesh_of(*meshes.join(meshes.box(0, 4), meshes.octahedron((2, 2, 2), 8)))
    tree = build_tree(device, mesh)
    local = tree.frame.local(mesh.vertices)
    own = np.repeat(np.arange(len(mesh.faces)), len(local))
    points = local[mesh.faces[own]].mean(axis=1)
    ends = np.tile(local, (len(mesh.faces), 1))
    off = (ends != local[mesh.faces[own]].transpose(1, 0, 2)).any(axis=2).all(axis=0)
    ahead, behind = count_crossings(device, mesh, tree, points[off], (ends - points)[off], own[off])
    one, other = (local[mesh.faces[own[off], k]] - points[off] for k in (0, 1))
    normal = np.cross(one, other)
    across = (normal * (ends - points)[off]).sum(axis=1) != 0
    assert ((ahead + behind) % 2 == 1)[across].all()
    assert np.count_nonzero(across) > 100


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_faces_of_closed_shells_in_shells(device: Device, share: float) -> None:
    """A torus beside a sphere that has a cavity with a solid in it; the cavity faces inward."""
    cavity = meshes.icosphere(2, 0, 3.0)
    parts = (
        meshes.icosphere(2, 0, 4.0),
        (cavity[0], cavity[1][:, ::-1]),
        meshes.box(-1, 1),
        meshes.torus((9, 0, 0)),
    )
    mesh = meshes.mesh_of(*meshes.join(*parts))
    wrong = np.random.default_rng(1).random(len(mesh.faces)) < share
    found = orient(reversed_where(mesh, wrong), device)
    assert np.array_equal(found.reversed, wrong)
    assert (found.sheets, found.kept) == (4, 0)
    assert found.counted == 2  # neither the cavity nor what it holds is seen
    if share == 0:
        assert found.mesh.faces is mesh.faces or np.array_equal(found.mesh.faces, mesh.faces)


def test_copies_get_one_direction(device: Device) -> None:
    """Faces twice, faces with their opposites, and three copies with other first corners."""
    vertices, faces = meshes.icosphere(1)
    copies = np.concatenate([faces, np.roll(faces, 1, axis=1), faces[::3, ::-1], faces[:20]])
    mesh = meshes.mesh_of(vertices, copies)
    found = orient(mesh, device)
    opposite = np.zeros(len(copies), bool)
    opposite[2 * len(faces) : -20] = True
    assert np.array_equal(found.reversed, opposite)
    assert found.sheets == 1


def test_overlapping_parts_are_seen_from_outside(device: Device) -> None:
    """By parity alone, a part that is mostly within others would be turned."""
    parts = (meshes.box(0, 10), meshes.box((1, 1, 1), (9, 9, 12)), meshes.octahedron((5, 5, 5), 7))
    mesh = meshes.mesh_of(*meshes.join(*parts))
    wrong = np.arange(len(mesh.faces)) % 3 == 0
    found = orient(reversed_where(mesh, wrong), device)
    assert np.array_equal(found.reversed, wrong)
    assert found.seen == 3


def test_open_parts_wound_both_ways(device: Device) -> None:
    """Boxes without a face, and a wheel: a cylinder without its ends."""
    n = 16
    turn = 2 * np.pi * np.arange(n) / n
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    wheel = np.concatenate([rim, rim + np.eye(3)[2]]) + np.array((20, 0, 0)), sides
    mesh = meshes.mesh_of(
        *meshes.join(meshes.open_box(0, 9), meshes.open_box((10, 0, 0), (13, 9, 4), 2), wheel)
    )
    wrong = np.zeros(len(mesh.faces), bool)
    wrong[10:] = True
    found = orient(reversed_where(mesh, wrong), device)
    assert np.array_equal(found.reversed, wrong)


def test_what_has_no_outside_stays(device: Device) -> None:
    """A flat sheet keeps the direction of most of its area, a Moebius band and a face without area
    keep theirs."""
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 5, 0)])
    found = orient(meshes.mesh_of(square, [(0, 2, 1), (3, 2, 4), (0, 3, 2), (2, 0, 0)]), device)
    assert found.reversed.tolist() == [True, False, True, False]
    assert (found.sheets, found.kept) == (1, 1)
    n = 9
    turn = np.pi * np.arange(n) / n
    across = np.stack([np.cos(2 * turn), np.sin(2 * turn), 0 * turn], 1)
    tilt = np.stack([np.cos(turn) * across[:, 0], np.cos(turn) * across[:, 1], np.sin(turn)], 1)
    band = np.concatenate([2 * across - tilt / 2, 2 * across + tilt / 2])
    i = np.arange(n - 1)
    faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
    closing = [(n - 1, n, 2 * n - 1), (n, 0, 2 * n - 1)]
    found = orient(meshes.mesh_of(band, np.concatenate([faces, closing])), device)
    assert not found.reversed.any()
    assert found.sheets == 0


@pytest.mark.parametrize("name", ["spot", "fandisk", "rocker-arm", "armadillo"])
def test_real_models(name: str, device: Device) -> None:
    mesh = load_mesh(model(f"{name}.obj"))
    wrong = np.random.default_rng(2).random(len(mesh.faces)) < 0.5
    wrong[: len(wrong) // 4] = True
    assert np.array_equal(orient(reversed_where(mesh, wrong), device).reversed, wrong)
