"""Binary glTF 2.0 of several meshes, a node for each: float32 coordinates, normals and colours,
uint32 indices.

Colours of vertices are in linear light, as glTF says. Their material is rough and no metal, so that
programs show them as they are; it blends if one of them is not opaque.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import FileError
from voxtool.files.meshes.gltf import TRIANGLES
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

BYTES = (1 << 32) - (1 << 16)  # a GLB counts its bytes in 32 bits
FLOATS, INDICES = 5126, 5125  # types of components of glTF
VERTICES, FACES = 34962, 34963  # what buffer views of glTF are for
ROUGH = {"metallicFactor": 0, "roughnessFactor": 1}


class Node(NamedTuple):
    """A mesh with its name, and the normals of its vertices if they are written."""

    name: str
    mesh: Mesh
    normals: np.ndarray | None = None


def write_nodes(nodes: Iterable[Node], file: BinaryIO, limit: int = BYTES) -> None:
    """Write meshes with faces as nodes, of at most `limit` bytes together."""
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
            raise FileError("GLB holds 4 GiB at most: write .ply, or .obj of several meshes")
        return len(accessors) - 1

    meshes, materials = [], []
    for name, mesh, normals in nodes:
        points, faces = mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        attributes = {"POSITION": put(points, VERTICES, FLOATS, "VEC3", **bounds)}
        primitive: dict[str, Any] = {"attributes": attributes}
        if normals is not None:
            attributes["NORMAL"] = put(normals.astype("<f4"), VERTICES, FLOATS, "VEC3")
        if mesh.colours is not None:
            light = mesh.colours.astype("<f4")
            attributes["COLOR_0"] = put(light, VERTICES, FLOATS, "VEC4")
            opaque = {} if (light[:, 3] == 1).all() else {"alphaMode": "BLEND"}
            primitive["material"] = len(materials)
            materials.append({"pbrMetallicRoughness": ROUGH, **opaque})
        primitive["indices"] = put(faces, FACES, INDICES, "SCALAR")
        primitive["mode"] = TRIANGLES
        meshes.append({"name": name, "primitives": [primitive]})
    tree = {
        "asset": {"version": "2.0", "generator": f"voxtool {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh["name"], "mesh": i} for i, mesh in enumerate(meshes)],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
        **({"materials": materials} if materials else {}),
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
