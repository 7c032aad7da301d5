"""Volumes as an UnstructuredGrid of VTKHDF, .vtkhdf, which ParaView opens; by h5py alone.

The cells are tetrahedra or hexahedra, in the order of the volume. The scalar is an array of the
points, or of the cells where each has one value; a / in its name becomes _.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/ (UnstructuredGrid)
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, BinaryIO, ClassVar

import numpy as np

from voxtool.tets.volume.volume import TetVolume

VERSION = (2, 0)
TYPES = {4: 10, 8: 12}  # VTK_TETRA and VTK_HEXAHEDRON, by the corners of a cell
EXTRA = 1 << 16  # bytes of the structure of the file


@dataclass(frozen=True, eq=False)
class VolumeCells:
    """The cells of a volume as an export holds them: points and scalars in world units."""

    smaller: ClassVar[str] = "a mesh of fewer cells"

    source: TetVolume

    @property
    def host_bytes(self) -> int:
        """The memory that the arrays of the file take."""
        cells, points = len(self.source.cells), len(self.source.vertices)
        return 32 * points + (8 * self.source.cells.shape[1] + 17) * cells

    @property
    def facts(self) -> dict[str, Any]:
        """The counts and the scalar of the export, in JSON types."""
        volume = self.source
        counts = {volume.noun: len(volume.cells), "points": len(volume.vertices)}
        return {**counts, "scalar": volume.scalar, "constant": volume.constant}

    @property
    def text(self) -> str:
        """The counts of the export in words."""
        volume = self.source
        return f"{len(volume.cells):,} {volume.noun}, {len(volume.vertices):,} points"


def size(image: VolumeCells) -> int:
    """Return a bound of the bytes of the file."""
    return EXTRA + image.host_bytes


def write(image: VolumeCells, file: BinaryIO) -> None:
    """Write the grid."""
    h5py: Any = import_module("h5py")  # its low-level modules have no types
    volume, cells = image.source, image.source.cells
    count, corners = cells.shape
    with h5py.File(file, "w", track_order=False) as h5:
        group = h5.create_group("VTKHDF")
        group.attrs.create("Version", VERSION, dtype="<i8")
        group.attrs.create("Type", np.bytes_("UnstructuredGrid"))
        data = group.create_group("CellData" if volume.constant else "PointData")
        name = volume.scalar.replace("/", "_").strip(".") or "scalar"
        arrays = {
            "NumberOfPoints": np.array([volume.vertex_count], "<i8"),
            "NumberOfCells": np.array([count], "<i8"),
            "NumberOfConnectivityIds": np.array([cells.size], "<i8"),
            "Points": volume.points().astype("<f8"),
            "Connectivity": cells.ravel().astype("<i8"),
            "Offsets": corners * np.arange(count + 1, dtype="<i8"),
            "Types": np.full(count, TYPES[corners], np.uint8),
            f"{data.name}/{name}": volume.scalars().astype("<f8"),
        }
        for key, array in arrays.items():
            group.create_dataset(key, data=array, track_times=False)
