"""Dense arrays of voxels as .npy, indexed [x, y, z], in C order; without their place in the world.

https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from voxtool.errors import FileError
from voxtool.files.grids.voxels import (
    Dense,
    Frame,
    Stored,
    check_length,
    check_values,
    dense_pieces,
)
from voxtool.files.storage.streams import PathLike, open_output
from voxtool.files.storage.unpacked import Unpacked
from voxtool.grid import Grid

HEADER = 128  # bytes of a usual header


def size(image: Dense) -> int:
    """Return the bytes of the file."""
    return HEADER + image.nbytes


def write(image: Dense, file: BinaryIO) -> None:
    """Write the dense array."""
    descr = np.lib.format.dtype_to_descr(image.dtype)
    shape = (*image.shape, *getattr(image, "row", ()))  # channels come last
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    for slab in image.slabs():
        file.write(np.ascontiguousarray(slab).data)


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of an array; its low corner is the origin, and a voxel has side 1."""
    shape, fortran, dtype = read_header(file)
    check_values(dtype, shape)
    a, b, c = shape
    check_length(a * b * c * dtype.itemsize, size - file.tell())
    frame = Frame(Grid((a, b, c), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    return Stored(frame, dense_pieces(file, dtype, (a, b, c), fortran=fortran))


def read_header(file: BinaryIO | Unpacked) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return the shape of an array, whether it is in Fortran order, and its dtype."""
    try:
        version = np.lib.format.read_magic(file)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        return read(file)
    except Exception:  # damage shows in any of numpy's errors
        raise FileError(
            "is no .npy array, or its header is damaged: write it with numpy.save"
        ) from None


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
