"""The deviation between two surfaces, on shapes whose deviation is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.meshes import mesh_of

from voxtool.errors import MeshError, VoxtoolError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial.deviation import deviation
from voxtool.spatial.sampling import SurfaceSampler

WAYS = ("surface_to_reference", "reference_to_surface")


def plane(side: int = 6, height: float = 0.0, size: float = 1.0) -> Mesh:
    """2 side^2 triangles over [0, size]^2."""
    i, j = (a.ravel() for a in np.indices((side, side)))
    first = i * (side + 1) + j
    corners = [
        (first, first + side + 1, first + 1),
        (first + side + 1, first + side + 2, first + 1),
    ]
    x, y = (a.ravel() * size / side for a in np.indices((side + 1, side + 1)))
    faces = np.concatenate([np.stack(c, axis=1) for c in corners])
    return mesh_of(np.stack([x, y, np.full_like(x, height)], axis=1), faces)


@pytest.mark.parametrize("height", [0.25, 0.1, 3.0, 1e-6])
def test_a_shifted_plane(device: Device, height: float) -> None:
    found = deviation(plane(), plane(height=height), 5000, height, device)
    for way in WAYS:
        # rounded once for the sum, and once for its square root
        assert found[way]["mean"] == pytest.approx(height, rel=1e-15)
        assert found[way]["rms"] == pytest.approx(height, rel=1e-15)
        assert height - 1e-12 <= found[way]["max"] <= height <= found[way]["max_upper"]
        assert found["voxels"][way]["max_upper"] == found[way]["max_upper"] / height
    assert found["hausdorff_upper"] - found["hausdorff"] <= found["tolerance"] + 4e-12
    assert found["voxels"]["hausdorff"] == found["hausdorff"] / height


def test_a_mesh_and_itself(device: Device) -> None:
    mesh = mesh_of(*meshes.torus())
    found = deviation(mesh, mesh, 20_000, device=device)
    assert found["hausdorff"] == 0
    assert found["hausdorff_upper"] < 1e-11
    assert "voxels" not in found
    assert "pitch" not in found
    assert found[WAYS[0]] == found[WAYS[1]]


def test_spheres_of_two_radii(device: Device) -> None:
    inner, outer = (mesh_of(*meshes.icosphere(4, (1, 2, 3), r)) for r in (1, 1.25))
    found = deviation(inner, outer, 20_000, 0.5, device)
    for way in WAYS:
        for name in ("mean", "rms", "max"):
            assert found[way][name] == pytest.approx(0.25, abs=0.002)
            assert found["voxels"][way][name] == pytest.approx(0.5, abs=0.004)
        assert found[way]["max"] <= 0.25 + 1e-12


def test_a_box_within_a_box(device: Device) -> None:
    small, large = mesh_of(*meshes.box(1, 3)), mesh_of(*meshes.box(0, 4))
    found = deviation(small, large, 10_000, device=device)
    assert found[WAYS[0]]["mean"] == pytest.approx(1, rel=1e-15)
    assert found[WAYS[0]]["max"] == pytest.approx(1, rel=1e-11)
    assert found[WAYS[1]]["max"] == found["hausdorff"] == pytest.approx(np.sqrt(3), rel=1e-11)
    assert found[WAYS[1]]["point"] in large.vertices.tolist()
    # 1 over the middle of a face; beyond, the square root of 1 and what x and y are past it
    x, y = np.meshgrid(*[(np.arange(400) + 0.5) / 100] * 2)
    past = (
        np.maximum(np.maximum(1 - x, x - 3), 0) ** 2 + np.maximum(np.maximum(1 - y, y - 3), 0) ** 2
    )
    assert found[WAYS[1]]["mean"] == pytest.approx(np.sqrt(1 + past).mean(), abs=5e-4)
    assert found[WAYS[1]]["rms"] == pytest.approx(np.sqrt((1 + past).mean()), abs=5e-4)


def test_the_maximum_sees_what_is_between_the_samples(device: Device) -> None:
    flat = plane(40)
    vertices = flat.vertices.copy()
    vertices[20 * 41 + 20, 2] = 0.5
    spike = replace(flat, vertices=vertices)
    found = deviation(spike, plane(), 1, device=device)
    assert found[WAYS[0]]["max"] == pytest.approx(0.5, rel=1e-11)
    assert found[WAYS[0]]["mean"] == found[WAYS[0]]["rms"] < 0.5


# ---- samples


def sample(mesh: Mesh, count: int) -> np.ndarray:
    return np.concatenate(list(SurfaceSampler(mesh, "surface").samples(count)))


def test_faces_have_their_share_to_within_one() -> None:
    heights = np.array([1.0, 5, 0, 0.25, 8, 0, 3])  # triangles of base 1, apart along x
    corners = [[(2 * i, 0, 0), (2 * i + 1, 0, 0), (2 * i, h, 0)] for i, h in enumerate(heights)]
    vertices = np.reshape(corners, (-1, 3))
    mesh = mesh_of(vertices, np.arange(21).reshape(-1, 3))
    for count in (1, 10, 1000, 12_345):
        points = sample(mesh, count)
        assert len(points) == count
        face = (points[:, 0] // 2).astype(int)
        share = np.bincount(face, minlength=7)
        assert (np.abs(share - count * heights / heights.sum()) <= 1).all()
        assert (share[heights == 0] == 0).all()
        x, y = points[:, 0] % 2, points[:, 1] / heights[face]
        assert (x >= 0).all()
        assert (y >= 0).all()
        assert (x + y <= 1 + 1e-12).all()


def test_samples_are_even_within_a_face() -> None:
    points = sample(mesh_of([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]), 4096)
    assert np.abs(points.mean(axis=0) - [1 / 3, 1 / 3, 0]).max() < 1e-3
    cells = np.bincount((points[:, :2] * 8).astype(int) @ [8, 1], minlength=64).reshape(8, 8)
    whole = np.add.outer(np.arange(8), np.arange(8)) < 7
    assert np.abs(cells[whole] - 128).max() < 16  # 11 is the deviation of random points


def test_blocks_change_nothing() -> None:
    sampler = SurfaceSampler(mesh_of(*meshes.torus()), "surface")
    (expected,) = sampler.samples(5000)
    assert np.array_equal(np.concatenate(list(sampler.samples(5000, 777))), expected)


def test_all_devices_agree() -> None:
    pair = mesh_of(*meshes.torus()), mesh_of(*meshes.icosphere(3, radius=2))
    found = [deviation(*pair, 3000, 0.1, opened(index)) for index, _ in usable_devices()]
    assert all(other == found[0] for other in found[1:])


def test_the_result_is_json(device: Device) -> None:
    found = deviation(plane(), plane(height=1), np.int64(10), np.float64(0.5), device)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["samples"] == 10
    assert found["pitch"] == 0.5


@pytest.mark.parametrize("exponent", [-400, 400])
def test_extreme_scales(device: Device, exponent: int) -> None:
    pair = [meshes.torus(), meshes.torus(minor=1.1)]
    expected = deviation(*(mesh_of(*m) for m in pair), 2000, device=device)
    scaled = [mesh_of(np.ldexp(v, exponent), f) for v, f in pair]
    found = deviation(*scaled, 2000, device=device)
    for way in WAYS:
        for name in ("mean", "rms", "max", "max_upper"):
            assert found[way][name] == np.ldexp(expected[way][name], exponent)


# ---- what is refused


def test_a_mesh_of_zero_area_is_refused(device: Device) -> None:
    flat = mesh_of([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 2), (0, 0, 1)], "wire.obj")
    for pair in ((flat, plane()), (plane(), flat)):
        with pytest.raises(
            MeshError, match=r"wire\.obj: no area: each of its 2 faces .*: give"
        ) as caught:
            deviation(*pair, device=device)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("samples", "pitch", "message"),
    [
        *((samples, None, "give a whole number from 1 on") for samples in (0, -1, 1.5, True, "x")),
        *((10, pitch, "give a length greater than 0") for pitch in (0.0, -1.0, np.inf, np.nan)),
    ],
)
def test_numbers_that_are_refused(device: Device, samples, pitch, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message):
        deviation(plane(), plane(), samples, pitch, device)
