"""Winding numbers of fans are those of their faces, summed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes

from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device
from voxtool.selftest.crowds import CROWDS
from voxtool.selftest.oracles import winding_numbers
from voxtool.spatial.fans import BUNDLE, CROWDED
from voxtool.spatial.winding_number import WindingNumber

BOUND = 8e-4  # of winding_number.py


def places(mesh: Mesh, seed: int) -> np.ndarray:
    """Points in and around a mesh, near faces, near the apex and behind it."""
    rng = np.random.default_rng(seed)
    low, high = mesh.bounds
    corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), 60)]]
    on = (corners * rng.dirichlet((1, 1, 1), 60)[:, :, None]).sum(axis=1)
    near = rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-6, -1, (60, 1))
    apex = mesh.vertices[0]
    return np.concatenate(
        [
            rng.uniform(2 * low - high, 2 * high - low, (60, 3)),
            on + near,
            apex + near,
            2 * apex - on,
        ]
    )


def assert_right(device: Device, mesh: Mesh, points: np.ndarray, fans: int) -> None:
    measure = WindingNumber(mesh, device)
    assert len(measure.fans) == fans
    found = measure(points)
    np.testing.assert_allclose(
        found, winding_numbers(points, mesh.vertices[mesh.faces]), rtol=0, atol=BOUND
    )
    assert np.array_equal(found, measure(points[::-1])[::-1])


@pytest.mark.parametrize("kind", ["fan", "closed-fans", "loose-fan"])
@pytest.mark.parametrize("count", [CROWDED, 2 * CROWDED + BUNDLE + 1])
def test_fans_are_the_sums_of_their_faces(device: Device, kind: str, count: int) -> None:
    vertices, faces = CROWDS[kind](count)
    mesh = mesh_from_arrays(vertices + np.array([3, 0, -1]), faces)
    fans = {"fan": 1, "loose-fan": 1, "closed-fans": 2 * (count >= 2 * CROWDED)}[kind]
    assert_right(device, mesh, places(mesh, count), fans)


def test_fans_among_other_faces(device: Device) -> None:
    """Two fans with one rim and a sphere between them; faces are turned or repeat, and at an apex
    are a seam and a large triangle."""
    vertices, faces = CROWDS["closed-fans"](3 * CROWDED)
    rng = np.random.default_rng(5)
    faces = np.where(rng.random(len(faces))[:, None] < 0.2, faces[:, ::-1], faces)
    faces = np.roll(faces, 1, axis=1)
    seam = np.where((faces == 0) & (rng.random(faces.shape) < 0.5), len(vertices), faces)
    parts = [
        (np.concatenate([vertices, vertices[:1]]), np.concatenate([seam, faces[:40]])),
        meshes.icosphere(1, (0.1, 0, 0.8), 0.2),
        (np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0]]), np.array([[0, 1, 2]])),
    ]
    mesh = mesh_from_arrays(*meshes.join(*parts))
    once = mesh_from_arrays(
        mesh.vertices, np.delete(mesh.faces, 3 * CROWDED + np.arange(40), axis=0)
    )
    points = places(mesh, 6)
    found = WindingNumber(mesh, device)
    assert len(found.fans) == 2
    expected = winding_numbers(points, once.vertices[once.faces])
    np.testing.assert_allclose(found(points), expected, rtol=0, atol=BOUND)


def test_numbers_at_the_apex_and_far_away(device: Device) -> None:
    mesh = mesh_from_arrays(*CROWDS["fan"](CROWDED))
    points = np.array([[0, 0, 0], [0, 0, 1e-300], [1e25, 0, 0], [0, 1e140, 0], [0, 0, -1e9]])
    found = WindingNumber(mesh, device)(points)
    assert np.isfinite(found).all()
    assert (np.abs(found[2:]) < 1e-12).all()


@pytest.mark.parametrize("count", [CROWDED, 2 * CROWDED + BUNDLE + 1])
@pytest.mark.parametrize("turned", [0.0, 0.5])
def test_books_are_the_sums_of_their_pages(device: Device, count: int, turned: float) -> None:
    """Pages at all angles; all in one direction, or half of them turned."""
    vertices, faces = CROWDS["book"](count)
    over = np.random.default_rng(count).random(count) < turned
    faces = np.where(over[:, None], faces[:, ::-1], faces)
    mesh = mesh_from_arrays(
        vertices * 0.7 + np.array([3, 0, -1]), np.roll(faces, count % 3, axis=1)
    )
    points = places(mesh, count)
    measure = WindingNumber(mesh, device)
    assert len(measure.fans) == 1
    expected = winding_numbers(points, mesh.vertices[mesh.faces])
    error = np.abs(measure(points) - expected)
    assert error.max() < (BOUND if turned else 2e-4 * np.abs(expected).max())


def test_numbers_between_pages_are_exact_to_the_page(device: Device) -> None:
    """Half of the pages turned, a five-hundredth of a turn apart: numbers differ by up to 1."""
    x, y = np.array([np.unravel_index(np.arange(CROWDED), (16, CROWDED // 16))][0]) + 0.5
    rim = np.stack([x - 8, y - CROWDED / 32, 3 + x * y / CROWDED], axis=1)
    vertices = np.concatenate([[[0, 0, 0], [0.1, 0.2, 9]], rim])
    faces = np.array([(0, 1, 2 + i) if i % 2 else (1, 0, 2 + i) for i in range(CROWDED)])
    mesh = mesh_from_arrays(vertices, faces)
    middles = vertices[faces].mean(axis=1)
    points = np.concatenate([middles + step for step in (-0.01, 1e-4, 0.02)])
    expected = winding_numbers(points, vertices[faces])
    assert len(np.unique(np.rint(4 * expected))) > 4
    found = WindingNumber(mesh, device)(points)
    np.testing.assert_allclose(found, expected, rtol=0, atol=4 * BOUND)


def test_few_or_wide_faces_are_no_fan(device: Device) -> None:
    for vertices, faces in (
        CROWDS["fan"](CROWDED - 1),
        CROWDS["book"](CROWDED - 1),
        meshes.box(0, 1),
    ):
        assert not WindingNumber(mesh_from_arrays(vertices, faces), device).fans
