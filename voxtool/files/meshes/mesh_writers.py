"""Triangle meshes as OBJ and OFF, which are text, and as PLY, STL and GLB.

Nothing is welded or moved; materials and textures are not written. Numbers of text are read back
bit for bit. PLY, STL and GLB hold float32, 1 part in 1.6e7 of a coordinate; a mesh is refused if
that moves vertices by more than a thousandth of its longest side. STL repeats the corners of every
face. The unit of GLB is the metre. The bytes depend only on the mesh; of PLY and STL they are those
that trimesh writes, whose import takes longer than most meshes.
"""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import FileError, MeshError
from voxtool.mesh import srgb
from voxtool.vector import cross, length
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.svo.surface.blocks import BlockSurface

BAD_VERTEX = "vertex {} is not finite: remove it or give it a position"
HEADER = f"voxtool {__version__}"
LINES = 1 << 16  # that become text at once
PLY_HEADER = """ply
format binary_little_endian 1.0
comment https://github.com/mikedh/trimesh
element vertex {}
{}element face {}
property list uchar int vertex_indices
end_header
"""
PLY_VERTEX = [(name, "<f4") for name in "xyz"]
PLY_NORMAL = [(name, "<f4") for name in ("nx", "ny", "nz")]
PLY_COLOUR = [(name, "u1") for name in ("red", "green", "blue", "alpha")]
PLY_TYPES = {"<f4": "float", "u1": "uchar"}
STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
STL_HEAD = 80  # bytes before the number of faces
PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
LEAST_CELLS = 1000  # float32 must resolve the longest side divided by this


def write_obj(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write OBJ text, each number as the shortest one that reads back exactly; colours of vertices
    behind their coordinates, from 0 to 1 in sRGB, without opacity."""
    normals = _checked(mesh, normals)
    file.write(f"# {HEADER}\n".encode())
    rows = mesh.vertices
    if mesh.colours is not None:
        rows = np.concatenate([rows, _levels(mesh.colours)[:, :3] / 255], axis=1)
    write_lines(file, f"v{' %r' * rows.shape[1]}\n", rows)
    corner = "%d"
    faces = mesh.faces + 1
    if normals is not None:
        write_lines(file, "vn %r %r %r\n", normals)
        corner, faces = "%d//%d", np.repeat(faces, 2, axis=1)
    write_lines(file, f"f {corner} {corner} {corner}\n", faces)


def write_off(mesh: Mesh, file: BinaryIO, normals: None = None) -> None:
    """Write OFF text, each number as the shortest one that reads back exactly."""
    _checked(mesh, normals)
    file.write(f"OFF\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode())
    write_lines(file, "%r %r %r\n", mesh.vertices)
    write_lines(file, "3 %d %d %d\n", mesh.faces)


def write_lines(file: IO[bytes], line: str, rows: np.ndarray) -> None:
    """Write a line for each row of numbers."""
    for first in range(0, len(rows), LINES):
        part = rows[first : first + LINES]
        file.write((line * len(part) % tuple(part.ravel().tolist())).encode())


def write_ply(mesh: Mesh | BlockSurface, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write binary PLY: float32 coordinates and normals, int32 indices, and colours of vertices as
    bytes of sRGB and opacity."""
    from voxtool.mesh.mesh import Mesh

    if not isinstance(mesh, Mesh):
        _write_ply_blocks(mesh, file)
        return
    normals = _checked(mesh, normals)
    check_float32(mesh, "PLY")
    columns, parts = [*PLY_VERTEX], [mesh.vertices]
    if normals is not None and len(normals):
        columns, parts = [*columns, *PLY_NORMAL], [*parts, normals]
    if mesh.colours is not None:
        columns, parts = [*columns, *PLY_COLOUR], [*parts, _levels(mesh.colours)]
    rows = np.empty(len(mesh.vertices), columns)
    for (name, _), values in zip(columns, np.concatenate([part.T for part in parts]), strict=True):
        rows[name] = values
    file.write(_ply_header(len(rows), len(mesh.faces), columns))
    file.write(rows.data)
    file.write(_ply_faces(mesh.faces).data)


def _ply_header(vertices: int, faces: int, columns: list[tuple[str, str]]) -> bytes:
    properties = "".join(f"property {PLY_TYPES[kind]} {name}\n" for name, kind in columns)
    return PLY_HEADER.format(vertices, properties, faces).encode()


def _ply_faces(faces: np.ndarray) -> np.ndarray:
    rows = np.empty(len(faces), PLY_FACE)
    rows["count"], rows["corners"] = 3, faces
    return rows


def _write_ply_blocks(mesh: BlockSurface, file: BinaryIO) -> None:
    """Write the same PLY of a mesh whose vertices and faces come in blocks."""
    moved, low, high = 0.0, np.full(3, np.inf), np.full(3, -np.inf)
    for block in filter(len, mesh.vertices.blocks):
        moved = max(moved, np.abs(block.astype("<f4") - block).max())
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
    _check_moved(moved, (high - low).max(), "PLY")
    file.write(_ply_header(len(mesh.vertices), len(mesh.faces), PLY_VERTEX))
    for block in mesh.vertices.blocks:
        file.write(block.astype("<f4").data)
    for block in mesh.faces.blocks:
        file.write(_ply_faces(block).data)


def write_stl(mesh: Mesh, file: BinaryIO, normals: None = None) -> None:
    """Write binary STL: float32 corners and the unit normal of each face."""
    _check_finite(mesh, mesh.vertices, BAD_VERTEX)
    check_float32(mesh, "STL")
    triangles = mesh.vertices[mesh.faces]
    rows = np.zeros(len(triangles), STL_FACE)
    rows["normal"], rows["corners"] = _face_normals(triangles), triangles
    file.write(bytes(STL_HEAD) + len(rows).to_bytes(4, "little"))
    file.write(rows.data)


def write_glb(
    mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None, limit: int | None = None
) -> None:
    """Write binary glTF 2.0: float32 coordinates and normals, uint32 indices, at most `limit`
    bytes, by default what GLB holds."""
    from voxtool.files.meshes.glb import BYTES, Node, write_nodes

    normals = _checked(mesh, normals)
    check_float32(mesh, "GLB")
    nodes = [Node(mesh.name or "mesh", mesh, normals)] if len(mesh.faces) else []
    write_nodes(nodes, file, limit or BYTES)


# ---- what is written


def _checked(mesh: Mesh, normals: np.ndarray | None) -> np.ndarray | None:
    """Return a copy of the normals; MeshError if they or the vertices cannot be written."""
    _check_finite(mesh, mesh.vertices, BAD_VERTEX)
    if normals is None:
        return None
    normals = np.array(normals, np.float64)
    if normals.shape != mesh.vertices.shape:
        raise MeshError(
            f"{mesh.name or 'mesh'}: normals of shape {normals.shape} for "
            f"{len(mesh.vertices)} vertices: give one a vertex"
        )
    _check_finite(mesh, normals, "the normal of vertex {} is not finite: give it one")
    return normals


def _levels(colours: np.ndarray) -> np.ndarray:
    """Return colours in linear light, (V, 4), as bytes of sRGB and opacity."""
    light = np.rint(colours[:, :3] * srgb.ONE).astype(np.int64)
    opacity = np.rint(colours[:, 3:] * srgb.LEVELS).astype(np.uint8)
    return np.concatenate([srgb.to_levels(light), opacity], axis=1)


def _face_normals(triangles: np.ndarray) -> np.ndarray:
    """Return the unit normals of (F, 3, 3) triangles, (F, 3) float64; 0 for those of zero area."""
    with np.errstate(all="ignore"):
        p, q = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
        normal = cross(p, q)
        normal /= length(normal)[:, None]
    return np.where(np.isfinite(normal), normal, 0.0)


# ---- limits of the formats


def _check_finite(mesh: Mesh, rows: np.ndarray, message: str) -> None:
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise MeshError(f"{mesh.name or 'mesh'}: {message.format(np.argmin(finite))}")


def check_float32(mesh: Mesh, kind: str) -> None:
    """Refuse a mesh that rounding to float32 would visibly deform."""
    if not len(mesh.faces):
        return
    low, high = mesh.bounds
    with np.errstate(over="ignore", under="ignore"):
        moved = np.abs(mesh.vertices.astype(np.float32) - mesh.vertices).max()
        side = (high - low).max()
    _check_moved(moved, side, kind)


def _check_moved(moved: float, side: float, kind: str) -> None:
    """Refuse to move vertices so far where the mesh is `side` long."""
    if moved == np.inf or moved * LEAST_CELLS > side:
        raise FileError(
            f"{kind} holds float32, which would move vertices by {moved:.3g} where the mesh is "
            f"{side:.3g} long: write .obj or .off, or relative to a point of it (see --origin)"
        )
