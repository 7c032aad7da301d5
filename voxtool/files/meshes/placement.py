"""Meshes that a file places by transforms, each maybe several times, merged into one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from voxtool.files.storage.unpacked import check_unpacked
from voxtool.memory import check_memory
from voxtool.mesh.appearance import Appearance, Material, Parts
from voxtool.mesh.mesh import check_indices

ITEM_BYTES = 120  # bytes of memory that each vertex or index of a placed mesh takes at most
LOOK_BYTES = 80  # and of its colours and texture coordinates
DEEPEST = 64  # nodes inside nodes of a scene


class Read(NamedTuple):
    """The content of a file of meshes."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3) int64
    units: str = ""
    parts: dict[str, Parts] | None = None
    appearance: Appearance | None = None


class Part(NamedTuple):
    """A mesh where a file places it."""

    points: np.ndarray  # (V, 3) float64
    corners: np.ndarray  # (F, 3)
    matrix: np.ndarray  # (4, 4), of columns (x, y, z, 1)
    labels: dict[str, Any] = {}  # noqa: RUF012 (never written): a number or (F,), by what they name
    uv: np.ndarray | None = None  # (F, 3, 2)
    colours: np.ndarray | None = None  # (V, 4)


class Placed(NamedTuple):
    """All parts of a file as one mesh."""

    vertices: np.ndarray
    faces: np.ndarray
    labels: dict[str, np.ndarray]  # (F,) int32 each
    uv: np.ndarray | None
    colours: np.ndarray | None


def check_placed(
    name: str, items: int, held: int, max_memory: int | None, look: bool = False
) -> None:
    """Refuse a scene of more vertices and indices, once placed, than fit in memory, or than a file
    of `held` bytes is trusted with."""
    size = (ITEM_BYTES + LOOK_BYTES * look) * items
    check_memory(size, f"{name}: its meshes", "split the scene", max_memory)
    check_unpacked(size, held, f"{name}: its meshes take", max_memory)


def merged(name: str, parts: Iterable[Part]) -> Placed:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of all parts, transformed, with
    their labels and looks.

    A part that its transform mirrors has its faces turned, so that its outside stays outside. A
    part without texture coordinates has 0, and one without colours has 1, where others have them.
    """
    points_of, corners_of, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    labels: dict[str, list[np.ndarray]] = {}
    uv: list[tuple[np.ndarray | None, int]] = []
    colours: list[tuple[np.ndarray | None, int]] = []
    for points, corners, matrix, numbers, own_uv, own_colours in parts:
        check_indices(name, corners, len(points))
        if not (matrix == np.eye(4)).all():
            points = product(matrix, [*points.T, np.ones(len(points))])[:3].T
            if determinant(matrix) < 0:
                corners = corners[:, ::-1]
                own_uv = None if own_uv is None else own_uv[:, ::-1]
        points_of.append(points)
        corners_of.append(corners + count)
        count += len(points)
        for what, number in numbers.items():
            labels.setdefault(what, []).append(
                np.broadcast_to(np.asarray(number, np.int32), (len(corners),))
            )
        uv.append((own_uv, len(corners)))
        colours.append((own_colours, len(points)))
    return Placed(
        np.concatenate(points_of),
        np.concatenate(corners_of),
        {what: np.concatenate(numbers) for what, numbers in labels.items()},
        _joined(uv, (3, 2), 0.0),
        _joined(colours, (4,), 1.0),
    )


def _joined(
    rows: list[tuple[np.ndarray | None, int]], shape: tuple[int, ...], blank: float
) -> np.ndarray | None:
    """Return the arrays in one, with a number where there is none; None if all are None."""
    if all(array is None for array, _ in rows):
        return None
    full = [np.full((n, *shape), blank) if array is None else array for array, n in rows]
    return np.concatenate(full).astype(np.float64, copy=False)


def named(labels: np.ndarray, names: list[str]) -> Parts:
    """Return the parts of faces, without the names that no face has."""
    used = np.zeros(len(names), bool)
    used[labels] = True
    number = (np.cumsum(used) - 1).astype(np.int32)
    return Parts(number[labels], tuple(name for name, has in zip(names, used, strict=True) if has))


def look_of(placed: Placed, materials: list[Material]) -> Appearance | None:
    """Return the appearance of a merged mesh; None if it has no materials and no colours."""
    if not materials and placed.colours is None:
        return None
    none = np.full(len(placed.faces), -1, np.int32)
    material = placed.labels.get("look", none)
    textured = any(one.texture for one in materials)
    return Appearance(tuple(materials), material, placed.uv if textured else None, placed.colours)


def determinant(matrix: np.ndarray) -> float:
    """Return the determinant of the linear part of a transform; NaN beyond float64."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()  # Python's floats do not warn
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def product(matrix: np.ndarray, rows: Any) -> np.ndarray:
    """Return matrix @ rows, written out: results of BLAS differ between machines. Vertices that are
    not finite are refused later."""
    m = matrix[:, :, None]
    with np.errstate(all="ignore"):
        return m[:, 0] * rows[0] + m[:, 1] * rows[1] + m[:, 2] * rows[2] + m[:, 3] * rows[3]
