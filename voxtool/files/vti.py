"""VTK ImageData, .vti, which ParaView opens: the cells as cell data, XML with appended raw bytes.

The array `occupancy` of an image of bool is UInt8, 1 where set; `count` and `coverage` are those of
the other types. x runs fastest; header_type UInt64, little-endian.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from voxtool.svo.image import VoxelImage

VTI = """<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{pitch}">
    <Piece Extent="{extent}">
      <CellData Scalars="{name}">
        <DataArray type="{type}" Name="{name}" format="appended" offset="0"/>
      </CellData>
    </Piece>
  </ImageData>
  <AppendedData encoding="raw">
   _"""
VTI_END = b"\n  </AppendedData>\n</VTKFile>\n"
EXTRA = 1024  # bytes of the XML
TYPES = {
    "bool": "UInt8",
    "uint8": "UInt8",
    "uint16": "UInt16",
    "uint32": "UInt32",
    "float32": "Float32",
    "float64": "Float64",
}
NAMES = {"b": "occupancy", "u": "count", "f": "coverage"}


def size(image: VoxelImage) -> int:
    """Bytes of the file."""
    return EXTRA + image.nbytes


def write(image: VoxelImage, file: BinaryIO) -> None:
    """Write the values as cell data."""
    head = VTI.format(
        extent=" ".join(f"0 {n}" for n in image.shape),
        origin=" ".join(map(repr, image.origin)),
        pitch=" ".join(map(repr, image.pitch)),
        name=NAMES[image.dtype.kind],
        type=TYPES[image.dtype.name],
    )
    file.write(head.encode() + struct.pack("<Q", image.nbytes))
    for slab in image.slabs((2, 1, 0)):
        file.write(np.ascontiguousarray(slab).view(np.uint8).data)
    file.write(VTI_END)
