"""Hexahedra as a mesh of Gmsh, .msh, version 4.1, binary.

A material is a physical group of a volume, and a surface one of an entity; `boundary` is one of the
six entities of the boundary. The numbers of groups are those of their entities. A section
HangingNodes, which other programs pass over, has a line of text for each node that hangs: its
number, then four numbers of masters and their weights, 0 and 0.0 where there is none.
https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.files.storage.sections import Part, begin, size_of
from voxtool.svo.solvers.hexahedra import BOUNDARY, SIDES, Hexahedra, Key, Numbering
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra

HEAD = b"$MeshFormat\n4.1 1 8\n" + struct.pack("<i", 1) + b"\n$EndMeshFormat\n"
HEXAHEDRON, QUAD = 5, 3  # Gmsh's types


def size(mesh: Hexahedra) -> int:
    """Return the bytes of the file."""
    return size_of(_parts(mesh))


def _counts(mesh: Hexahedra) -> list[int]:
    """Return the number of faces of each surface."""
    return [sum(mesh.sizes.faces.get(key, 0) for key in own.parts) for own in mesh.surfaces]


def _parts(mesh: Hexahedra) -> list[Part]:
    nodes, cells, counts = mesh.sizes.nodes, mesh.sizes.cells, _counts(mesh)
    elements = cells + sum(counts)
    groups = [(3, number, name) for number, name in mesh.materials.items()]
    groups += [(2, number, own.name) for number, own in enumerate(mesh.surfaces, 1)]
    groups.append((2, len(counts) + 1, BOUNDARY))
    names = "".join(f'{d} {n} "{name}"\n' for d, n, name in groups)
    parts: list[Part] = [
        HEAD,
        f"$PhysicalNames\n{len(groups)}\n{names}$EndPhysicalNames\n$Entities\n".encode(),
        _entities(mesh),
        b"\n$EndEntities\n$Nodes\n",
        struct.pack("<4Q3iQ", 1, nodes, 1, nodes, 3, next(iter(mesh.materials)), 0, nodes),
        ("tags", 8 * nodes),
        ("points", 24 * nodes),
        b"\n$EndNodes\n$Elements\n",
        struct.pack("<4Q", len(mesh.materials) + len(counts), elements, 1, elements),
    ]
    for number, count in mesh.sizes.materials.items():
        parts += [struct.pack("<3iQ", 3, number, HEXAHEDRON, count), (number, 72 * count)]
    for number, (own, count) in enumerate(zip(mesh.surfaces, counts, strict=True), 1):
        parts.append(struct.pack("<3iQ", 2, number, QUAD, count))
        parts += [(key, 40 * mesh.sizes.faces.get(key, 0)) for key in own.parts]
    parts.append(b"\n$EndElements\n")
    if isinstance(mesh, LeafHexahedra):
        nodes, masters, weights = (each.tolist() for each in mesh.hanging)
        parts.append(f"$HangingNodes\n{len(nodes)}\n".encode())
        lines = (
            f"{node + 1} {' '.join(f'{n + 1} {w!r}' for n, w in zip(own, shares, strict=True))}\n"
            for node, own, shares in zip(nodes, masters, weights, strict=True)
        )
        parts.append(f"{''.join(lines)}$EndHangingNodes\n".encode())
    return parts


def _entities(mesh: Hexahedra) -> bytes:
    """Return the entities, surfaces and volumes, each with the box of the image."""
    low, high = ([axis[end] for axis in mesh.coordinates()] for end in (0, -1))
    box, count = struct.pack("<6d", *low, *high), len(mesh.surfaces)
    found = struct.pack("<4Q", 0, 0, count, len(mesh.materials))
    for number in range(1, count + 1):
        groups = [number, count + 1] if number <= len(SIDES) else [number]
        found += struct.pack("<i", number) + box + struct.pack("<Q", len(groups))
        found += struct.pack(f"<{len(groups)}iQ", *groups, 0)
    for number in mesh.materials:
        around = [
            n
            for n, own in enumerate(mesh.surfaces, 1)
            if n <= len(SIDES) or number in own.parts[0][:2]
        ]
        found += struct.pack("<i", number) + box + struct.pack("<Qi", 1, number)
        found += struct.pack(f"<Q{len(around)}i", len(around), *around)
    return found


def write(mesh: Hexahedra, file: BinaryIO) -> None:
    """Write the mesh."""
    sections, cells = begin(file, _parts(mesh)), Numbering(mesh.sizes, 1)
    xs, ys, zs = mesh.coordinates()
    faces, number = dict[Key, int](), mesh.sizes.cells + 1  # of the next face
    for key in (key for own in mesh.surfaces for key in own.parts):
        faces[key] = number
        number += mesh.sizes.faces.get(key, 0)
    for layer in mesh.layers():
        for x, first, y, z in layer.nodes():
            points = np.empty((len(y), 3), "<f8")
            points[:, 0], points[:, 1], points[:, 2] = xs[x], ys[y], zs[z]
            sections["tags"].write(np.arange(first + 1, first + 1 + len(y), dtype="<u8"))
            sections["points"].write(points)
        corners, numbers = layer.corners("<u8"), cells.of(layer)
        corners += np.uint64(1)
        for material, own in layer.materials():
            sections[material].write(_elements(numbers[own], corners[own]))
        for key, own in layer.faces:
            at = np.arange(faces[key], faces[key] + len(own))
            sections[key].write(_elements(at, corners[own][:, SIDES[key.side].corners]))
            faces[key] += len(own)


def _elements(numbers: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return elements as the file has them: each has its number and its nodes."""
    found = np.empty((len(nodes), 1 + nodes.shape[1]), "<u8")
    found[:, 0] = numbers
    found[:, 1:] = nodes
    return found
