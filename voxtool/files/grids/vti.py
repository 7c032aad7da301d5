"""VTK ImageData, .vti, which ParaView opens: the cells as cell data, XML with appended raw bytes.

The array `occupancy` of an image of bool is UInt8, 1 where set; `count` and `coverage` are those of
the other types, and `distance` of a field. Attributes of voxels have arrays of their own, and the
names of labels are the field data `label_names`. x runs fastest; header_type UInt64, little-endian.
Files of other programs may have their arrays inline or appended, raw, as base64 or as text,
compressed by zlib, LZ4, LZMA or not.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.files.grids import vtk_xml
from voxtool.files.grids.voxels import (
    Dense,
    Frame,
    Stored,
    check_length,
    check_values,
    dense_pieces,
    frame_of,
)
from voxtool.files.storage.unpacked import check_unpacked
from voxtool.grid import Grid
from voxtool.svo.images.attribute_image import attributes_of

VTI = """<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{pitch}">{names}
    <Piece Extent="{extent}">
      <CellData Scalars="{name}">
        {arrays}
      </CellData>
    </Piece>
  </ImageData>
  <AppendedData encoding="raw">
   _"""
ARRAY = '<DataArray type="{type}" Name="{name}"{components} format="appended" offset="{offset}"/>'
NAMES = """
    <FieldData>
      <DataArray type="String" Name="label_names" NumberOfTuples="{count}" format="ascii">
        {text}
      </DataArray>
    </FieldData>"""
VTI_END = b"\n  </AppendedData>\n</VTKFile>\n"
EXTRA = 1024  # bytes of the XML
LENGTH = struct.Struct("<Q")  # before each array
TYPES = {
    "bool": "UInt8",
    "uint8": "UInt8",
    "uint16": "UInt16",
    "uint32": "UInt32",
    "float32": "Float32",
    "float64": "Float64",
}


def size(image: Dense) -> int:
    """Return the bytes of the file."""
    found = EXTRA + image.nbytes
    for attribute in attributes_of(image):
        found += attribute.nbytes + EXTRA + len(_names(attribute.names))
    return found


def write(image: Dense, file: BinaryIO) -> None:
    """Write the values as cell data."""
    images: list[Dense] = [image, *attributes_of(image)]
    arrays, offset = [], 0
    for each in images:
        numbers = getattr(each, "channels", 1)
        components = f' NumberOfComponents="{numbers}"' if numbers > 1 else ""
        kind = TYPES[each.dtype.name]
        arrays.append(
            ARRAY.format(type=kind, name=each.quantity, components=components, offset=offset)
        )
        offset += LENGTH.size + each.nbytes
    head = VTI.format(
        extent=" ".join(f"0 {n}" for n in image.shape),
        origin=" ".join(map(repr, image.origin)),
        pitch=" ".join(map(repr, image.pitch)),
        name=image.quantity,
        arrays="\n        ".join(arrays),
        names="".join(_names(getattr(each, "names", ())) for each in images),
    )
    file.write(head.encode())
    for each in images:
        file.write(LENGTH.pack(each.nbytes))
        for slab in each.slabs((2, 1, 0)):
            file.write(np.ascontiguousarray(slab).view(np.uint8).data)
    file.write(VTI_END)


def _names(names: tuple[str, ...]) -> str:
    """Return the element of names of labels: bytes of UTF-8 as numbers, each name ended by 0."""
    if not names:
        return ""
    text = "".join(f"{name}\0" for name in names).encode()
    return NAMES.format(count=len(names), text=" ".join(map(str, text)))


def read(file: BinaryIO, size: int) -> Stored:
    """Return the active scalars of an image, or its first array of one number a cell or point.

    Values at cells are voxels; a value at a point is that of a voxel around it.
    """
    image = vtk_xml.read_image(file, size)
    low, high = image.extent[::2], image.extent[1::2]
    at_cells = image.place == "CellData"
    a, b, c = (h - n + (not at_cells) for n, h in zip(low, high, strict=True))
    check_values(image.dtype, (a, b, c))
    needed = a * b * c * image.dtype.itemsize
    text = image.dtype.itemsize if image.format == "ascii" else 1  # of a digit
    if image.compressor:
        check_unpacked(needed, size)
    else:
        check_length(needed, size * text)
    pieces = dense_pieces(image.stream(needed), image.dtype, (a, b, c), fortran=True)
    return Stored(_frame(image, (a, b, c), 0.0 if at_cells else -0.5), pieces)


def _frame(image: vtk_xml.Image, shape: tuple[int, int, int], shift: float) -> Frame:
    """Return the place of the voxels; the first one begins `shift` voxels after the first point."""
    direction = np.array(image.direction).reshape(3, 3)
    first = np.array(image.extent[::2]) + shift
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        if (direction == np.eye(3)).all():
            origin = np.array(image.origin) + np.array(image.spacing) * first
            return Frame(Grid(shape, tuple(origin.tolist()), image.spacing))  # pyright: ignore
        matrix = direction * image.spacing
        return frame_of(shape, matrix, image.origin + (matrix * (first + 0.5)).sum(axis=1))
