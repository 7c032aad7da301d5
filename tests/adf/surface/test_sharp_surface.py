"""Surfaces of fields that keep the edges and corners of the source."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adf.surface.test_surface import check_sound, random_field
from conftest import model
from helpers import meshes
from helpers.cli import fail, told

import voxtool
from voxtool.adf.surface.extract import extract_field_surface
from voxtool.errors import MeshError, VoxtoolError
from voxtool.spatial.distance import TriangleDistance

STEP = np.linspace(0, 1, 40)[:, None]
LOW, HIGH = np.array([-1.0, -0.7, -0.5]), np.array([1.0, 0.7, 0.5])


def box(turn: np.ndarray, shrunk: float = 0.0) -> voxtool.Mesh:
    vertices, faces = meshes.box(tuple(LOW + shrunk), tuple(HIGH - shrunk))
    return voxtool.mesh_from_arrays(np.array(vertices) @ turn.T, faces)


def on_edges(mesh: voxtool.Mesh) -> np.ndarray:
    """Points along the edges at which faces meet at 30 degrees or more."""
    solid = mesh.to_trimesh()
    solid.merge_vertices()
    sharp = solid.face_adjacency_edges[solid.face_adjacency_angles > np.radians(30)]
    ends = solid.vertices[sharp][:, :, None]
    return (ends[:, 0] * (1 - STEP) + ends[:, 1] * STEP).reshape(-1, 3)


def rotation(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


def sharp(mesh: voxtool.Mesh, device=None, level: int = 5, **request: Any) -> voxtool.FieldSurface:
    """The sharp surface of a mesh, checked: no face passes through another."""
    field = voxtool.build_adf(mesh, device=device, max_level=level, tolerance=1e-4)
    surface = voxtool.extract(field, style="sharp", source=mesh, device=device, **request)
    assert check_sound(surface)["self_intersecting_faces"] == 0
    return surface


def beside(surface: voxtool.FieldSurface, points: np.ndarray) -> tuple[float, float]:
    """The median and the largest distance of points from a surface, in edges of its leaves."""
    far = TriangleDistance(surface.mesh())(points) / surface.pitch
    return float(np.median(far)), float(far.max())


@pytest.mark.parametrize("seed", range(3))
def test_edges_of_turned_boxes(seed: int, device) -> None:
    mesh = box(rotation(seed))
    median, largest = beside(sharp(mesh, device), on_edges(mesh))
    assert median < 5e-3
    assert largest < 0.05
    smooth = voxtool.extract(voxtool.build_adf(mesh, max_level=5, tolerance=1e-4))
    assert beside(smooth, on_edges(mesh))[0] > 0.3


@pytest.mark.parametrize("level", [4, 6])
def test_a_box_on_the_lattice_is_exact(level: int) -> None:
    # the longest sides lie between leaves, so crossings lie on them but for rounding
    mesh = voxtool.mesh_from_arrays(*meshes.box((0.1, 0.2, 0.3), (4.2, 3.1, 2.7)))
    field = voxtool.build_adf(mesh, max_level=level, tolerance=1e-3)
    surface = extract_field_surface(field, source=mesh)
    assert TriangleDistance(mesh)(surface.vertices).max() < 1e-11 * surface.pitch
    assert beside(surface, on_edges(mesh))[1] < 1e-11


def test_an_inward_offset_of_a_box_is_a_box() -> None:
    turn, far = rotation(7), 0.2
    surface = sharp(box(turn), offset=-far)
    # leaves are coarser there than at the mesh
    median, largest = beside(surface, on_edges(box(turn, far)))
    assert median < 0.1
    assert largest < 0.5


def test_an_outward_offset_has_its_distance() -> None:
    mesh = box(rotation(3))
    wall = sharp(mesh, offset=0.1, shell=0.2)
    assert check_sound(wall)["shells"] == 2
    surface = sharp(mesh, offset=0.1)
    far = TriangleDistance(mesh)(surface.vertices)
    apart = np.abs(far - 0.1) / surface.pitch
    assert np.median(apart) < 0.01
    assert apart.max() < 0.5  # the tangent planes of a cylinder of one leaf's size meet outside it


def test_a_model_with_features() -> None:
    mesh = voxtool.load_mesh(model("fandisk.obj"))
    median, largest = beside(sharp(mesh, level=7), on_edges(mesh))
    assert median < 0.02
    assert largest < 0.5


def test_across_a_hole_the_surface_is_the_smooth_one() -> None:
    mesh = voxtool.mesh_from_arrays(*meshes.open_box(0, (4, 3, 2)))
    field = voxtool.build_adf(mesh, max_level=5)
    surface = extract_field_surface(field, source=mesh)
    check_sound(surface)
    found, _ = beside(extract_field_surface(field), surface.vertices)
    assert found < 1
    assert TriangleDistance(extract_field_surface(field).mesh())(surface.vertices).max() < (
        3 * field.side / 8
    )


@pytest.mark.parametrize("kind", ["any", "sparse", "near", "blocks"])
def test_any_values_give_a_closed_manifold(kind: str) -> None:
    ball = voxtool.mesh_from_arrays(*meshes.icosphere(2, (0.5, 0.5, 0.5), 0.3))
    for seed in range(2):
        surface = extract_field_surface(random_field(seed, kind), source=ball)
        if len(surface.faces):
            check_sound(surface)


def test_the_command_and_its_refusals(here: Path) -> None:
    told("adf-build bunny.obj --max-level 4 -o a.adf.h5 --json")
    found = told("extract a.adf.h5 --style sharp --source bunny.obj -o a.ply --check --json")
    assert found["sharp"]
    assert found["check"]["closed"]
    assert found["check"]["self_intersecting_faces"] == 0
    field, mesh = voxtool.read_adf("a.adf.h5"), voxtool.load_mesh("bunny.obj")
    assert found["digest"] == voxtool.extract(field, style="sharp", source=mesh).digest()
    planned = told("extract a.adf.h5 --style sharp --source bunny.obj --plan --json")
    assert planned["predicted_device_bytes"] > 0
    assert "self-intersections" in planned["stages"]
    assert "was not made from it" in fail("extract a.adf.h5 --style sharp --source open.obj", 3)
    assert "--source" in fail("extract a.adf.h5 --style sharp", 2)
    with pytest.raises(MeshError, match="was not made from it"):
        voxtool.extract(field, style="sharp", source="open.obj")
    with pytest.raises(VoxtoolError, match="give both, or neither"):
        voxtool.extract(field, style="sharp")
