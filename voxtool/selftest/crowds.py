"""Degenerate meshes of any number of faces: copies, fans, books, loops, lines and needles.

Each takes a number of faces, and returns a mesh of about as many. They are computed with + - * /
and square roots alone, so they are the same on every machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.selftest.shapes import TETRAHEDRON_FACES, Shape
from voxtool.spatial.sampling import sample_cube

if TYPE_CHECKING:
    from collections.abc import Callable

THIN = 1e-6  # the thickness of a bundle of needles, of its length
TETRAHEDRON = np.concatenate([np.zeros((1, 3)), np.eye(3)])


def copies(n: int) -> Shape:
    """Return copies of one triangle."""
    return np.eye(3), np.tile([0, 1, 2], (n, 1))


def points(n: int) -> Shape:
    """Return a tetrahedron, and triangles that are a point: its corner."""
    return TETRAHEDRON, np.concatenate([TETRAHEDRON_FACES, np.zeros((n - 4, 3), np.int64)])


def collinear(n: int) -> Shape:
    """Return triangles whose corners are all on one line."""
    return np.arange(n + 2.0)[:, None] * (1, 1, 1), np.arange(n)[:, None] + (0, 1, 2)


def fan(n: int) -> Shape:
    """Return an open cone: triangles about one vertex, each of which shares edges with the next."""
    ring = np.insert(_circle(np.arange(n) / n), 2, 1, axis=1)
    corners = 1 + np.arange(n)
    faces = np.stack([np.zeros(n, np.int64), np.roll(corners, -1), corners], axis=1)
    return np.concatenate([np.zeros((1, 3)), ring]), faces


def closed_fans(n: int) -> Shape:
    """Return a closed double cone: two vertices with half of the triangles each."""
    vertices, faces = fan(n // 2)
    back = np.where(faces == 0, len(vertices), faces)[:, [0, 2, 1]]
    return np.concatenate([vertices, [[0, 0, 1.5]]]), np.concatenate([faces, back])


def loose_fan(n: int) -> Shape:
    """Thin triangles about one vertex in all directions, no two of which share an edge."""
    x, z = sample_cube(n).T[:2]
    ring = np.insert(_circle(x) * np.sqrt(1 - (2 * z - 1) ** 2)[:, None], 2, 2 * z - 1, axis=1)
    rim = np.stack([ring, ring + 0.01 * np.roll(ring, 1, axis=0)], axis=1).reshape(-1, 3)
    faces = np.insert(1 + np.arange(2 * n).reshape(-1, 2), 0, 0, axis=1)
    return np.concatenate([np.zeros((1, 3)), rim]), faces


def book(n: int) -> Shape:
    """Return triangles about one edge."""
    x, z = sample_cube(n).T[:2]
    pages = np.insert(_circle(x), 2, z, axis=1)
    faces = np.stack([np.zeros(n, np.int64), np.ones(n, np.int64), 2 + np.arange(n)], axis=1)
    return np.concatenate([[[0, 0, 0], [0, 0, 1]], pages]), faces


def loops(n: int) -> Shape:
    """Return small triangles apart from each other: a boundary loop each."""
    corners = sample_cube(n)[:, None] + 0.2 / np.cbrt(n) * np.eye(3)
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def needles(n: int) -> Shape:
    """Return long thin triangles beside one line, no two of which share a vertex."""
    place, along = sample_cube(n), np.array([1, 0, 0])
    ends = THIN * np.insert(_circle(place[:, 0]) * (0.5 + place[:, 1:2]), 0, 0, axis=1)
    tips = np.roll(ends, 1, axis=0) + place[:, 2:] * along
    corners = np.stack([ends, ends + along, tips], axis=1)
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)


def shells(n: int) -> Shape:
    """Return small closed tetrahedra apart from each other."""
    return _tetrahedra(sample_cube(n // 4)[:, None] + 0.2 / np.cbrt(n) * TETRAHEDRON)


def nested(n: int) -> Shape:
    """Return closed tetrahedra, each inside the one before."""
    size = 2 - np.arange(n // 4) / (n // 4)
    return _tetrahedra(size[:, None, None] * (TETRAHEDRON - 0.25))


CROWDS: dict[str, Callable[[int], Shape]] = {
    shape.__name__.replace("_", "-"): shape
    for shape in (
        copies, points, collinear, fan, closed_fans, loose_fan, book, loops, needles, shells, nested
    )
}  # fmt: skip


def _circle(turns: np.ndarray) -> np.ndarray:
    """Return points on the unit circle, (n, 2), in the order of (n,) parts of a turn."""
    quarter, t = np.divmod(4 * turns, 1)
    x, y = (1 - t * t) / (1 + t * t), 2 * t / (1 + t * t)
    quarter = quarter[:, None]
    points = np.stack([x, y], axis=1)
    back = np.stack([-y, x], axis=1)
    return np.where(quarter >= 2, -1.0, 1.0) * np.where(quarter % 2 == 1, back, points)


def _tetrahedra(corners: np.ndarray) -> Shape:
    """Return the tetrahedra with (T, 4, 3) corners as a mesh."""
    faces = TETRAHEDRON_FACES + 4 * np.arange(len(corners))[:, None, None]
    return corners.reshape(-1, 3), faces.reshape(-1, 3)
