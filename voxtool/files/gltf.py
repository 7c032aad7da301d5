"""glTF 2.0, as text (.gltf) or binary (.glb), by trimesh, which reads from memory."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from voxtool.errors import MeshError, VoxtoolError, one_line
from voxtool.files.placement import DEEPEST, Part, check_placed, merged, product
from voxtool.mesh.mesh import check_promised

UNITS = "m"  # of every glTF


def parse(
    name: str, kind: str, data: bytes, max_memory: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of all meshes, placed by the
    transforms of the nodes.

    No other file and no texture is read, and trimesh moves nothing.
    """
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
        return merged(name, _parts(name, scene))
    except VoxtoolError:
        raise
    except (Exception, SystemExit) as error:
        reason = one_line(error) or type(error).__name__
        raise MeshError(
            f"{name}: not readable as {kind.upper()}: {reason}: it may be truncated or damaged, "
            "export it again"
        ) from None


def _parts(name: str, scene: Any) -> Iterator[Part]:
    """Yield the mesh of each node that has one, and its transform."""
    parents = {b: (a, attributes) for a, b, attributes in scene.graph.to_edgelist()}
    for node, (_, attributes) in parents.items():
        mesh = scene.geometry.get(attributes.get("geometry"))
        if mesh is not None:
            corners = np.asarray(getattr(mesh, "faces", np.empty((0, 3), np.int64)))
            yield np.asarray(mesh.vertices, np.float64), corners, _placement(name, node, parents)


def _placement(name: str, node: Any, parents: dict[Any, Any]) -> np.ndarray:
    """Return the (4, 4) transform from the node's coordinates to the scene's."""
    matrix = np.eye(4)
    for _ in range(DEEPEST):
        if node not in parents:
            return matrix
        node, attributes = parents[node]
        matrix = product(np.asarray(attributes.get("matrix", np.eye(4))), matrix)
    raise MeshError(f"{name}: a scene of nodes inside more than {DEEPEST} others: flatten it")


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
    check_placed(name, sum(counts) + sum(meshes) + placed, max_memory)
