"""The set voxels of an octree as .npy, .npz, .vti and .png, written in layers.

.npy : the dense array, bool [x, y, z] of the grid's shape, in C order.
.npz : the coordinates, which suits every grid: voxels (N, 3) int32 in lexicographic order; shape
    (3,) int64; origin and pitch (3,) float64.
.vti : VTK ImageData, which ParaView opens: UInt8 cell data `occupancy`, 1 where set. XML with the
    array appended as raw bytes, x fastest; header_type UInt64, little-endian.
    https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html
.png : one slice, drawn by voxtool.plots.slices.
"""

from __future__ import annotations

import struct
import zipfile
from math import prod
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.files.streams import PathLike, open_output
from voxtool.svo.layers import coordinates, layers

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree

VTI = """<?xml version="1.0"?>
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
VTI_END = b"\n  </AppendedData>\n</VTKFile>\n"


def dense_size(octree: Octree) -> int:
    """Bytes of the dense array."""
    return prod(octree.grid.shape)


def sparse_size(octree: Octree) -> int:
    """Bytes of the coordinates."""
    return 12 * octree.count


def write_npy(octree: Octree, file: BinaryIO) -> None:
    """Write the dense array."""
    header = {"descr": "|b1", "fortran_order": False, "shape": octree.grid.shape}
    np.lib.format.write_array_header_1_0(file, header)
    for slab in layers(octree):
        file.write(np.ascontiguousarray(slab).data)


def write_npz(octree: Octree, file: BinaryIO) -> None:
    """Write the coordinates and the grid; the bytes depend on the content alone."""
    grid = octree.grid
    header = {"descr": "<i4", "fortran_order": False, "shape": (octree.count, 3)}
    with zipfile.ZipFile(file, "w") as packed:
        with packed.open(_entry("voxels"), "w", force_zip64=True) as entry:
            np.lib.format.write_array_header_1_0(entry, header)
            for voxels in coordinates(octree):
                entry.write(voxels.data)
        for name, values, dtype in (
            ("shape", grid.shape, "<i8"),
            ("origin", grid.origin, "<f8"),
            ("pitch", grid.pitch, "<f8"),
        ):
            with packed.open(_entry(name), "w") as entry:
                np.lib.format.write_array(entry, np.array(values, dtype))


def _entry(name: str) -> zipfile.ZipInfo:
    """An entry of a fixed date and system."""
    entry = zipfile.ZipInfo(f"{name}.npy")
    entry.create_system = 3
    entry.external_attr = 0o644 << 16
    return entry


def write_vti(octree: Octree, file: BinaryIO) -> None:
    """Write the occupancy as cell data."""
    grid = octree.grid
    head = VTI.format(
        extent=" ".join(f"0 {n}" for n in grid.shape),
        origin=" ".join(map(repr, grid.origin)),
        pitch=" ".join(map(repr, grid.pitch)),
    )
    file.write(head.encode() + struct.pack("<Q", dense_size(octree)))
    for slab in layers(octree, (2, 1, 0)):
        file.write(np.ascontiguousarray(slab).view(np.uint8).data)
    file.write(VTI_END)


def write_png(octree: Octree, file: BinaryIO, axis: str = "z", value: int | None = None) -> None:
    """Write the slice of voxels whose index along `axis` is `value` (default: the middle).

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    FileError : Pillow is missing.
    MemoryLimitError : the picture does not fit in memory.
    """
    from voxtool.files import picture
    from voxtool.plots.slices import draw_octree_slice, palette

    picture.check_writer(8)
    picture.write_png(draw_octree_slice(octree, axis, value), file, palette())


def write_array(
    values: np.ndarray, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write any array as .npy; `-` writes stdout. FileError if the file cannot be written."""
    with open_output(path, clobber=clobber) as file:
        save(file, values)


def save(file: BinaryIO, values: np.ndarray) -> None:
    """Write an array as .npy; errors have the system's reason, which those of numpy.save lack."""
    values = np.ascontiguousarray(values)
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
    file.write(values.data)
