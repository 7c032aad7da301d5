"""Reading triangle meshes: OBJ, OFF, PLY and STL by modules of their names, glTF by trimesh.

trimesh reads from memory. Nothing is welded or moved.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import MeshError, VoxtoolError, one_line, printable
from voxtool.files import obj, off, ply, stl
from voxtool.files.formats import GZIP, HDF5
from voxtool.files.streams import STREAM, read_at_most, read_error
from voxtool.memory import available_memory, check_memory
from voxtool.mesh.mesh import Mesh, check_indices, check_promised, mesh_from_arrays

KINDS = ("obj", "stl", "ply", "off", "glb", "gltf")  # what we, and trimesh with numpy alone, read
OWN = {"obj": obj.parse, "off": off.parse, "ply": ply.parse, "stl": stl.parse}
MAX_BYTES = 8 << 30  # of one file, unpacked
# A .gz may unpack to this many times its size, and some bytes more. Of a plane of equal triangles,
# ASCII STL packs best: 17 times. Deflate packs zeros 1032 times.
MOST_PACKED, ANY_SIZE = 100, 1 << 24
ITEM_BYTES = 120  # of memory that each vertex or index of a glTF scene takes at most
DEEPEST = 64  # nodes inside nodes of a scene


def load_mesh(
    path: str | os.PathLike[str] | BinaryIO,
    file_type: str | None = None,
    max_bytes: int = MAX_BYTES,
    max_memory: int | None = None,
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
        The largest file that is read, unpacked; never more than half of the free memory.
    max_memory : int, optional
        Bytes of memory that unpacking a .gz, or placing the meshes of a scene, may take.

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
            most = min(max_bytes, available_memory() // 2)
            data = read_at_most(stream, most, first)
            if data is None:
                raise _too_large(name, most)
    except (OSError, ValueError) as error:
        raise MeshError(str(read_error(name, error))) from None
    if not data:
        raise MeshError(f"{name}: the file is empty: export the mesh again")
    with ThreadPoolExecutor(1) as beside:  # hashing does not hold the interpreter's lock
        digest = beside.submit(hashlib.sha256, data)
        limit = most if max_memory is None else min(most, max_memory)
        vertices, faces, units = _parsed(name, kind, data, limit, max_memory)
    source = digest.result().hexdigest()
    return mesh_from_arrays(vertices, faces, source_sha256=source, name=name, units=units)


def as_mesh(thing: Any, max_memory: int | None = None) -> Mesh:
    """Return a Mesh of a Mesh, of a path, of an object with `vertices` and `faces` such as a
    trimesh.Trimesh, or of a pair of arrays, (V, 3) and (F, 3); MeshError for anything else."""
    if isinstance(thing, Mesh):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_mesh(thing, max_memory=max_memory)
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        units = getattr(thing, "units", None)
        return mesh_from_arrays(thing.vertices, thing.faces, units=units or "")
    if isinstance(thing, tuple | list) and len(thing) == 2:
        return mesh_from_arrays(*thing)
    raise MeshError(
        f"{type(thing).__name__} is no mesh: give a Mesh, a trimesh.Trimesh, a path, or a pair of "
        "arrays, (V, 3) vertices and (F, 3) faces"
    )


def _parsed(
    name: str, kind: str, data: bytes, limit: int, max_memory: int | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the vertices, the faces and the units of a file, which unpacks to `limit` bytes at
    most."""
    data = _unpacked(name, data, limit)
    kind = kind or _kind_of_content(data)
    if kind not in OWN:
        return *_through_trimesh(name, kind, data, max_memory), "m"  # the units of glTF
    if kind == "obj":
        _refuse_binary(name, data)
    return *OWN[kind](name, data), ""


# --- bytes ---------------------------------------------------------------------------------------


def _too_large(name: str, most: int) -> MeshError:
    return MeshError(
        f"{name}: more than {most >> 20} MiB unpacked, the most that is read here: simplify or "
        "split the mesh"
    )


def _unpacked(name: str, data: bytes, limit: int) -> bytes:
    """Return the data, decompressed if it is gzip; its size is known before memory is taken."""
    if not data.startswith(GZIP):
        if name.lower().endswith(".gz"):
            raise MeshError(f"{name}: not packed with gzip: drop .gz from its name")
        return data
    import gzip
    import zlib

    most = min(limit, MOST_PACKED * len(data) + ANY_SIZE)
    size = 0
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            while size <= most and (piece := packed.read(1 << 20)):
                size += len(piece)
            if size > limit:
                raise _too_large(name, limit)
            if size > most:
                raise MeshError(
                    f"{name}: unpacks to more than {MOST_PACKED} times its size, which no mesh "
                    "does: unpack it first, if you trust it"
                )
            packed.seek(0)
            data = packed.read(size)
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
    if stl.binary_size(data) == len(data) or re.match(rb"\s*solid\b", data):
        return "stl"
    return "obj"


# --- trimesh -------------------------------------------------------------------------------------


def _through_trimesh(
    name: str, kind: str, data: bytes, max_memory: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces that trimesh reads from memory: no other file, no texture,
    nothing moved."""
    import logging

    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    try:
        _check_scene(name, kind, data, max_memory)
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=kind,
            process=False,
            maintain_order=True,
            skip_materials=True,
        )
        return _merged(name, scene)
    except VoxtoolError:
        raise
    except (Exception, SystemExit) as error:
        reason = one_line(error) or type(error).__name__
        raise MeshError(
            f"{name}: not readable as {kind.upper()}: {reason}: it may be truncated or damaged, "
            "export it again"
        ) from None


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
        matrix = _placement(name, node, parents)
        if not (matrix == np.eye(4)).all():
            points = _product(matrix, [*points.T, np.ones(len(points))])[:3].T
            (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3]
            if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
                corners = corners[:, ::-1]  # a mirror image keeps its outside
        all_points.append(points)
        all_corners.append(corners + count)
        count += len(points)
    return np.concatenate(all_points), np.concatenate(all_corners)


def _placement(name: str, node: Any, parents: dict[Any, Any]) -> np.ndarray:
    """Return the (4, 4) transform from the node's coordinates to the scene's."""
    matrix = np.eye(4)
    for _ in range(DEEPEST):
        if node not in parents:
            return matrix
        node, attributes = parents[node]
        matrix = _product(np.asarray(attributes.get("matrix", np.eye(4))), matrix)
    raise MeshError(f"{name}: a scene of nodes inside more than {DEEPEST} others: flatten it")


def _product(matrix: np.ndarray, rows: Any) -> np.ndarray:
    """Return matrix @ rows, written out: results of BLAS differ between machines."""
    m = matrix[:, :, None]
    return m[:, 0] * rows[0] + m[:, 1] * rows[1] + m[:, 2] * rows[2] + m[:, 3] * rows[3]


def _check_scene(name: str, kind: str, data: bytes, max_memory: int | None) -> None:
    """Refuse a glTF scene with counts that its bytes cannot hold, or whose meshes do not fit in
    memory: many may share the same bytes."""
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if kind == "glb" else data
    tree: dict[str, Any] = json.loads(text)
    counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
    check_promised(name, max(counts, default=0), 0, len(data))

    def items(primitive: dict[str, Any]) -> int:
        used = primitive["attributes"].get("POSITION"), primitive.get("indices")
        return sum(counts[accessor] for accessor in used if accessor is not None)

    meshes = [sum(map(items, mesh["primitives"])) for mesh in tree.get("meshes", [])]
    placed = sum(meshes[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node)
    needed = ITEM_BYTES * (sum(counts) + sum(meshes) + placed)
    check_memory(needed, f"{name}: its meshes", "split the scene", max_memory)
