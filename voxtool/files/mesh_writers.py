"""Triangle meshes as OBJ, PLY, STL, GLB and OFF, through trimesh.

Nothing is welded, dropped or moved. The bytes depend only on the mesh and the version of trimesh:
face normals and unit vectors, which trimesh computes through BLAS, are computed here or left out.
"""

from __future__ import annotations

from decimal import Decimal
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np
import trimesh
from trimesh.exchange.stl import export_stl

from voxtool.errors import FileError, MeshError
from voxtool.memory import check_memory
from voxtool.vector import cross, length
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

HEADER = f"voxtool {__version__}"
TEXT_MEMORY = 250  # bytes of memory a face or vertex while trimesh formats it, as measured
GLB_BYTES = (1 << 32) - (1 << 16)  # a GLB counts its bytes in 32 bits
LEAST_CELLS = 1000  # float32 must resolve the longest side divided by this


def write_obj(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write OBJ text, with as many decimals as the mesh needs; raises as write_mesh."""
    given = _given(mesh, normals)
    if not len(mesh.faces):  # for a mesh without faces, trimesh writes an empty "f"
        given = cast("Any", trimesh.PointCloud(mesh.vertices))
    if not len(mesh.vertices):
        file.write(f"# {HEADER}\n".encode())
        return
    _check_text(mesh, 1 if normals is None else 2)
    text = given.export(
        file_type="obj",
        digits=max(_decimals(mesh), 0 if normals is None else 9),
        include_normals=normals is not None and len(mesh.faces) > 0,
        include_color=False,
        include_texture=False,
        header=HEADER,
    )
    file.write(text.encode())


def write_off(mesh: Mesh, file: BinaryIO, normals: None = None) -> None:
    """Write OFF text, with as many decimals as the mesh needs; raises as write_mesh."""
    given = _given(mesh, normals)
    _check_text(mesh)
    file.write(given.export(file_type="off", digits=_decimals(mesh)).encode())


def write_ply(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write binary PLY: float32 coordinates and normals, int32 indices; raises as write_mesh."""
    given = _given(mesh, normals)
    _check_float32(mesh, "PLY")
    with_normals = (
        normals is not None and len(mesh.vertices) > 0
    )  # without vertices trimesh computes them
    file.write(given.export(file_type="ply", vertex_normal=with_normals))


def write_stl(mesh: Mesh, file: BinaryIO, normals: None = None) -> None:
    """Write binary STL: float32 corners and unit normal of each face; raises as write_mesh."""
    _check_finite(mesh)
    _check_float32(mesh, "STL")
    triangles = mesh.vertices[mesh.faces]
    normal = _face_normals(triangles)
    content = SimpleNamespace(faces=mesh.faces, triangles=triangles, face_normals=normal)
    file.write(export_stl(content))


def write_glb(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write binary glTF 2.0: float32 coordinates and normals, uint32 indices; raises as
    write_mesh."""
    given = _given(mesh, normals)
    _check_float32(mesh, "GLB")
    vertex_bytes = 12 if normals is None else 24
    if 12 * len(mesh.faces) + vertex_bytes * len(mesh.vertices) > GLB_BYTES:
        raise FileError("GLB holds 4 GiB at most and this mesh has more: write .ply")
    file.write(
        given.export(file_type="glb", include_normals=normals is not None, unitize_normals=False)
    )


# ---- input of trimesh


def _given(mesh: Mesh, normals: np.ndarray | None) -> Any:
    """Return a trimesh.Trimesh of the mesh, with its normals."""
    _check_finite(mesh)
    where = mesh.name or "mesh"
    if normals is not None:
        normals = np.array(normals, np.float64)  # a copy: trimesh makes it read-only
        if normals.shape != mesh.vertices.shape:
            raise MeshError(
                f"{where}: normals of shape {normals.shape} for {len(mesh.vertices)} vertices: "
                "give one a vertex"
            )
        if not np.isfinite(normals).all():
            vertex = int(np.argmin(np.isfinite(normals).all(axis=1)))
            raise MeshError(f"{where}: the normal of vertex {vertex} is not finite: give it one")
        normals = normals if len(normals) else None  # trimesh fails on an empty array
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, process=False)


def _decimals(mesh: Mesh) -> int:
    """Return the decimals that give a tenth of the largest coordinate 17 significant digits, the
    precision of float64, and resolve 1e-9 of the longest side."""
    used = mesh.vertices[mesh.faces].reshape(-1, 3) if len(mesh.faces) else mesh.vertices
    largest = np.abs(mesh.vertices).max(initial=0)
    with np.errstate(over="ignore"):
        side = np.ptp(used, axis=0).max() if len(used) else 0
    # exponents by decimals: log10 may be off next to a power of ten
    needed = [n - Decimal(float(x)).adjusted() for n, x in ((17, largest), (9, side)) if x > 0]
    return max(0, *needed) if needed else 0


def _face_normals(triangles: np.ndarray) -> np.ndarray:
    """Return the unit normals of (F, 3, 3) triangles, (F, 3) float64; 0 for those of zero area."""
    with np.errstate(all="ignore"):
        p, q = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
        normal = cross(p, q)
        normal /= length(normal)[:, None]
    return np.where(np.isfinite(normal), normal, 0.0)


# ---- limits of the formats


def _check_finite(mesh: Mesh) -> None:
    if not np.isfinite(mesh.vertices).all():
        vertex = int(np.argmin(np.isfinite(mesh.vertices).all(axis=1)))
        raise MeshError(
            f"{mesh.name or 'mesh'}: vertex {vertex} is not finite: remove it or give it a position"
        )


def _check_float32(mesh: Mesh, kind: str) -> None:
    """Refuse a mesh that rounding to float32 would visibly deform."""
    if not len(mesh.faces):
        return
    low, high = mesh.bounds
    with np.errstate(over="ignore", under="ignore"):
        moved = np.abs(mesh.vertices.astype(np.float32) - mesh.vertices).max()
        side = (high - low).max()
    if moved == np.inf or moved * LEAST_CELLS > side:
        raise FileError(
            f"{kind} holds float32, which would move vertices by {moved:.3g} where the mesh is "
            f"{side:.3g} long: write .obj or .off"
        )


def _check_text(mesh: Mesh, parts: int = 1) -> None:
    count = len(mesh.faces) + len(mesh.vertices)
    check_memory(TEXT_MEMORY * parts * count, "the lines of the mesh", "write .ply")
