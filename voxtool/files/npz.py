"""The coordinates of the set voxels as .npz: sparse, so it suits every grid.

voxels (N, 3) int32 in lexicographic order; shape (3,) int64; origin and pitch (3,) float64.
"""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.svo.layers import coordinates

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree


def size(octree: Octree) -> int:
    """Bytes that the file takes, the headers aside."""
    return 12 * octree.count


def write(octree: Octree, file: BinaryIO) -> None:
    """Write the coordinates, in pieces.

    Raises
    ------
    OSError : the file cannot be written.
    """
    header = {"descr": "<i4", "fortran_order": False, "shape": (octree.count, 3)}
    with zipfile.ZipFile(file, "w") as packed:
        with packed.open(_entry("voxels"), "w", force_zip64=True) as entry:
            np.lib.format.write_array_header_1_0(entry, header)
            for voxels in coordinates(octree):
                entry.write(voxels.data)
        for name, values in (
            ("shape", np.array(octree.grid.shape, "<i8")),
            ("origin", np.array(octree.grid.origin, "<f8")),
            ("pitch", np.array(octree.grid.pitch, "<f8")),
        ):
            with packed.open(_entry(name), "w") as entry:
                np.lib.format.write_array(entry, values)


def _entry(name: str) -> zipfile.ZipInfo:
    """An entry of a fixed date and system: the bytes depend on the content alone."""
    entry = zipfile.ZipInfo(f"{name}.npy")
    entry.create_system = 3
    entry.external_attr = 0o644 << 16
    return entry
