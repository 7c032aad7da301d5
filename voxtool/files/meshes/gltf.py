"""glTF 2.0, as text (.gltf) or binary (.glb): the meshes of its scene, placed by its nodes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MeshError, VoxtoolError, one_line, printable
from voxtool.files.meshes.placement import (
    DEEPEST,
    Part,
    Read,
    check_placed,
    look_of,
    merged,
    named,
    product,
)
from voxtool.memory import check_memory
from voxtool.mesh.mesh import check_promised

if TYPE_CHECKING:
    from voxtool.files.meshes.companions import Companions

UNITS = "m"  # of every glTF
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of primitives; the others are points and lines
PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
VALUE_BYTES = 100  # bytes of memory for each value of JSON
HEAD = 12  # bytes of a GLB before its chunks


def parse(
    name: str,
    kind: str,
    data: bytes,
    max_memory: int | None,
    keep: Sequence[str],
    companions: Companions,
) -> Read:
    """Return all meshes of a scene, placed by the transforms of the nodes.

    Other files are read only where appearance is kept, and nothing is moved.
    """
    try:
        look = "appearance" in keep
        tree = Tree(name, kind, data, companions, look, max_memory)
        _check_scene(name, tree.json, len(data), max_memory, look)
        return _scene(tree, keep, max_memory)
    except VoxtoolError:
        raise
    except (Exception, SystemExit) as error:
        reason = one_line(error) or type(error).__name__
        raise MeshError(
            f"{name}: not readable as {kind.upper()}: {reason}: it may be truncated or damaged, "
            "export it again"
        ) from None


class Tree:
    """The JSON of a glTF, and the arrays that it describes."""

    def __init__(
        self,
        name: str,
        kind: str,
        data: bytes,
        companions: Companions,
        other_files: bool,
        max_memory: int | None,
    ) -> None:
        self.name, self.companions, self.other_files = name, companions, other_files
        self.binary: bytes | None = None
        if kind == "glb":
            data, self.binary = _chunks(data)
        values = sum(map(data.count, (b",", b"[", b"{")))
        size = len(data) + VALUE_BYTES * values
        check_memory(size, f"{name}: the values of its JSON", "split the scene", max_memory)
        self.json: dict[str, Any] = json.loads(data)
        for extension in self.json.get("extensionsRequired", []):
            if extension in PACKED:
                raise MeshError(f"{name}: its meshes are packed by {extension}: export it without")

    @cached_property
    def buffers(self) -> list[bytes]:
        found = []
        for i, buffer in enumerate(self.json.get("buffers", [])):
            uri = buffer.get("uri")
            if uri is None:
                if i or self.binary is None:
                    raise ValueError(f"buffer {i} is missing")
                found.append(self.binary)
            elif self.other_files or uri.startswith("data:"):
                found.append(self.companions.read(uri, f"buffer {i}", quoted=True))
            else:
                raise ValueError(
                    f"buffer {i} is another file, {printable(uri)[:40]!r}: save it as .glb"
                )
        return found

    def view(self, index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.json["bufferViews"][index]
        return self.part(view["buffer"], view.get("byteOffset", 0), view["byteLength"])

    def part(self, buffer: int, start: int, size: int) -> bytes:
        """Return `size` bytes of a buffer from `start` on; ValueError if it ends before."""
        data = self.buffers[buffer]
        if not 0 <= start <= start + size <= len(data):
            raise ValueError(f"buffer {buffer} ends before what it should hold")
        return data[start : start + size]

    def array(self, index: int) -> np.ndarray:
        """Return an accessor's array, (count, columns), of its own type."""
        accessor = self.json["accessors"][index]
        dtype, columns = np.dtype(TYPES[accessor["componentType"]]), COLUMNS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            found = self._rows(accessor["bufferView"], accessor, dtype, columns, count)
        else:
            found = np.zeros((count, columns), dtype)
        if sparse := accessor.get("sparse"):
            where, what, n = sparse["indices"], sparse["values"], sparse["count"]
            whole = np.dtype(TYPES[where["componentType"]])
            places = self._rows(where["bufferView"], where, whole, 1, n)[:, 0]
            found = found.copy()
            found[places] = self._rows(what["bufferView"], what, dtype, columns, n)
        return found

    def _rows(
        self, index: int, where: dict[str, Any], dtype: np.dtype, columns: int, count: int
    ) -> np.ndarray:
        """Return (count, columns) numbers of a buffer view, from `byteOffset` of `where` on."""
        view = self.json["bufferViews"][index]
        row = dtype.itemsize * columns
        stride = view.get("byteStride", row)
        start = where.get("byteOffset", 0)
        if not (count >= 0 <= start and stride >= row):
            raise ValueError(f"buffer view {index} has a size below 0")
        data = self.view(index)
        if count and start + (count - 1) * stride + row > len(data):
            raise ValueError(f"buffer view {index} ends before what it should hold")
        if not count:
            return np.empty((0, columns), dtype)
        shape, strides = (count, columns), (stride, dtype.itemsize)
        return np.ndarray(shape, dtype, data, start, strides)

    def numbers(self, index: int) -> np.ndarray:
        """Return an accessor's array as float64; whole numbers that are normalized, from 0 to 1 or
        from -1 to 1."""
        found = self.array(index)
        with np.errstate(invalid="ignore"):  # of signalling NaN
            result = found.astype(np.float64)
        if self.json["accessors"][index].get("normalized") and found.dtype.kind in "iu":
            result = np.maximum(result / np.iinfo(found.dtype).max, -1.0)
        return result


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON of a GLB, and its binary chunk."""
    if data[:4] != b"glTF" or int.from_bytes(data[4:8], "little") != 2:
        raise ValueError("it is no GLB of version 2")
    found: dict[bytes, bytes] = {}
    at = HEAD
    while at + 8 <= len(data):
        size, what = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        if at + 8 + size > len(data):
            raise ValueError("a chunk ends beyond the file")
        found.setdefault(what, data[at + 8 : at + 8 + size])
        at += 8 + size
    if b"JSON" not in found:
        raise ValueError("it has no JSON")
    return found[b"JSON"], found.get(b"BIN\0")


# ---- the scene


def _scene(tree: Tree, keep: Sequence[str], max_memory: int | None) -> Read:
    from voxtool.files.meshes.gltf_materials import Looks

    looks = Looks(tree, max_memory) if "appearance" in keep else None
    names: dict[str, list[str]] = {"part": [], "object": [], "material": []}
    placed = merged(tree.name, _parts(tree, names, looks))
    parts = {}
    if "parts" in keep and len(placed.faces):
        parts = {what: named(placed.labels[what], names[what]) for what in names}
    look = look_of(placed, looks.materials) if looks else None
    return Read(placed.vertices, placed.faces, UNITS, parts, look)


def _parts(tree: Tree, names: dict[str, list[str]], looks: Any) -> Iterator[Part]:
    """Yield the triangles of each node, placed, and gather the names of their labels."""
    materials = [str(one.get("name", f"material {i}")) for i, one in
                 enumerate(tree.json.get("materials", []))]  # fmt: skip
    names["material"] += [*materials, "default"]
    for index, matrix in _placements(tree):
        node = tree.json["nodes"][index]
        mesh = tree.json["meshes"][node["mesh"]]
        own = str(node.get("name") or mesh.get("name") or f"node {index}")
        several = len(mesh["primitives"]) > 1
        names["object"].append(own)
        for i, primitive in enumerate(mesh["primitives"]):
            corners = _corners(tree, primitive)
            if corners is None:
                continue
            names["part"].append(f"{own}/{i}" if several else own)
            labels = {
                "part": len(names["part"]) - 1,
                "object": len(names["object"]) - 1,
                "material": primitive.get("material", len(materials)),
            }
            if not 0 <= labels["material"] <= len(materials):
                raise ValueError(f"there is no material {labels['material']}")
            points = tree.numbers(primitive["attributes"]["POSITION"])
            if not looks:
                yield Part(points, corners, matrix, labels)
                continue
            labels["look"], uv, colours = looks.of(primitive, corners, len(points))
            yield Part(points, corners, matrix, labels, uv, colours)


def _corners(tree: Tree, primitive: dict[str, Any]) -> np.ndarray | None:
    """Return the (F, 3) int64 triangles of a primitive; None if it has points or lines."""
    mode = primitive.get("mode", TRIANGLES)
    if mode not in (TRIANGLES, STRIP, FAN) or "POSITION" not in primitive["attributes"]:
        return None
    for extension in PACKED:
        if extension in primitive.get("extensions", {}):
            raise MeshError(f"{tree.name}: its meshes are packed by {extension}: export it without")
    if "indices" in primitive:
        row = tree.array(primitive["indices"]).ravel().astype(np.int64)
    else:
        count = tree.json["accessors"][primitive["attributes"]["POSITION"]]["count"]
        row = np.arange(count, dtype=np.int64)
    if mode == TRIANGLES:
        return row.reshape(-1, 3)
    nth = np.arange(max(len(row) - 2, 0))
    if mode == FAN:
        return row[np.stack([0 * nth, nth + 1, nth + 2], axis=1)]
    odd = nth % 2  # every other triangle of a strip is turned
    return row[np.stack([nth, nth + 1 + odd, nth + 2 - odd], axis=1)]


def _placements(tree: Tree) -> Iterator[tuple[int, np.ndarray]]:
    """Yield each node of the scene that has a mesh, and its transform, (4, 4)."""
    nodes = tree.json.get("nodes", [])
    if scenes := tree.json.get("scenes"):
        roots = scenes[tree.json.get("scene", 0)].get("nodes", [])
    else:
        inside = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in inside]
    seen: set[int] = set()
    waiting = [(root, np.eye(4), 1) for root in reversed(roots)]
    while waiting:
        index, matrix, depth = waiting.pop()
        if depth > DEEPEST:
            raise MeshError(
                f"{tree.name}: a scene of nodes inside more than {DEEPEST} others: flatten it"
            )
        if index in seen:
            raise ValueError(f"node {index} is in the scene twice")
        seen.add(index)
        node = nodes[index]
        matrix = product(matrix, _transform(node))
        if "mesh" in node:
            yield index, matrix
        waiting += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]


def _transform(node: dict[str, Any]) -> np.ndarray:
    """Return a node's own transform: its matrix, or scale, then rotation, then translation."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = map(float, node["rotation"])
        s = 2 / (x * x + y * y + z * z + w * w)
        matrix[:3, :3] = [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _check_scene(
    name: str, tree: dict[str, Any], size: int, max_memory: int | None, look: bool
) -> None:
    """Refuse a glTF scene with counts that its bytes cannot hold, or whose meshes do not fit in
    memory: many may share the same bytes."""
    counts = [int(accessor["count"]) for accessor in tree.get("accessors", [])]
    check_promised(name, max(counts, default=0), 0, size)

    def items(primitive: dict[str, Any]) -> int:
        used = primitive["attributes"].get("POSITION"), primitive.get("indices")
        return sum(counts[accessor] for accessor in used if accessor is not None)

    meshes = [sum(map(items, mesh["primitives"])) for mesh in tree.get("meshes", [])]
    placed = sum(meshes[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node)
    check_placed(name, sum(counts) + sum(meshes) + placed, size, max_memory, look)
