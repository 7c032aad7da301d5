"""Shapes and rays for tests: triangle meshes, (V, 3) and (F, 3) arrays, and tetrahedral meshes.

They are computed with + - * / and square roots alone, so they are the same on every machine.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from voxtool.camera import Rays
from voxtool.vector import length

Shape = tuple[np.ndarray, np.ndarray]

BOX_FACES = np.array(
    [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]
)  # fmt: skip
OCTAHEDRON_FACES = np.array(
    [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
)
TETRAHEDRON_FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
# A cube's corners are 4 x + 2 y + z. Kuhn's six tetrahedra: the ways from corner 0 to corner 7.
KUHN = np.array([np.cumsum([0, *way]) for way in permutations((1, 2, 4))])


def box(low: np.ndarray, high: np.ndarray) -> Shape:
    """Return 12 outward triangles."""
    corners = np.array(list(product((0, 1), repeat=3)))
    return np.where(corners == 1, high, low), BOX_FACES


def octahedron(centre: np.ndarray, radius: int) -> Shape:
    """Return 8 outward triangles."""
    axes = np.eye(3, dtype=np.int64)
    corners = np.stack([axes, -axes], axis=1).reshape(6, 3)
    return np.asarray(centre) + radius * corners, OCTAHEDRON_FACES


def subdivide(mesh: Shape) -> Shape:
    """Return every triangle cut into four at the midpoints of its edges (rounded down if whole)."""
    vertices, faces = mesh
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ends, middle = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    sums = vertices[ends].sum(axis=1)
    halves = sums // 2 if np.issubdtype(sums.dtype, np.integer) else sums / 2
    m = middle.reshape(-1, 3) + len(vertices)
    corners = np.stack([faces, m, np.roll(m, 1, axis=1)], axis=2).reshape(-1, 3)
    return np.concatenate([vertices, halves]), np.concatenate([corners, m])


def ball(level: int) -> Shape:
    """Return 8 * 4**level outward triangles with their vertices on the unit sphere, to 2**-20."""
    vertices, faces = octahedron(np.zeros(3), 1)
    for _ in range(level):
        vertices, faces = subdivide((vertices, faces))
    vertices = vertices / length(vertices)[:, None]
    return np.rint(vertices * 2**20) / 2**20, faces


def join(*parts: Shape) -> Shape:
    """Return several meshes as one; nothing is welded."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def rays_along(axis: int, origin: np.ndarray, step: float, size: int, sign: int = -1) -> Rays:
    """Return size x size parallel rays along an axis, `step` apart along the next two axes."""
    direction, right, down = np.zeros((3, 3))
    direction[axis], right[axis - 2], down[axis - 1] = sign, step, step
    return Rays(origin, direction, right, down, False, (size, size))


def tetrahedra(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Shape:
    """Return points (P, 3), cells (T, 4): the boxes between planes across each axis, cut in six
    each."""
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    shape = len(x), len(y), len(z)
    numbers = np.arange(len(points)).reshape(shape)
    a, b, c = (n - 1 for n in shape)
    corners = [numbers[i : i + a, j : j + b, k : k + c] for i, j, k in product((0, 1), repeat=3)]
    return points, np.stack(corners, axis=-1).reshape(-1, 8)[:, KUHN].reshape(-1, 4)
