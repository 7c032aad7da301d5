"""Reading triangle meshes, each format by the module of its name. Nothing is welded or moved."""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import os
import re
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

from voxtool.choices import LENGTH_UNITS
from voxtool.errors import MeshError, one_line, printable
from voxtool.files.formats import GZIP, HDF5, ZIP
from voxtool.files.meshes.companions import Companions
from voxtool.files.meshes.placement import Read
from voxtool.files.storage.streams import STREAM, read_at_most, read_error
from voxtool.memory import available_memory
from voxtool.mesh.mesh import Mesh, mesh_from_arrays

KINDS = ("obj", "stl", "ply", "off", "glb", "gltf", "3mf")
PLY, GLB = (b"ply\n", b"ply\r"), b"glTF"  # how they begin
KEPT = ("parts", "appearance")
MAX_BYTES = 8 << 30  # bytes of one file, unpacked
# A .gz or .3mf may unpack to this many times its size, and some bytes more. A plane of equal
# triangles as ASCII STL packs best: 17 times. Deflate packs zeros 1032 times.
MOST_PACKED, ANY_SIZE = 100, 1 << 24


def load_mesh(
    path: str | os.PathLike[str] | BinaryIO,
    file_type: str | None = None,
    max_bytes: int = MAX_BYTES,
    max_memory: int | None = None,
    *,
    units: str | None = None,
    scale: float = 1.0,
    keep: Sequence[str] = (),
) -> Mesh:
    """Read a triangle mesh from OBJ, STL, PLY, OFF, GLB, glTF or 3MF, also compressed with gzip.

    Polygons become fans of triangles. Objects and groups are merged into one mesh, and the meshes
    of a scene are placed by its transforms. Parts, materials, textures and other files are read
    where `keep` asks for them.

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
    units : str, optional
        One of LENGTH_UNITS: what the scaled numbers mean, instead of what the file says.
    scale : float, optional
        Factor of all coordinates.
    keep : sequence of str
        Of KEPT: "parts" fills `parts` of the mesh, and "appearance" its `appearance`, which may
        read files in the folder of the mesh that it names: libraries of materials, and textures.

    Returns
    -------
    Mesh

    Raises
    ------
    MeshError
        If the file cannot be read or contains no usable mesh; one line that names the file, the
        place (line, face or vertex) and a remedy.
    """
    if not 0 < scale < math.inf:
        raise MeshError(f"scale {scale:g}: give a positive number")
    if units is not None and units not in LENGTH_UNITS:
        raise MeshError(f"units {units!r} are unknown: choose one of {', '.join(LENGTH_UNITS)}")
    if unknown := [what for what in keep if what not in KEPT]:
        raise MeshError(f"keep {unknown[0]!r} is unknown: choose of {', '.join(KEPT)}")
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
    limit = most if max_memory is None else min(most, max_memory)
    folder = None if given or not isinstance(path, str) else os.path.dirname(path)
    companions = Companions(name, folder, limit)
    digest = hashlib.sha256()
    beside = threading.Thread(target=digest.update, args=(data,))  # without the interpreter's lock
    beside.start()
    try:
        found = _parsed(name, kind, data, limit, max_memory, keep, companions)
    finally:
        beside.join()
    vertices = found.vertices
    if scale != 1:
        with np.errstate(over="ignore"):  # infinity is refused with the vertex
            vertices = vertices * scale
    return mesh_from_arrays(
        vertices, found.faces, source_sha256=digest.hexdigest(), name=name,
        units=units or found.units, parts=found.parts, appearance=found.appearance,
    )  # fmt: skip


def as_mesh(thing: Any, max_memory: int | None = None, keep: Sequence[str] = ()) -> Mesh:
    """Return a Mesh of a Mesh, of a path, of an object with `vertices` and `faces` such as a
    trimesh.Trimesh, or of a pair of arrays, (V, 3) and (F, 3); MeshError for anything else.

    A path is read with what is in `keep`.
    """
    if isinstance(thing, Mesh):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_mesh(thing, max_memory=max_memory, keep=keep)
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
    name: str,
    kind: str,
    data: bytes,
    limit: int,
    max_memory: int | None,
    keep: Sequence[str],
    companions: Companions,
) -> Read:
    """Return what a file holds, which unpacks to `limit` bytes at most."""
    data = _unpacked(name, data, limit)
    kind = kind or _kind_of_content(data)
    if kind in ("glb", "gltf"):
        from voxtool.files.meshes import gltf

        return gltf.parse(name, kind, data, max_memory, keep, companions)
    if kind == "3mf":
        from voxtool.files.meshes import threemf

        return threemf.parse(name, data, most_unpacked(data, limit), max_memory, keep)
    if kind == "obj":
        from voxtool.files.meshes import obj

        _refuse_binary(name, data)
        return obj.parse(name, data, keep, companions, max_memory)
    if kind == "ply":
        from voxtool.files.meshes import ply

        return ply.parse(name, data, keep)
    return Read(*import_module(f"voxtool.files.meshes.{kind}").parse(name, data))  # STL and OFF


# --- bytes ---------------------------------------------------------------------------------------


def _too_large(name: str, most: int) -> MeshError:
    return MeshError(
        f"{name}: more than {most >> 20} MiB unpacked, the most that is read here: simplify or "
        "split the mesh"
    )


def most_unpacked(data: bytes, limit: int) -> int:
    """Return the bytes that packed data may unpack to."""
    return min(limit, MOST_PACKED * len(data) + ANY_SIZE)


def _unpacked(name: str, data: bytes, limit: int) -> bytes:
    """Return the data, decompressed if it is gzip; its size is known before memory is taken."""
    if not data.startswith(GZIP):
        if name.lower().endswith(".gz"):
            raise MeshError(f"{name}: not packed with gzip: drop .gz from its name")
        return data
    import gzip
    import zlib

    most = most_unpacked(data, limit)
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
        what, other = "HDF5, such as a voxtool output", " or extract one (voxtool extract)"
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
    if b"\0" in data[: 1 << 20] or data.startswith((*PLY, GLB)):
        found = _kind_of_content(data)
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
    if data.startswith(PLY):
        return "ply"
    if data.startswith(GLB):
        return "glb"
    if data.startswith(ZIP):
        return "3mf"
    if re.match(rb"\s*(?:ST)?C?N?4?n?OFF\b", data):
        return "off"
    if data.lstrip().startswith(b"{"):
        return "gltf"
    from voxtool.files.meshes import stl

    if stl.binary_size(data) == len(data) or re.match(rb"\s*solid\b", data):
        return "stl"
    return "obj"


def relative_to(surface: Any, origin: Sequence[float] | None) -> Any:
    """Return a mesh, or the result of `extract`, with a point subtracted from its vertices."""
    if origin is None:
        return surface
    if hasattr(surface, "grid"):  # before vertices are rounded
        grid = surface.grid
        low = tuple(float(a - b) for a, b in zip(grid.origin, origin, strict=True))
        return replace(surface, grid=replace(grid, origin=low))
    mesh = as_mesh(surface)
    return replace(mesh, vertices=mesh.vertices - np.asarray(origin, np.float64))
