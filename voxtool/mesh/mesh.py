"""Triangle meshes: the data, checked.

A mesh keeps vertices and faces in the file's order; nothing is welded or dropped. Degenerate faces
are valid geometry: segments and points. Vertices at bit-equal positions (-0.0 is 0.0) count as one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.arrays import Data, aligned, read_only
from voxtool.errors import MeshError, count_of, one_line
from voxtool.mesh.appearance import WHITE, Appearance, Parts, check_described

MAX_COUNT = (1 << 31) - 1  # triangles, and vertices: indices are int32


@dataclass(frozen=True, eq=False, repr=False)
class Mesh(Data):
    """A triangle mesh; `mesh_from_arrays` makes one of any arrays and checks it.

    Its arrays are read-only: bounds, trees and octrees are computed from them once. For other
    vertices use `dataclasses.replace(mesh, vertices=...)`. Meshes are equal if all their arrays and
    texts are equal. They are hashed by identity, so that data computed from a mesh can be kept with
    it.

    Attributes
    ----------
    vertices : (V, 3) float64
        World units.
    faces : (F, 3) int32
        The vertices of each triangle.
    source_sha256 : str
        Hex digest of the bytes that it was read from (for .gz: the compressed ones), or "".
    name : str
        File name for messages, or "".
    units : str
        Name of the world unit if the format or the caller defines it, or "".
    transform : tuple of float
        Scale and offset x, y, z of a normalized mesh: vertices = original * scale + offset; ().
    parts : dict of Parts
        Which object, material and part each face belongs to, by these names, if they were read.
    appearance : Appearance, optional
        Materials, textures and colours of vertices, if they were read.

    Raises
    ------
    MeshError
        If an array is of another type or shape.
    """

    vertices: np.ndarray
    faces: np.ndarray
    source_sha256: str = ""
    name: str = ""
    units: str = ""
    transform: tuple[float, ...] = ()
    parts: dict[str, Parts] = field(default_factory=dict)
    appearance: Appearance | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, dtype in (("vertices", np.float64), ("faces", np.int32)):
            array = getattr(self, name)
            if array.dtype != dtype or array.ndim != 2 or array.shape[1] != 3:
                raise MeshError(
                    f"{self.name or 'mesh'}: {name} of type {array.dtype} and shape {array.shape}, "
                    f"not {np.dtype(dtype)} and (N, 3): mesh_from_arrays takes other arrays"
                )
        sizes = len(self.vertices), len(self.faces)
        check_described(self.name, *sizes, self.parts, self.appearance)

    def __repr__(self) -> str:
        name = f"{self.name!r}, " if self.name else ""
        vertices = count_of(len(self.vertices), "vertex")
        return f"Mesh({name}{vertices}, {count_of(len(self.faces), 'face')})"

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64: low and high corner of the vertices that faces use.

        Raises
        ------
        MeshError
            there are no faces.
        """
        if not len(self.faces):
            raise MeshError(f"{self.name or 'mesh'}: no faces: it has no bounds")
        used = np.zeros(len(self.vertices), bool)
        used[self.faces] = True
        points = self.vertices if used.all() else self.vertices[used]
        bounds = np.array([[f(points[:, axis]) for axis in range(3)] for f in (np.min, np.max)])
        return read_only(bounds + 0.0)  # no -0.0

    @property
    def colours(self) -> np.ndarray | None:
        """(V, 4) float64: the colours of the vertices, in linear light, or None if there are none
        or a material that is not plain white multiplies them."""
        look = self.appearance
        if look is None or any(one.texture or one.colour != WHITE for one in look.materials):
            return None
        return look.colours

    @cached_property
    def positions(self) -> np.ndarray:
        """(V,) int64: equal numbers for vertices at bit-equal positions."""
        points = self.vertices + 0.0  # -0.0 is 0.0
        order = np.argsort(points[:, 2])
        z = points[order, 2]
        tied = np.zeros(len(points) + 1, bool)
        tied[1:-1] = z[1:] == z[:-1]
        tied = tied[1:] | tied[:-1]
        some = order[tied]
        order[tied] = some[np.lexsort(points[some].T)]  # slow, so only for ties
        new = np.ones(len(points), np.int64)
        new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
        numbers = np.empty_like(new)
        numbers[order] = np.cumsum(new) - 1
        return read_only(numbers)

    def to_trimesh(self) -> Any:
        """Return a copy as a trimesh.Trimesh, with vertices and faces in the same order."""
        import trimesh

        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)


def mesh_from_arrays(
    vertices: Any,
    faces: Any,
    *,
    source_sha256: str = "",
    name: str = "",
    units: str = "",
    parts: dict[str, Parts] | None = None,
    appearance: Appearance | None = None,
) -> Mesh:
    """Return a checked mesh of any arrays, which are copied.

    Parameters
    ----------
    vertices : (V, 3) array_like
        World units.
    faces : (F, 3) array_like of int
        The vertices of each triangle, counted from 0.
    source_sha256, name, units, parts, appearance
        As in Mesh.

    Returns
    -------
    Mesh

    Raises
    ------
    MeshError
        If a shape is wrong, there are no faces, an index is out of range, a coordinate is not
        finite, or all points are equal.
    """
    where = name or "mesh"
    try:
        points = aligned(vertices, np.float64)
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
    indices = aligned(corners, np.int32)
    mesh = Mesh(
        points, indices, source_sha256, name, units, parts=parts or {}, appearance=appearance
    )
    if (mesh.bounds[0] == mesh.bounds[1]).all():
        raise MeshError(
            f"{where}: all points of its {count_of(len(indices), 'face')} are equal, at "
            f"({', '.join(map(str, mesh.bounds[0]))}): the mesh has no size"
        )
    return mesh


def check_source(mesh: Mesh, sha256: str, made: str) -> None:
    """Raise MeshError if a mesh is not the one with a SHA-256, from which something was made, an
    octree or a field."""
    if mesh.source_sha256 != sha256:
        raise MeshError(
            f"{mesh.name or 'mesh'}: the {made} was not made from it: its SHA-256 is "
            f"{mesh.source_sha256[:12] or 'unknown'}, and that of the {made}'s source is "
            f"{sha256[:12] or 'not known'}: give the source, or make the {made} from this mesh"
        )


def check_counts(name: str, vertices: int, faces: int) -> None:
    """Refuse a mesh of more vertices or faces than int32 can number."""
    for count, what in ((faces, "triangles"), (vertices, "vertices")):
        if count > MAX_COUNT:
            raise MeshError(
                f"{name}: {count:,} {what}, at most {MAX_COUNT:,} can be read: split it"
            )


def check_promised(name: str, vertices: int, faces: int, size: int) -> None:
    """Refuse counts in a header that `size` bytes cannot hold, or that check_counts refuses."""
    check_counts(name, vertices, faces)
    if vertices + faces > size:
        raise MeshError(
            f"{name}: {size:,} bytes cannot hold the {vertices:,} vertices and {faces:,} faces "
            "that the header promises: the file is truncated"
        )


def check_complete(name: str, found: tuple[int, int], promised: tuple[int, int]) -> None:
    """Refuse fewer vertices or faces than the header promises."""
    if found[0] < promised[0] or found[1] < promised[1]:
        raise MeshError(
            f"{name}: {found[0]:,} vertices and {found[1]:,} faces where the header promises "
            f"{promised[0]:,} and {promised[1]:,}: the file is truncated"
        )


def check_indices(where: str, corners: np.ndarray, vertices: int) -> None:
    """Refuse faces that name vertices which do not exist."""
    if len(corners) and (corners.min() < 0 or corners.max() >= vertices):
        bad = (corners < 0) | (corners >= vertices)
        face = int(np.argmax(bad.any(axis=1)))
        raise MeshError(
            f"{where}: face {face} names vertex {corners[face][bad[face]][0]} where there are "
            f"{vertices:,}, both counted from 0: correct the index, or the file is truncated"
        )
