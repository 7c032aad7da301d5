"""Hexahedra as an UnstructuredGrid of VTK, .vtu, which ParaView opens; XML with appended raw bytes.

The cells are the hexahedra, then the faces of the boundary as quadrilaterals. The cell array
`label` is the material of a hexahedron, from 1, and 0 at faces; `surface` is the number of a face's
surface, from 1, and 0 at hexahedra. The field data name them: each name has its number and the
dimension of what it names, 3 or 2.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.files.sections import Part, begin, size_of
from voxtool.svo.hexahedra import MATERIAL, SIDES, Hexahedra

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
      <Cells>
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
PIECE = 1 << 20  # cells at once of arrays that need no layers


def size(mesh: Hexahedra) -> int:
    """Bytes of the file."""
    return size_of(_parts(mesh))


def _index(mesh: Hexahedra) -> np.dtype:
    """Return the type of numbers of nodes and of offsets."""
    most = 8 * mesh.sizes.cells + 4 * sum(mesh.sizes.faces)
    return np.dtype("<i4") if max(most, mesh.sizes.nodes) < 1 << 31 else np.dtype("<i8")


def _parts(mesh: Hexahedra) -> list[Part]:
    nodes, cells, faces, _ = mesh.sizes
    quads, index = sum(faces), _index(mesh)
    kinds = {
        "Points": ("Float64", nodes, 24),
        "connectivity": (f"Int{8 * index.itemsize}", 8 * cells + 4 * quads, index.itemsize),
        "offsets": (f"Int{8 * index.itemsize}", cells + quads, index.itemsize),
        "types": ("UInt8", cells + quads, 1),
        "label": ("UInt8", cells + quads, 1),
        "surface": ("UInt8", cells + quads, 1),
    }
    lines, appended, at = {}, list[Part](), 0
    for name, (kind, count, width) in kinds.items():
        more = ' NumberOfComponents="3"' if name == "Points" else ""
        lines[name] = ARRAY.format(type=kind, name=name, more=more, offset=at)
        own: list[Part] = [(name, count * width)]
        if name == "connectivity":
            sides = zip(SIDES, faces, strict=True)
            own = [(name, 8 * cells * width), *((side.name, 4 * n * width) for side, n in sides)]
        appended += [struct.pack("<Q", count * width), *own]
        at += 8 + count * width
    named = [(MATERIAL, 1, 3), *((side.name, n, 2) for n, side in enumerate(SIDES, 1))]
    names = [NAME.format(name=name, number=n, dimension=d) for name, n, d in named]
    head = HEAD.format(names="\n".join(names), points=nodes, cells=cells + quads, **lines)
    return [head.encode(), *appended, END]


def write(mesh: Hexahedra, file: BinaryIO) -> None:
    """Write the mesh."""
    sections, index = begin(file, _parts(mesh)), _index(mesh)
    xs, ys, zs = mesh.coordinates()
    for layer in mesh.layers():
        for x, _, y, z in layer.nodes():
            points = np.empty((len(y), 3), "<f8")
            points[:, 0], points[:, 1], points[:, 2] = xs[x], ys[y], zs[z]
            sections["Points"].write(points)
        corners = layer.corners(index)
        sections["connectivity"].write(corners)
        for side, cells in zip(SIDES, layer.faces, strict=True):
            sections[side.name].write(corners[cells][:, side.corners])
    _, cells, faces, _ = mesh.sizes
    at = 0
    for number, count in enumerate((cells, *faces)):
        width = 4 if number else 8
        for start in range(0, count, PIECE):
            n = min(PIECE, count - start)
            ends = np.arange(1, n + 1, dtype=index)
            ends *= width
            ends += at
            at += n * width
            sections["offsets"].write(ends)
            sections["types"].write(np.full(n, QUAD if number else HEXAHEDRON, np.uint8))
            sections["label"].write(np.full(n, number == 0, np.uint8))
            sections["surface"].write(np.full(n, number, np.uint8))
