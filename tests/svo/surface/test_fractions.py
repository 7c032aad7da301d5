"""Surfaces of fractions against the sphere that they were made from."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import plan_extract

STYLES = ("marching-cubes", "surface-nets")
RADIUS = 10.3


def ball(device, mode: str = "fraction", kind: str | None = None, shape: int = 26) -> Octree:
    grid = voxtool.Grid((shape,) * 3, (0, 0, 0), (1, 1, 1))
    mesh = meshes.mesh_of(*meshes.icosphere(5, 13.0, RADIUS))
    return voxtool.voxelize(mesh, grid, mode, fraction_type=kind, device=device)


def errors_of(surface: voxtool.Isosurface) -> np.ndarray:
    return np.linalg.norm(surface.vertices - 13, axis=1) - RADIUS


@pytest.mark.parametrize("style", STYLES)
def test_spheres_are_closer_than_from_set_voxels(device, style) -> None:
    surface = voxtool.extract(ball(device), style=style, device=device)
    solid = voxtool.extract(ball(device, "solid"), style=style, level="voxel", device=device)
    assert surface.level == "voxel"
    assert surface.check()["closed"]
    assert np.abs(errors_of(surface)).max() < 0.13
    assert np.sqrt((errors_of(surface) ** 2).mean()) < 0.05
    assert 2 * np.abs(errors_of(surface)).max() < np.abs(errors_of(solid)).max()


@pytest.mark.parametrize("style", STYLES)
def test_types_give_nearly_the_same_surface(device, style) -> None:
    surfaces = [
        voxtool.extract(ball(device, kind=kind), style=style, device=device)
        for kind in ("f4", "u2", "u1")
    ]
    for other in surfaces[1:]:
        assert np.array_equal(other.faces, surfaces[0].faces)
        assert np.abs(other.vertices - surfaces[0].vertices).max() < 0.02


def test_a_plane_is_where_it_is(device) -> None:
    """The fraction of a voxel that a plane across x cuts is linear in its place."""
    for place in (8, 8.25, 8.5, 8.875):
        mesh = meshes.mesh_of(*meshes.box(3, (place, 12, 12)))
        grid = voxtool.Grid((16, 16, 16), (0, 0, 0), (1, 1, 1))
        octree = voxtool.voxelize(mesh, grid, "fraction", device=device)
        points = voxtool.extract(octree, device=device).vertices
        middle = points[(np.abs(points[:, 1:] - 7.5) < 1).all(axis=1)]
        first = np.floor(place)
        share = place - first
        if share < 0.5:  # between the centres of the voxel before, and of the cut one
            expected = first - 0.5 + 0.5 / (1 - share)
        else:
            expected = first + 0.5 + (share - 0.5) / share
        assert middle[:, 0].max() == pytest.approx(expected, abs=1 / 256 + 2**-13)


def test_isovalues_move_the_surface(device) -> None:
    octree = ball(device)
    volumes = [
        voxtool.extract(octree, isovalue=share, device=device).check()["volume"]
        for share in (0.1, 0.5, 0.9)
    ]
    assert volumes == sorted(volumes, reverse=True)


def test_naive_and_pyramids_give_the_same(device) -> None:
    job = plan_extract(ball(device), style="marching-cubes", device=device)
    expected = job.run().digest()
    assert job.with_(naive=True).run().digest() == expected
    assert job.with_(compaction="pyramid-4").run().digest() == expected


def test_refusals(device) -> None:
    octree = ball(device)
    for request in ({"level": 0}, {"level": 1, "style": "surface-nets"}):
        with pytest.raises(VoxtoolError, match="fractions, which are of voxels"):
            voxtool.extract(octree, device=device, **request)
    with pytest.raises(TypeError, match="fractions"):
        plan_extract(octree, device=device).with_(fractions=False)
    blocks = voxtool.extract(octree, style="voxel-faces", device=device)
    assert blocks.check()["volume"] == octree.count
