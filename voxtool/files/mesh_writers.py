"""Triangle meshes as OBJ, PLY, STL, GLB and OFF, through trimesh.

Nothing is welded, dropped or moved. The bytes depend on the mesh and the version of trimesh alone:
what trimesh would derive through BLAS (face normals, unit vectors) it is given, or spared.
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
TEXT_MEMORY = 250  # bytes of memory a face, and a vertex, while trimesh formats them: measured
GLB_BYTES = (1 << 32) - (1 << 16)  # a GLB counts its bytes in 32 bits
LEAST_CELLS = 1000  # along the longest side, that rounding to float32 must tell apart


def write_obj(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write OBJ text, of fixed decimals that suit the mesh.

    Raises
    ------
    MeshError, MemoryLimitError : as in write_mesh. OSError : the file cannot be written.
    """
    given = _given(mesh, normals)
    if not len(mesh.faces):  # for a mesh of none, trimesh writes a bare "f"
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
    """Write OFF text, of fixed decimals that suit the mesh.

    Raises
    ------
    MeshError, MemoryLimitError : as in write_mesh. OSError : the file cannot be written.
    """
    given = _given(mesh, normals)
    _check_text(mesh)
    file.write(given.export(file_type="off", digits=_decimals(mesh)).encode())


def write_ply(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write binary PLY: float32 coordinates and normals, int32 indices.

    Raises
    ------
    FileError, MeshError : as in write_mesh. OSError : the file cannot be written.
    """
    given = _given(mesh, normals)
    _check_float32(mesh, "PLY")
    with_normals = normals is not None and len(mesh.vertices) > 0  # of none it would derive them
    file.write(given.export(file_type="ply", vertex_normal=with_normals))


def write_stl(mesh: Mesh, file: BinaryIO, normals: None = None) -> None:
    """Write binary STL: three float32 corners and the unit normal of each face.

    Raises
    ------
    FileError, MeshError : as in write_mesh. OSError : the file cannot be written.
    """
    _check_finite(mesh)
    _check_float32(mesh, "STL")
    triangles = mesh.vertices[mesh.faces]
    file.write(
        export_stl(
            SimpleNamespace(
                faces=mesh.faces, triangles=triangles, face_normals=_face_normals(triangles)
            )
        )
    )


def write_glb(mesh: Mesh, file: BinaryIO, normals: np.ndarray | None = None) -> None:
    """Write binary glTF 2.0: float32 coordinates and normals, uint32 indices.

    Raises
    ------
    FileError, MeshError : as in write_mesh. OSError : the file cannot be written.
    """
    given = _given(mesh, normals)
    _check_float32(mesh, "GLB")
    vertex_bytes = 12 if normals is None else 24
    if 12 * len(mesh.faces) + vertex_bytes * len(mesh.vertices) > GLB_BYTES:
        raise FileError("GLB holds 4 GiB at most and this mesh has more: write .ply")
    file.write(
        given.export(file_type="glb", include_normals=normals is not None, unitize_normals=False)
    )


# What trimesh is given


def _given(mesh: Mesh, normals: np.ndarray | None) -> Any:
    """The mesh as one of trimesh's, with its normals."""
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
        normals = normals if len(normals) else None  # trimesh takes the extent of none
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, process=False)


def _decimals(mesh: Mesh) -> int:
    """Decimals that give a tenth of the largest coordinate 17 significant digits, which is what
    float64 tells apart, and show 1e-9 of the longest side."""
    used = mesh.vertices[mesh.faces].reshape(-1, 3) if len(mesh.faces) else mesh.vertices
    largest = np.abs(mesh.vertices).max(initial=0)
    with np.errstate(over="ignore"):
        side = np.ptp(used, axis=0).max() if len(used) else 0
    # exponents by decimals: log10 may be off next to a power of ten
    needed = [n - Decimal(float(x)).adjusted() for n, x in ((17, largest), (9, side)) if x > 0]
    return max(0, *needed) if needed else 0


def _face_normals(triangles: np.ndarray) -> np.ndarray:
    """(F, 3) float64 unit normals of (F, 3, 3) triangles; zero for those of zero area."""
    with np.errstate(all="ignore"):
        p, q = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
        normal = cross(p, q)
        normal /= length(normal)[:, None]
    return np.where(np.isfinite(normal), normal, 0.0)


# What a format cannot hold


def _check_finite(mesh: Mesh) -> None:
    if not np.isfinite(mesh.vertices).all():
        vertex = int(np.argmin(np.isfinite(mesh.vertices).all(axis=1)))
        raise MeshError(
            f"{mesh.name or 'mesh'}: vertex {vertex} is not finite: remove it or give it a position"
        )


def _check_float32(mesh: Mesh, kind: str) -> None:
    """Refuse a mesh that rounding to float32 would visibly bend or flatten."""
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
