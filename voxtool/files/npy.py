"""The dense array as .npy: bool [x, y, z] of the grid's shape, C order, written in layers."""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.files.atomic import atomic_path
from voxtool.files.streams import STREAM, PathLike, standard_output
from voxtool.svo.layers import layers

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree


def size(octree: Octree) -> int:
    """Bytes that the file takes, the header aside."""
    nx, ny, nz = octree.grid.shape
    return nx * ny * nz


def write(octree: Octree, file: BinaryIO) -> None:
    """Write the set voxels as a bool array.

    Raises
    ------
    OSError : the file cannot be written.
    """
    header = {"descr": "|b1", "fortran_order": False, "shape": octree.grid.shape}
    np.lib.format.write_array_header_1_0(file, header)
    for slab in layers(octree):
        file.write(np.ascontiguousarray(slab).data)


def write_array(
    values: np.ndarray, path: PathLike, clobber: bool = True, format: str | None = None
) -> None:
    """Write an array as .npy; `-` writes stdout.

    Raises
    ------
    FileError : the file cannot be written, or exists and clobber is False.
    """
    if path == STREAM:
        with standard_output(False) as file:
            np.save(file, values)
        return
    with atomic_path(path, clobber) as temporary, open(temporary, "wb") as file:
        np.save(file, values)
