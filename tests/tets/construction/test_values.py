"""Volumes, transfer functions, cameras and rays are values; rays are a view of their own."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.tets import tet_grid, tet_mesh

import voxtool
from voxtool.pictures.rendering import averaged


def volume() -> voxtool.TetVolume:
    points, cells = tet_grid((2, 2, 2), seed=1)
    return voxtool.build_tet(tet_mesh(points, cells, points[:, 0]))


CAMERA = voxtool.Camera((3.0, 2.0, 5.0), (1.0, 1.0, 1.0))
MAKERS = {
    "volume": (volume, {"scale": 4.0}),
    "transfer": (
        lambda: voxtool.TransferFunction([0, 1], [(0, 0, 1), (1, 0, 0)], [0, 2]),
        {"extinctions": [0, 3]},
    ),
    "rays": (lambda: CAMERA.rays(6, 4), {"size": (4, 6)}),
    "camera": (lambda: CAMERA, {"fov": 40.0}),
}


@pytest.mark.parametrize("name", MAKERS)
def test_values(name) -> None:
    make, change = MAKERS[name]
    value = make()
    copy = pickle.loads(pickle.dumps(value))
    assert copy == value == make()
    assert replace(value, **change) != value
    assert len(repr(value)) < 400
    for array in (a for a in vars(copy).values() if isinstance(a, np.ndarray)):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_rays_as_view_with_samples(device) -> None:
    """Each pixel is the mean of the finer rays, which are those of a larger picture."""
    scene, rays = volume(), CAMERA.rays(12, 8)
    picture = voxtool.render(scene, rays, samples=3, device=device)
    large = voxtool.render(scene, CAMERA.rays(36, 24), device=device)
    assert picture.shape == (8, 12, 4)
    assert picture.any()
    np.testing.assert_allclose(picture, averaged(large, 3), atol=1e-6)
