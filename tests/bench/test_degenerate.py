"""The bench of degenerate meshes: the kinds are what their names say, and sizes are measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, told

from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.mesh.topology import SurfaceCheck, check_surface
from voxtool.selftest.crowds import CROWDS


def counts(kind: str, n: int = 400) -> SurfaceCheck:
    vertices, faces = CROWDS[kind](n)
    assert faces.max() < len(vertices)
    return check_surface(mesh_from_arrays(vertices, faces))


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("copies", {"duplicate_faces": 399, "degenerate_faces": 0, "shells": 1}),
        ("points", {"degenerate_faces": 396, "closed": True}),
        ("collinear", {"degenerate_faces": 400}),
        ("fan", {"boundary_edges": 400, "nonmanifold_vertices": 0, "euler": 1}),
        ("closed-fans", {"closed": True, "watertight": True, "euler": 2}),
        ("loose-fan", {"boundary_edges": 1200, "nonmanifold_vertices": 1, "shells": 400}),
        ("book", {"nonmanifold_edges": 1, "boundary_edges": 800, "shells": 1}),
        ("loops", {"boundary_edges": 1200, "shells": 400, "degenerate_faces": 0}),
        ("needles", {"boundary_edges": 1200, "shells": 400, "degenerate_faces": 0}),
        ("shells", {"watertight": True, "shells": 100, "euler": 200}),
        ("nested", {"watertight": True, "shells": 100, "euler": 200}),
    ],
)  # fmt: skip
def test_kinds_of_degenerate_meshes(kind: str, expected: dict[str, object]) -> None:
    found = counts(kind)
    assert found.faces == 400
    assert {name: getattr(found, name) for name in expected} == expected


def test_a_needle_is_thin_and_a_shell_is_inside_the_one_before() -> None:
    vertices, faces = CROWDS["needles"](100)
    assert np.abs(vertices[:, 1:]).max() < 2e-6
    assert np.ptp(vertices[faces][..., 0], axis=1).min() > 0.99
    vertices, faces = CROWDS["nested"](100)
    high = vertices[faces].reshape(25, -1, 3).max(axis=1)
    assert (high[1:] < high[:-1]).all()


def test_each_work_on_each_size_has_a_time(here: Path) -> None:
    points = told("bench degenerate copies --triangles 10000 --repeat 1 --json -q")["points"]
    assert {p["model"] for p in points} == {"copies"}
    assert [p["size"] for p in points] == sorted([1000, 10_000] * 12)
    assert all(p["runs"] and p["absent"]["rms"] for p in points)
    assert len({p["method"] for p in points}) == 12
    message = fail("bench degenerate heap -q")
    assert "no kind of degenerate mesh is 'heap': choose copies, " in message
