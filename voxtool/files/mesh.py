"""Reading triangle meshes: OBJ by obj.py, other formats by trimesh from memory.

Nothing is welded or moved.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import sys
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import MeshError, one_line, printable
from voxtool.files import obj
from voxtool.files.formats import GZIP, HDF5
from voxtool.files.streams import STREAM, read_error
from voxtool.mesh.mesh import Mesh, check_counts, check_indices, mesh_from_arrays

KINDS = ("obj", "stl", "ply", "off", "glb", "gltf")  # what trimesh reads with numpy alone
MAX_BYTES = 8 << 30  # of one file, unpacked


def load_mesh(
    path: str | os.PathLike[str] | BinaryIO,
    file_type: str | None = None,
    max_bytes: int = MAX_BYTES,
) -> Mesh:
    """Read a triangle mesh from OBJ, STL, PLY, OFF, GLB or glTF, compressed with gzip or not.

    Polygons become fans of triangles. Objects and groups are merged into one mesh, and the meshes
    of a scene are placed by its transforms. Materials, textures and other files are not read.

    Parameters
    ----------
    path : path or binary stream
        A file, "-" for standard input, or a stream.
    file_type : str, optional
        One of KINDS; by default the file name's extension, or the content if there is no name.
    max_bytes : int, optional
        The largest file that is read, unpacked; never more than half of the machine's memory.

    Returns
    -------
    Mesh

    Raises
    ------
    MeshError
        If the file cannot be read or contains no usable mesh; one line that names the file, the
        place (line, face or vertex) and a remedy.
    """
    if isinstance(path, os.PathLike):
        path = os.fsdecode(path)
    name = printable(path if isinstance(path, str) else getattr(path, "name", "stream"))
    opened: Any = path
    if path == STREAM:
        name, opened = "standard input", sys.stdin.buffer
    try:
        given = hasattr(opened, "read")
        with contextlib.nullcontext(opened) if given else open(opened, "rb") as stream:
            first = stream.read(1024)
            _refuse_other_files(name, first)
            kind = _kind_of_name(name, file_type, has_name=not given)
            data = _read_all(name, stream, max_bytes, first)
    except (OSError, ValueError) as error:
        raise MeshError(str(read_error(name, error))) from None
    if not data:
        raise MeshError(f"{name}: the file is empty: export the mesh again")
    digest = hashlib.sha256(data).hexdigest()
    data = _unpacked(name, data, max_bytes)
    kind = kind or _kind_of_content(data)
    if kind != "obj":
        return _through_trimesh(name, kind, data, digest)
    _refuse_binary(name, data)
    vertices, faces = obj.parse(name, data)
    return mesh_from_arrays(vertices, faces, source_sha256=digest, name=name)


def as_mesh(thing: Any) -> Mesh:
    """Return a Mesh of a Mesh, of a path, of an object with `vertices` and `faces` such as a
    trimesh.Trimesh, or of a pair of arrays, (V, 3) and (F, 3); MeshError for anything else."""
    if isinstance(thing, Mesh):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_mesh(thing)
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        units = getattr(thing, "units", None)
        return mesh_from_arrays(thing.vertices, thing.faces, units=units or "")
    if isinstance(thing, tuple | list) and len(thing) == 2:
        return mesh_from_arrays(*thing)
    raise MeshError(
        f"{type(thing).__name__} is no mesh: give a Mesh, a trimesh.Trimesh, a path, or a pair of "
        "arrays, (V, 3) vertices and (F, 3) faces"
    )


# --- bytes ---------------------------------------------------------------------------------------


def _read_all(name: str, stream: BinaryIO, limit: int, first: bytes = b"") -> bytes:
    """Read the rest of a stream, piece by piece, so that long input is refused early."""
    with contextlib.suppress(AttributeError, ValueError, OSError):  # no sysconf on Windows
        limit = min(limit, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2)
    pieces, size = [first], len(first)
    while piece := stream.read(1 << 22):
        pieces.append(piece)
        size += len(piece)
        if size > limit:
            most = f"more than {limit >> 20} MiB unpacked, the most that is read here"
            raise MeshError(f"{name}: {most}: simplify or split the mesh")
    return b"".join(pieces)


def _unpacked(name: str, data: bytes, limit: int) -> bytes:
    """Return the data, decompressed if it is gzip."""
    if not data.startswith(GZIP):
        if name.lower().endswith(".gz"):
            raise MeshError(f"{name}: not packed with gzip: drop .gz from its name")
        return data
    import gzip
    import zlib

    try:
        data = _read_all(name, gzip.GzipFile(fileobj=io.BytesIO(data)), limit)  # pyright: ignore
    except EOFError:
        raise MeshError(f"{name}: truncated: the gzip data ends early: copy it again") from None
    except (OSError, zlib.error) as error:
        raise MeshError(f"{name}: damaged gzip data: {one_line(error)}: copy it again") from None
    if not data:
        raise MeshError(f"{name}: the file is empty once unpacked: export the mesh again")
    _refuse_other_files(name, data)
    return data


def _refuse_other_files(name: str, data: bytes) -> None:
    if data.startswith(HDF5):
        what, other = "a voxtool output (HDF5)", " or extract one (voxtool extract)"
    elif data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"<?xml", b"<!DOCTYPE", b"<octree")):
        what, other = "XML, such as a voxtool output", " or extract one (voxtool extract)"
    elif data.startswith(b"<VTKFile"):
        what, other = "a VTK file", ""
    else:
        return
    raise MeshError(
        f"{name}: this is {what}, not a mesh: give the mesh that it was made from{other}"
    )


def _refuse_binary(name: str, data: bytes) -> None:
    found = _kind_of_content(data)
    if b"\0" in data[: 1 << 20] or found in ("ply", "glb"):
        hint = "export it as text" if found == "obj" else f"it looks like .{found}, rename it"
        raise MeshError(f"{name}: this is no text, so not an OBJ: {hint}")


def _kind_of_name(name: str, file_type: str | None, has_name: bool) -> str:
    """Return the format that the caller or the extension names; "" if only the content shows it."""
    if file_type is None and has_name:
        file_type = os.path.splitext(name.lower().removesuffix(".gz"))[1]
    if not file_type:
        return ""
    kind = file_type.lower().removesuffix(".gz").lstrip(".")
    if kind not in KINDS:
        known = " ".join(f".{k}" for k in KINDS)
        raise MeshError(f"{name}: unknown mesh format .{kind}: use {known} (or these with .gz)")
    return kind


def _kind_of_content(data: bytes) -> str:
    if data.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if data.startswith(b"glTF"):
        return "glb"
    if re.match(rb"\s*(?:ST)?C?N?4?n?OFF\b", data):
        return "off"
    if data.lstrip().startswith(b"{"):
        return "gltf"
    if _stl_size(data) == len(data) or re.match(rb"\s*solid\b", data):
        return "stl"
    return "obj"


def _stl_size(data: bytes) -> int:
    """Return the size of a binary STL with the number of triangles in its header, bytes."""
    return 84 + 50 * int.from_bytes(data[80:84], "little")


# --- trimesh -------------------------------------------------------------------------------------


def _through_trimesh(name: str, kind: str, data: bytes, digest: str) -> Mesh:
    """Read a mesh by trimesh from memory: no other file, no texture, nothing moved."""
    import logging
    import warnings

    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    try:
        promised = _promised(name, kind, data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # older numpy only warns of unmatched text
            warnings.filterwarnings("error", message="string or file could not be read")
            scene = trimesh.load_scene(
                io.BytesIO(data),
                file_type=kind,
                process=False,
                maintain_order=True,
                skip_materials=True,
                fix_texture=False,
            )
        vertices, faces = _merged(name, scene)
    except MeshError:
        raise
    except (Exception, SystemExit) as error:
        reason = one_line(error) or type(error).__name__
        raise MeshError(
            f"{name}: not readable as {kind.upper()}: {reason}: it may be truncated or damaged, "
            "export it again"
        ) from None
    if len(faces) and (len(vertices) < promised[0] or len(faces) < promised[1]):
        raise MeshError(
            f"{name}: {len(vertices)} vertices and {len(faces)} faces where the header promises "
            f"{promised[0]} and {promised[1]}: the file is truncated"
        )
    units = "m" if kind in ("glb", "gltf") else ""  # the format's own
    return mesh_from_arrays(vertices, faces, source_sha256=digest, name=name, units=units)


def _merged(name: str, scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of all meshes of a scene, placed by its transforms."""
    parents = {b: (a, attributes) for a, b, attributes in scene.graph.to_edgelist()}
    all_points, all_corners, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for node, (_, attributes) in parents.items():
        mesh = scene.geometry.get(attributes.get("geometry"))
        if mesh is None:
            continue
        points = np.asarray(mesh.vertices, np.float64)
        corners = np.asarray(getattr(mesh, "faces", all_corners[0]))
        check_indices(name, corners, len(points))
        matrix = _placement(node, parents)
        if not (matrix == np.eye(4)).all():
            points = _product(matrix, [*points.T, np.ones(len(points))])[:3].T
            (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3]
            if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
                corners = corners[:, ::-1]  # a mirror image keeps its outside
        all_points.append(points)
        all_corners.append(corners + count)
        count += len(points)
    return np.concatenate(all_points), np.concatenate(all_corners)


def _placement(node: Any, parents: dict[Any, Any]) -> np.ndarray:
    """Return the (4, 4) transform from the node's coordinates to the scene's."""
    matrix = np.eye(4)
    for _ in parents:  # no path is longer
        if node not in parents:
            break
        node, attributes = parents[node]
        matrix = _product(np.asarray(attributes.get("matrix", np.eye(4))), matrix)
    return matrix


def _product(matrix: np.ndarray, rows: Any) -> np.ndarray:
    """Return matrix @ rows, written out: results of BLAS differ between machines."""
    m = matrix[:, :, None]
    return m[:, 0] * rows[0] + m[:, 1] * rows[1] + m[:, 2] * rows[2] + m[:, 3] * rows[3]


def _promised(name: str, kind: str, data: bytes) -> tuple[int, int]:
    """Return the vertex and face counts of the header, 0 if absent; refuse impossible ones."""
    vertices = faces = 0
    if kind == "ply":
        header = data[: data.find(b"end_header")]
        counts = dict(re.findall(rb"^element\s+(vertex|face)\s+(\d+)", header, re.M))
        vertices, faces = int(counts.get(b"vertex", 0)), int(counts.get(b"face", 0))
    elif kind == "off":
        match = re.match(rb"(?:\s|#.*\n)*\w*OFF(?:\s|#.*\n)+(\d+)\s+(\d+)", data)
        vertices, faces = map(int, match.groups()) if match else (0, 0)
    elif kind == "stl" and len(data) != _stl_size(data):
        if b"\0" in data[:1024] or not re.match(rb"\s*solid\b", data):
            raise MeshError(
                f"{name}: {len(data)} bytes where an STL of {(_stl_size(data) - 84) // 50} "
                f"triangles, as the header counts, has {_stl_size(data)}: the file is truncated "
                "or no STL"
            )
        if b"endsolid" not in data[-4096:].lower():
            raise MeshError(f"{name}: 'endsolid' is missing at its end: the file is truncated")
    elif kind == "stl":
        faces = (_stl_size(data) - 84) // 50
    else:
        text = data
        if kind == "glb":
            text = data[20 : 20 + int.from_bytes(data[12:16], "little")]
        accessors = json.loads(text).get("accessors", [])
        vertices = max((int(a["count"]) for a in accessors), default=0)
    check_counts(name, vertices, faces)
    if vertices + faces > len(data):
        raise MeshError(
            f"{name}: {len(data)} bytes cannot hold the {vertices} vertices and {faces} faces "
            "that the header promises: the file is truncated"
        )
    return (vertices, faces) if kind in ("ply", "off", "stl") else (0, 0)
