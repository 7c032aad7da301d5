"""The meshes of the labels of an octree in one file: objects of OBJ, or nodes of GLB.

OBJ has one list of vertices, to which the faces of all objects refer. In GLB each node has vertices
of its own; those on common borders are bit-equal. Numbers are written as those of single meshes.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, printable
from voxtool.files.gltf import TRIANGLES
from voxtool.files.mesh_writers import GLB_BYTES, HEADER, check_float32, decimals_of
from voxtool.mesh.mesh import Mesh

if TYPE_CHECKING:
    from voxtool.svo.surface.labelled import LabelledSurface

LINES = 1 << 16  # that become text at once
FLOATS, INDICES = 5126, 5125  # types of components of glTF
VERTICES, FACES = 34962, 34963  # what buffer views of glTF are for


def write_obj(surface: LabelledSurface, file: BinaryIO) -> None:
    """Write OBJ text: the vertices, then an object for each label."""
    file.write(f"# {HEADER}\n".encode())
    places = decimals_of(Mesh(surface.vertices, surface.faces))
    _write_lines(file, f"v %.{places}f %.{places}f %.{places}f\n", surface.vertices)
    for label in surface.labels:
        file.write(f"o {_name_of(surface, label)}\n".encode())
        _write_lines(file, "f %d %d %d\n", surface.faces_of(label) + 1)


def write_glb(surface: LabelledSurface, file: BinaryIO, limit: int = GLB_BYTES) -> None:
    """Write binary glTF 2.0: a node for each label, of at most `limit` bytes together."""
    check_float32(Mesh(surface.vertices, surface.faces), "GLB")
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    blocks: list[np.ndarray] = []
    size = 0

    def put(array: np.ndarray, target: int, component: int, kind: str, **more: Any) -> int:
        nonlocal size
        view = {"buffer": 0, "byteOffset": size, "byteLength": array.nbytes, "target": target}
        count = array.size if kind == "SCALAR" else len(array)
        accessor = {"bufferView": len(views), "componentType": component, "count": count}
        views.append(view)
        accessors.append({**accessor, "type": kind, **more})
        blocks.append(array)
        size += array.nbytes
        if size > limit:
            raise FileError("GLB holds 4 GiB at most and these meshes have more: write .obj")
        return len(accessors) - 1

    meshes = []
    for label in surface.labels:
        mesh = surface.mesh(label)
        points, faces = mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        primitive = {
            "attributes": {"POSITION": put(points, VERTICES, FLOATS, "VEC3", **bounds)},
            "indices": put(faces, FACES, INDICES, "SCALAR"),
            "mode": TRIANGLES,
        }
        meshes.append({"name": _name_of(surface, label), "primitives": [primitive]})
    tree = {
        "asset": {"version": "2.0", "generator": HEADER},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh["name"], "mesh": i} for i, mesh in enumerate(meshes)],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    if not meshes:
        tree = {"asset": tree["asset"]}
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    whole = 12 + 8 + len(text) + (8 + size if meshes else 0)
    file.write(struct.pack("<4sII", b"glTF", 2, whole))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    if meshes:
        file.write(struct.pack("<I4s", size, b"BIN\0"))
    for block in blocks:
        file.write(np.ascontiguousarray(block).data)


def _name_of(surface: LabelledSurface, label: int) -> str:
    """Return the name of a label on one line; that of a label without one is its number."""
    return printable(surface.names[label]).strip() or f"label {label}"


def _write_lines(file: BinaryIO, line: str, rows: np.ndarray) -> None:
    """Write a line for each row of numbers."""
    for first in range(0, len(rows), LINES):
        part = rows[first : first + LINES]
        file.write((line * len(part) % tuple(part.ravel().tolist())).encode())
