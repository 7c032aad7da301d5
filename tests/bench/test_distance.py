"""The bench of exact distances: its reference."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes

from voxtool.bench.distance import exact_distances
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest.oracles import distances


@pytest.mark.parametrize("level", [0, 1])
def test_the_filter_of_triangles_leaves_the_nearest(level: int) -> None:
    mesh = mesh_from_arrays(*meshes.icosphere(level))
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (8, 3))
    points[0] = 0  # as far from all
    expected = distances(points, mesh.vertices[mesh.faces])
    assert np.array_equal(exact_distances(mesh, points), expected)
