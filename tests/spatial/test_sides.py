"""Winding numbers beside faces, against those of the parts of a mesh alone."""

from __future__ import annotations

import numpy as np

from voxtool.adf.construction.survey import Survey
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.spatial.winding_number import WindingNumber


def test_without_a_boundary_the_number_is_that_of_the_shell(device) -> None:
    vertices, faces = shapes.ball(3)
    vertices = np.asarray(vertices, float)
    balls = [mesh_from_arrays(vertices + np.array([x, 0.0, 0.0]), faces) for x in (0.0, 1.0)]
    mesh = mesh_from_arrays(*shapes.join(*((ball.vertices, ball.faces) for ball in balls)))
    survey = Survey(mesh, device, True)
    sides = survey.sides
    sides.find(np.arange(len(mesh.faces)))
    assert not len(sides.spheres)
    known = np.isfinite(sides.front)
    assert 0 < np.count_nonzero(~known) < len(known) / 4  # where the balls intersect
    other = np.concatenate(
        [
            WindingNumber(balls[1 - i], device)(ball.vertices[ball.faces].mean(axis=1))
            for i, ball in enumerate(balls)
        ]
    )
    assert {0, 1} == set(np.round(other[known]).astype(int).tolist())
    np.testing.assert_allclose(sides.front[known], np.round(other[known]), atol=2.0**-6)


def test_what_is_asked_for_is_what_is_found_for_all(device) -> None:
    """Winding numbers that are asked for in front of some faces are those found for all faces, with
    a boundary and without."""
    vertices, faces = shapes.ball(3)
    for some in (faces, faces[5:]):
        mesh = mesh_from_arrays(vertices, some)
        sides, whole = (Survey(mesh, device, True).sides for _ in range(2))
        asked = np.array([0, 7, 33])
        device.write(sides.arguments["wanted"], np.array([1 << 0 | 1 << 7, 1 << 1], np.uint32))
        assert sides.find_wanted()
        assert not sides.find_wanted()
        assert np.flatnonzero(~np.isinf(sides.front)).tolist() == asked.tolist()
        whole.find(np.arange(len(some)))
        np.testing.assert_allclose(sides.front[asked], whole.front[asked], atol=2.0**-6)
        assert np.array_equal(sides.arguments["front"].get(), sides.front)
        device.write(sides.arguments["wanted"], np.full(len(some) // 32, ~np.uint32(0)))
        assert sides.find_wanted()
        assert not sides.is_partial
