"""Simplified repairs: fewer triangles within a stated distance, closed, manifold, not entangled."""

from __future__ import annotations

import sys
from functools import cache
from typing import Any

import numpy as np
import pytest
import wrecks
from conftest import model
from helpers import meshes

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.repairing import simplify
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.sampling import SurfaceSampler

WRECKS = [("holes", "torus"), ("apart", "box"), ("noisy", "two")]


@cache
def repaired(fault: str, shape: str, voxels: float = 0.0, **request: Any) -> voxtool.Repaired:
    """The repair of a wreck at dim 32, simplified by so many voxels."""
    mesh = voxtool.mesh_from_arrays(*wrecks.wreck(fault, shape))
    grid = voxtool.Grid.fit(mesh, 32)
    length = voxels * grid.pitch[0]
    shells = wrecks.SHAPES[shape][1]
    return voxtool.repair(mesh, grid, keep_components=shells, simplify=length, **request)


@pytest.mark.parametrize(("fault", "shape"), WRECKS)
def test_fewer_triangles_within_the_length(fault: str, shape: str) -> None:
    whole, small = repaired(fault, shape), repaired(fault, shape, 0.5)
    _, shells, genus = wrecks.SHAPES[shape]
    assert small.faults == ""
    assert (small.checked["shells"], small.checked["genus"]) == (shells, genus)
    assert len(small.faces) < len(whole.faces) / 2
    facts = small.simplified
    assert facts["triangles_before"] == len(whole.faces)
    assert 0 < facts["deviation"] <= facts["wanted"] == 0.5 * small.grid.pitch[0]
    for one, other in ((whole, small), (small, whole)):  # no sample is beyond the bound
        points = np.concatenate([*SurfaceSampler(one.mesh(), "").samples(300), one.vertices[:300]])
        assert TriangleDistance(other.mesh())(points).max() <= facts["deviation"]


def test_flat_sides_need_few_triangles() -> None:
    mesh = voxtool.mesh_from_arrays(*meshes.box((0.0, 0.0, 0.0), (20.0, 12.0, 8.0)))
    grid = voxtool.Grid.fit(mesh, 24)
    small = voxtool.repair(mesh, grid, simplify=0.01)
    assert len(small.faces) < voxtool.repair(mesh, grid).checked["faces"] / 5
    assert small.simplified["deviation"] <= 0.01


def test_a_surface_that_cannot_be_simplified_is_kept(monkeypatch) -> None:
    whole = repaired("holes", "torus")
    collapse, tried = simplify._collapsed, []

    def too_far(surface, whole, tolerance):
        tried.append(tolerance)
        return collapse(surface, whole, 100 * tried[0])

    monkeypatch.setattr(simplify, "_collapsed", too_far)
    repaired.cache_clear()
    kept = repaired("holes", "torus", 0.5)
    repaired.cache_clear()
    assert len(tried) == simplify.TRIES
    assert (np.diff(tried) < 0).all()
    assert kept.digest() == whole.digest()
    assert kept.simplified["deviation"] == 0
    assert len(kept.faces) == kept.simplified["triangles_before"]


def test_a_shell_that_is_flat_to_the_length_is_kept() -> None:
    ball, chip = meshes.icosphere(3), meshes.icosphere(1, (2.0, 0.0, 0.0), 0.15)
    mesh = voxtool.mesh_from_arrays(*meshes.join(ball, chip))
    small = voxtool.repair(mesh, dim=32, simplify=0.3)
    assert small.checked["shells"] == 2
    assert small.simplified["deviation"] <= 0.3
    assert len(small.faces) < small.simplified["triangles_before"] / 4


def test_hollow_and_offset_are_simplified_at_the_end() -> None:
    pitch = repaired("holes", "torus").grid.pitch[0]
    hollow = repaired("holes", "torus", 0.3, shell=2 * pitch)
    assert hollow.faults == ""
    assert hollow.wall["cavities"] == 1
    assert len(hollow.faces) < hollow.simplified["triangles_before"]
    moved = repaired("holes", "torus", 0.3, offset=3 * pitch)
    assert moved.faults == ""
    assert moved.checked["volume"] > repaired("holes", "torus").checked["volume"]


def test_every_driver_gives_the_same(device) -> None:
    assert repaired("holes", "torus", 0.5, device=device).digest() == (
        repaired("holes", "torus", 0.5).digest()
    )


def test_a_model_with_holes() -> None:
    small = voxtool.repair(model("suzanne.obj"), dim=64, simplify=0.02)
    assert small.faults == ""
    assert len(small.faces) < small.simplified["triangles_before"] * 2 / 3


@pytest.mark.parametrize("length", [-1.0, np.nan, np.inf])
def test_no_length(length: float) -> None:
    with pytest.raises(VoxtoolError, match="is no length"):
        voxtool.repair(voxtool.mesh_from_arrays(*meshes.icosphere(1)), dim=8, simplify=length)


def test_without_the_library_a_line_names_the_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    with pytest.raises(VoxtoolError, match=r"pip install 'voxtool\[simplify\]'"):
        voxtool.repair(voxtool.mesh_from_arrays(*meshes.icosphere(1)), dim=8, simplify=0.1)
