"""Hexahedra as an UnstructuredGrid of VTK, .vtu, which ParaView opens; XML with appended raw bytes.

The cells are the hexahedra, then the faces of surfaces as quadrilaterals. The cell array `label` is
the number of a hexahedron's material, from 1, and 0 at faces; `surface` is the number of a face's
surface, from 1, and 0 at hexahedra. The field data name them: each name has its number and the
dimension of what it names, 3 or 2. For cubes of several sizes, the point array `hanging` is the
number of masters of a node that hangs, and 0 at others; `masters` and `weights` are these, -1 and 0
where there is none.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.files.storage.sections import Part, begin, size_of
from voxtool.svo.solvers.hexahedra import SIDES, Hexahedra
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra

HEAD = """<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <UnstructuredGrid>
    <FieldData>
{names}
    </FieldData>
    <Piece NumberOfPoints="{points}" NumberOfCells="{cells}">
      <Points>
{Points}
      </Points>
{hanging}      <Cells>
{connectivity}
{offsets}
{types}
      </Cells>
      <CellData Scalars="label">
{label}
{surface}
      </CellData>
    </Piece>
  </UnstructuredGrid>
  <AppendedData encoding="raw">
   _"""
END = b"\n  </AppendedData>\n</VTKFile>\n"
ARRAY = '        <DataArray type="{type}" Name="{name}"{more} format="appended" offset="{offset}"/>'
NAME = (
    '      <DataArray type="Int32" Name="{name}" NumberOfTuples="1" NumberOfComponents="2" '
    'format="ascii">{number} {dimension}</DataArray>'
)
HEXAHEDRON, QUAD = 12, 9  # VTK's types
KINDS = {"f": "Float", "i": "Int", "u": "UInt"}  # of numbers, by numpy's
COMPONENTS = {"Points": 3, "masters": 4, "weights": 4}
HANGING = ("hanging", "masters", "weights")
PIECE = 1 << 20  # cells at once of arrays that need no layers


def size(mesh: Hexahedra) -> int:
    """Return the bytes of the file."""
    return size_of(_parts(mesh))


def _index(mesh: Hexahedra) -> np.dtype:
    """Return the type of numbers of nodes and of offsets."""
    most = 8 * mesh.sizes.cells + 4 * mesh.sizes.quads
    return np.dtype("<i4") if max(most, mesh.sizes.nodes) < 1 << 31 else np.dtype("<i8")


def _small(most: int) -> np.dtype:
    """Return the type of numbers up to `most`."""
    return np.min_scalar_type(most).newbyteorder("<")


def _parts(mesh: Hexahedra) -> list[Part]:
    nodes, cells, index = mesh.sizes.nodes, mesh.sizes.cells, _index(mesh)
    every = cells + mesh.sizes.quads
    label, surface = _small(max(mesh.materials)), _small(len(mesh.surfaces))
    hanging = {
        "hanging": (nodes, np.dtype(np.uint8)),
        "masters": (4 * nodes, index),
        "weights": (4 * nodes, np.dtype("<f8")),
    }
    kinds = {
        "Points": (3 * nodes, np.dtype("<f8")),
        "connectivity": (8 * cells + 4 * mesh.sizes.quads, index),
        **(hanging if isinstance(mesh, LeafHexahedra) else {}),
        "offsets": (every, index),
        "types": (every, np.dtype(np.uint8)),
        "label": (every, label),
        "surface": (every, surface),
    }
    faces = [(key, mesh.sizes.faces.get(key, 0)) for own in mesh.surfaces for key in own.parts]
    lines, appended, at = {}, list[Part](), 0
    for name, (count, dtype) in kinds.items():
        more = f' NumberOfComponents="{COMPONENTS[name]}"' if name in COMPONENTS else ""
        kind = f"{KINDS[dtype.kind]}{8 * dtype.itemsize}"
        lines[name] = ARRAY.format(type=kind, name=name, more=more, offset=at)
        size = count * dtype.itemsize
        own: list[Part] = [(name, size)]
        if name == "connectivity":
            width = dtype.itemsize
            own = [(name, 8 * cells * width), *((key, 4 * n * width) for key, n in faces)]
        appended += [struct.pack("<Q", size), *own]
        at += 8 + size
    named = [(name, number, 3) for number, name in mesh.materials.items()]
    named += [(own.name, number, 2) for number, own in enumerate(mesh.surfaces, 1)]
    names = [NAME.format(name=name, number=n, dimension=d) for name, n, d in named]
    more = "".join(f"{lines.pop(name)}\n" for name in HANGING if name in lines)
    if more:
        more = f"      <PointData>\n{more}      </PointData>\n"
    names = "\n".join(names)
    head = HEAD.format(points=nodes, cells=every, names=names, hanging=more, **lines)
    return [head.encode(), *appended, END]


def write(mesh: Hexahedra, file: BinaryIO) -> None:
    """Write the mesh."""
    sections, index = begin(file, _parts(mesh)), _index(mesh)
    label, surface = _small(max(mesh.materials)), _small(len(mesh.surfaces))
    xs, ys, zs = mesh.coordinates()
    for layer in mesh.layers():
        for x, _, y, z in layer.nodes():
            points = np.empty((len(y), 3), "<f8")
            points[:, 0], points[:, 1], points[:, 2] = xs[x], ys[y], zs[z]
            sections["Points"].write(points)
        corners = layer.corners(index)
        sections["connectivity"].write(corners)
        for key, cells in layer.faces:
            sections[key].write(corners[cells][:, SIDES[key.side].corners])
        labels = layer.values
        if labels is None:
            labels = np.broadcast_to(np.uint8(1), len(corners))
        sections["label"].write(labels.astype(label))
    if isinstance(mesh, LeafHexahedra):
        for start in range(0, mesh.sizes.nodes, PIECE):
            n = min(PIECE, mesh.sizes.nodes - start)
            for name, array in zip(HANGING, _hanging(mesh, start, n, index), strict=True):
                sections[name].write(array)
    counts = [sum(mesh.sizes.faces.get(key, 0) for key in own.parts) for own in mesh.surfaces]
    at = 0
    for number, count in enumerate((mesh.sizes.cells, *counts)):
        width = 4 if number else 8
        for start in range(0, count, PIECE):
            n = min(PIECE, count - start)
            ends = np.arange(1, n + 1, dtype=index)
            ends *= width
            ends += at
            at += n * width
            sections["offsets"].write(ends)
            sections["types"].write(np.full(n, QUAD if number else HEXAHEDRON, np.uint8))
            sections["surface"].write(np.full(n, number, surface))
            if number:
                sections["label"].write(np.zeros(n, label))


def _hanging(mesh: LeafHexahedra, start: int, n: int, index: np.dtype) -> tuple[np.ndarray, ...]:
    """Return the arrays HANGING of n nodes."""
    nodes, masters, weights = mesh.hanging
    chosen = slice(*np.searchsorted(nodes, [start, start + n]).tolist())
    at = nodes[chosen] - start
    found = (np.zeros(n, np.uint8), np.full((n, 4), -1, index), np.zeros((n, 4), "<f8"))
    found[0][at] = np.count_nonzero(masters[chosen] >= 0, axis=1)
    found[1][at], found[2][at] = masters[chosen], weights[chosen]
    return found
