"""Hexahedra as a mesh of Gmsh, .msh, version 4.1, binary.

A material is a physical group of a volume, the six surfaces are physical groups of one entity each,
and `boundary` is one of all six.
https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.files.sections import Part, begin, size_of
from voxtool.svo.hexahedra import BOUNDARY, MATERIAL, SIDES, Hexahedra

HEAD = b"$MeshFormat\n4.1 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n"
HEXAHEDRON, QUAD = 5, 3  # Gmsh's types
ALL = len(SIDES) + 1  # the physical group of the boundary


def size(mesh: Hexahedra) -> int:
    """Bytes of the file."""
    return size_of(_parts(mesh))


def _parts(mesh: Hexahedra) -> list[Part]:
    nodes, cells, faces, _ = mesh.sizes
    elements = cells + sum(faces)
    groups = [(3, 1, MATERIAL), *((2, n, side.name) for n, side in enumerate(SIDES, 1))]
    groups.append((2, ALL, BOUNDARY))
    names = "".join(f'{d} {n} "{name}"\n' for d, n, name in groups)
    parts: list[Part] = [
        HEAD,
        f"$PhysicalNames\n{len(groups)}\n{names}$EndPhysicalNames\n$Entities\n".encode(),
        _entities(mesh),
        b"\n$EndEntities\n$Nodes\n",
        struct.pack("<4Q3iQ", 1, nodes, 1, nodes, 3, 1, 0, nodes),
        ("tags", 8 * nodes),
        ("points", 24 * nodes),
        b"\n$EndNodes\n$Elements\n",
        struct.pack("<4Q", 1 + len(SIDES), elements, 1, elements),
        struct.pack("<3iQ", 3, 1, HEXAHEDRON, cells),
        (MATERIAL, 72 * cells),
    ]
    for number, (side, count) in enumerate(zip(SIDES, faces, strict=True), 1):
        parts += [struct.pack("<3iQ", 2, number, QUAD, count), (side.name, 40 * count)]
    return [*parts, b"\n$EndElements\n"]


def _entities(mesh: Hexahedra) -> bytes:
    """Return the entities: six surfaces and a volume, each with the box of the image."""
    low, high = ([axis[end] for axis in mesh.coordinates()] for end in (0, -1))
    box = struct.pack("<6d", *low, *high)
    surfaces = [
        struct.pack("<i", n) + box + struct.pack("<Q2iQ", 2, n, ALL, 0)
        for n in range(1, len(SIDES) + 1)
    ]
    bounds = struct.pack(f"<Q{len(SIDES)}i", len(SIDES), *range(1, len(SIDES) + 1))
    volume = struct.pack("<i", 1) + box + struct.pack("<Qi", 1, 1) + bounds
    return struct.pack("<4Q", 0, 0, len(SIDES), 1) + b"".join(surfaces) + volume


def write(mesh: Hexahedra, file: BinaryIO) -> None:
    """Write the mesh."""
    sections = begin(file, _parts(mesh))
    xs, ys, zs = mesh.coordinates()
    number = mesh.sizes.cells + 1  # of the first face of a surface; a hexahedron's is its place's
    numbers = {side.name: number + sum(mesh.sizes.faces[:n]) for n, side in enumerate(SIDES)}
    for layer in mesh.layers():
        for x, first, y, z in layer.nodes():
            points = np.empty((len(y), 3), "<f8")
            points[:, 0], points[:, 1], points[:, 2] = xs[x], ys[y], zs[z]
            sections["tags"].write(np.arange(first + 1, first + 1 + len(y), dtype="<u8"))
            sections["points"].write(points)
        corners = layer.corners("<u8")
        corners += np.uint64(1)
        sections[MATERIAL].write(_elements(layer.first + 1, corners))
        for side, cells in zip(SIDES, layer.faces, strict=True):
            quads = corners[cells][:, side.corners]
            sections[side.name].write(_elements(numbers[side.name], quads))
            numbers[side.name] += len(cells)


def _elements(first: int, nodes: np.ndarray) -> np.ndarray:
    """Return elements as the file has them: each has its number, from the first on, and its
    nodes."""
    found = np.empty((len(nodes), 1 + nodes.shape[1]), "<u8")
    found[:, 0] = np.arange(first, first + len(nodes), dtype=np.uint64)
    found[:, 1:] = nodes
    return found
