"""Meshes that a file places by transforms, each maybe several times, merged into one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np

from voxtool.memory import check_memory
from voxtool.mesh.mesh import check_indices

ITEM_BYTES = 120  # of memory that each vertex or index of a placed mesh takes at most
DEEPEST = 64  # nodes inside nodes of a scene
# (V, 3) float64 vertices, (F, 3) faces, and the (4, 4) transform of columns (x, y, z, 1).
Part: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]


def check_placed(name: str, items: int, max_memory: int | None) -> None:
    """Refuse a scene of more vertices and indices, once placed, than fit in memory."""
    check_memory(ITEM_BYTES * items, f"{name}: its meshes", "split the scene", max_memory)


def merged(name: str, parts: Iterable[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of all parts, transformed.

    A part that its transform mirrors has its faces turned, so that its outside stays outside.
    """
    all_points, all_corners, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for points, corners, matrix in parts:
        check_indices(name, corners, len(points))
        if not (matrix == np.eye(4)).all():
            with np.errstate(all="ignore"):  # vertices that are not finite are refused later
                points = product(matrix, [*points.T, np.ones(len(points))])[:3].T
            if determinant(matrix) < 0:
                corners = corners[:, ::-1]
        all_points.append(points)
        all_corners.append(corners + count)
        count += len(points)
    return np.concatenate(all_points), np.concatenate(all_corners)


def determinant(matrix: np.ndarray) -> float:
    """Return the determinant of the linear part of a transform."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3]
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def product(matrix: np.ndarray, rows: Any) -> np.ndarray:
    """Return matrix @ rows, written out: results of BLAS differ between machines."""
    m = matrix[:, :, None]
    return m[:, 0] * rows[0] + m[:, 1] * rows[1] + m[:, 2] * rows[2] + m[:, 3] * rows[3]
