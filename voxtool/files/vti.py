"""VTK ImageData (.vti), which ParaView opens: UInt8 cell data `occupancy`, 1 where set.

XML with the array appended as raw bytes, x fastest; header_type UInt64, little-endian.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.svo.layers import layers

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree

DOCUMENT = """<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{pitch}">
    <Piece Extent="{extent}">
      <CellData Scalars="occupancy">
        <DataArray type="UInt8" Name="occupancy" format="appended" offset="0"/>
      </CellData>
    </Piece>
  </ImageData>
  <AppendedData encoding="raw">
   _"""
ENDING = b"\n  </AppendedData>\n</VTKFile>\n"


def size(octree: Octree) -> int:
    """Bytes that the file takes, the header aside."""
    nx, ny, nz = octree.grid.shape
    return nx * ny * nz


def write(octree: Octree, file: BinaryIO) -> None:
    """Write the occupancy as cell data, in layers.

    Raises
    ------
    OSError : the file cannot be written.
    """
    grid = octree.grid
    head = DOCUMENT.format(
        extent=" ".join(f"0 {n}" for n in grid.shape),
        origin=" ".join(map(repr, grid.origin)),
        pitch=" ".join(map(repr, grid.pitch)),
    )
    file.write(head.encode() + struct.pack("<Q", size(octree)))
    for slab in layers(octree, (2, 1, 0)):
        file.write(np.ascontiguousarray(slab).view(np.uint8).data)
    file.write(ENDING)
