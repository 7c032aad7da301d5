"""Triangle meshes: the data, checked.

A mesh is kept as its file has it: vertices and faces in the file's order, nothing welded, nothing
dropped. Faces that name a vertex twice, or of zero area, are the segments and points that they
are. Two vertices are one where their positions are bit-equal (-0.0 is 0.0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.errors import MeshError, count_of, one_line

MAX_COUNT = (1 << 31) - 1  # triangles, and vertices: indices are int32


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; `mesh_from_arrays` makes one of any arrays and checks it.

    vertices : (V, 3) float64, C-contiguous, world units.
    faces : (F, 3) int32, C-contiguous: the vertices of each triangle.
    source_sha256 : hex digest of the bytes that it was read from (for .gz: the packed ones), or "".
    name : file name for messages, or "".
    units : name of the world unit if the format knows it, or "".
    """

    vertices: np.ndarray
    faces: np.ndarray
    source_sha256: str = ""
    name: str = ""
    units: str = ""

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64: low and high corner of the vertices that faces use.

        Raises
        ------
        MeshError : there are no faces.
        """
        if not len(self.faces):
            raise MeshError(f"{self.name or 'mesh'}: no faces: it has no bounds")
        used = np.zeros(len(self.vertices), bool)
        used[self.faces] = True
        points = self.vertices[used]
        return np.stack([points.min(axis=0), points.max(axis=0)]) + 0.0  # no -0.0


def mesh_from_arrays(
    vertices: Any, faces: Any, *, source_sha256: str = "", name: str = "", units: str = ""
) -> Mesh:
    """A checked mesh of any arrays.

    Parameters
    ----------
    vertices : (V, 3) numbers, world units.
    faces : (F, 3) whole numbers: the vertices of each triangle, counted from 0.
    source_sha256, name, units : as in Mesh.

    Raises
    ------
    MeshError : a wrong shape, no faces, an index out of range, a coordinate that is not finite,
        or all points equal.
    """
    where = name or "mesh"
    try:
        points = np.ascontiguousarray(vertices, np.float64)
        corners = np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise MeshError(f"{where}: not arrays of numbers: {one_line(error)}") from None
    if corners.size == 0:
        raise MeshError(
            f"{where}: {count_of(len(points), 'point')} and no faces: export its triangles"
        )
    if points.ndim != 2 or points.shape[1] != 3 or corners.ndim != 2 or corners.shape[1] != 3:
        raise MeshError(
            f"{where}: vertices of shape {points.shape} and faces of shape {corners.shape}: "
            "give (V, 3) and (F, 3)"
        )
    if not np.issubdtype(corners.dtype, np.integer):
        raise MeshError(f"{where}: faces of type {corners.dtype}: give whole numbers")
    check_counts(where, len(points), len(corners))
    check_indices(where, corners, len(points))
    if not np.isfinite(points).all():
        vertex = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise MeshError(
            f"{where}: vertex {vertex} is not finite: ({', '.join(map(str, points[vertex]))}): "
            "remove it or give it a position"
        )
    indices = np.ascontiguousarray(corners, np.int32)
    mesh = Mesh(points, indices, source_sha256, name, units)
    if (mesh.bounds[0] == mesh.bounds[1]).all():
        raise MeshError(
            f"{where}: all points of its {count_of(len(indices), 'face')} are equal, at "
            f"({', '.join(map(str, mesh.bounds[0]))}): the mesh has no size"
        )
    return mesh


def check_counts(name: str, vertices: int, faces: int) -> None:
    for count, what in ((faces, "triangles"), (vertices, "vertices")):
        if count > MAX_COUNT:
            raise MeshError(f"{name}: {count} {what}, at most {MAX_COUNT} can be read: split it")


def check_indices(where: str, corners: np.ndarray, vertices: int) -> None:
    if len(corners) and (corners.min() < 0 or corners.max() >= vertices):
        bad = (corners < 0) | (corners >= vertices)
        face = int(np.argmax(bad.any(axis=1)))
        raise MeshError(
            f"{where}: face {face} names vertex {corners[face][bad[face]][0]} where there are "
            f"{vertices}, both counted from 0: mend the index, or the file is truncated"
        )
