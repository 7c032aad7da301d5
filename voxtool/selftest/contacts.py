"""Faces that others nearly meet: slivers beside edges, boxes just apart, and a box that just passes
through another one's face."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.distances import plan_distance
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.pseudonormals import pseudonormals
from voxtool.spatial.self_intersections import find_self_intersections
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

MEETING = 9  # faces, where a box ends in another: a triangle, and its four sides, of two each
SPLITS, FINEST = 60, 13  # of faces of the ball: 1e-8 to 1e-13 beside edges, far over rounding
NEAR = (1e-3, 1e-6)  # of points, from the faces of a ball of radius 1; flaws are below 1e-8


@case("faces that nearly meet", "gaps, depths to 1e-12, splits to 1e-13 beside edges: their number "
      "and signs", "wrong", 0)  # fmt: skip
def contacts(device: Device, full: bool) -> int:
    """Faces that wrongly meet others, or do not, and wrong signs of distances."""
    wrong = 0
    for gap in (1e-3, 1e-6, 1e-9, 1e-12, 0.0, -1e-12, -1e-9, -1e-6, -1e-3):
        large = shapes.box(np.zeros(3), np.ones(3))
        small = shapes.box(np.array([1 + gap, 0.5, 0.2]), np.array([1.5, 0.7, 0.3]))
        found = meeting(device, mesh_from_arrays(*shapes.join(large, small)))
        wrong += abs(found - MEETING) if gap < 0 else found if gap > 0 else 0
    random = np.random.default_rng(5)
    vertices, faces = shapes.ball(2)
    corners = vertices[faces]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= length(normals)[:, None]
    for _ in range(16 if full else 4):
        mesh = mesh_from_arrays(*beside_edges(vertices, faces, SPLITS, FINEST, random))
        wrong += meeting(device, mesh)
        which = random.integers(len(faces), size=4000)
        weights = random.dirichlet((1, 1, 1), 4000)
        on = (weights[:, :, None] * corners[which]).sum(axis=1)
        away = random.choice(NEAR, 4000) * random.choice((-1, 1), 4000)
        points = on + away[:, None] * normals[which]
        heights = dot(points[:, None] - corners[None, :, 0], normals)
        distances = plan_distance(mesh, device=device).run()(points)
        wrong += int(np.count_nonzero((distances < 0) != (heights.max(axis=1) < 0)))  # it is convex
    return wrong


def meeting(device: Device, mesh: Mesh) -> int:
    """Return the number of faces that others meet, or may meet."""
    tree = build_tree(device, mesh, pseudonormals(mesh).flat)
    return int(np.count_nonzero(find_self_intersections(device, mesh, tree)))


def beside_edges(
    vertices: np.ndarray, faces: np.ndarray, n: int, finest: int, random: np.random.Generator
) -> shapes.Shape:
    """Return a mesh of which n faces are split in three, at a point that is 1e-8 to 10**-finest of
    their height beside an edge."""
    points, whole, split = [*vertices], [*faces], []
    for _ in range(n):
        face = whole.pop(random.integers(len(whole)))
        a, b, c = np.roll(face, random.integers(3)).tolist()
        on = points[a] + random.uniform(0.1, 0.9) * (points[b] - points[a])
        m = len(points)
        points.append(on + 10.0 ** -random.uniform(8, finest) * (points[c] - on))
        split += [(a, b, m), (b, c, m), (c, a, m)]
    return np.array(points), np.array([*whole, *split], np.int32)
