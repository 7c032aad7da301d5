"""The voxels that are set, or the samples of a field, as .npz with the grid.

voxels : (N, 3) int32, in lexicographic order; shape : (3,) int64; origin and pitch : (3,) float64.
values : (N,), where the image is not one of bool. transform : (4,) float64, scale and offset of a
normalized mesh. Attributes of the set cells: label : (N,), colour : (N, 4), normal : (N, 3),
fraction : (N,), faces : (N, 6), and label_names, the names by number. Voxel (i, j, k) has its low
corner at origin + pitch (i, j, k). The samples of a field are a dense array `distance` instead of
the list, labels an array `label`. From other programs an array of three axes is read, dense;
without a grid beside it, it has no place.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, printable
from voxtool.files.grids import npy
from voxtool.files.grids.voxels import (
    Boxes,
    Dense,
    Frame,
    Stored,
    check_length,
    check_values,
    dense_pieces,
)
from voxtool.files.storage.unpacked import check_unpacked, open_entry, open_zip
from voxtool.grid import Grid
from voxtool.svo.images.attribute_image import attributes_of
from voxtool.svo.images.image import VoxelImage

EXTRA = 2048  # bytes of headers and of the grid
ROWS = 1 << 20  # voxels that are read at once
GRID = {"shape": np.int64, "origin": np.float64, "pitch": np.float64}


def size(image: Dense) -> int:
    """Return the bytes of the file."""
    if not isinstance(image, VoxelImage):
        return EXTRA + image.nbytes
    attributes = attributes_of(image)
    each = 12 + (image.dtype != bool) * image.dtype.itemsize
    each += sum(attribute.cell_bytes for attribute in attributes)
    named = sum(_names(attribute.names).nbytes + EXTRA for attribute in attributes)
    return EXTRA + image.count * each + named


def write(image: Dense, file: BinaryIO) -> None:
    """Write the values and the grid; the bytes depend on the content alone."""
    with zipfile.ZipFile(file, "w") as packed:
        if not isinstance(image, VoxelImage):
            write_entry(packed, image.quantity, image.dtype, image.shape, image.slabs())
        else:
            write_entry(packed, "voxels", np.dtype("<i4"), (image.count, 3), image.coordinates())
        if isinstance(image, VoxelImage) and image.dtype != bool:
            values = (values for _, values in image.listed())
            write_entry(packed, "values", image.dtype, (image.count,), values)
        for attribute in attributes_of(image):
            shape = (attribute.image.count, *attribute.row)
            write_entry(packed, attribute.name, attribute.dtype, shape, attribute.listed())
            if attribute.names:
                names = _names(attribute.names)
                write_entry(packed, "label_names", names.dtype, names.shape, iter([names]))
        for name, dtype in GRID.items():
            array = np.array(getattr(image, name), dtype)
            write_entry(packed, name, array.dtype, array.shape, iter([array]))
        if isinstance(image, VoxelImage) and image.octree.transform:
            array = np.array(image.octree.transform)
            write_entry(packed, "transform", array.dtype, array.shape, iter([array]))


def _names(names: tuple[str, ...]) -> np.ndarray:
    """Return names as an array of text."""
    return np.array(names, f"<U{max(map(len, names), default=0) or 1}")


def write_entry(
    packed: zipfile.ZipFile, name: str, dtype: np.dtype, shape: Any, parts: Iterator[np.ndarray]
) -> None:
    """Write an array, given in parts, as an entry of a fixed date and system."""
    entry = zipfile.ZipInfo(f"{name}.npy")
    entry.create_system = 3
    entry.external_attr = 0o644 << 16
    descr = np.lib.format.dtype_to_descr(dtype.newbyteorder("<"))
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    with packed.open(entry, "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(file, header)
        for part in parts:
            file.write(np.ascontiguousarray(part).data)


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of a list with its grid, or of the only array of three axes, which may
    have a grid beside it."""
    packed = open_zip(file)
    members = {entry.filename.removesuffix(".npy"): entry for entry in packed.infolist()}
    grid = None
    if members.keys() >= GRID.keys():
        grid = Grid(**{name: _small(packed, members[name]) for name in GRID})
    if grid and "voxels" in members:
        return Stored(Frame(grid), _listed(packed, members, grid, size))
    arrays = [entry for name, entry in members.items() if not grid or name not in GRID]
    if len(arrays) != 1:
        names = printable(", ".join(members))[:80] or "nothing"
        raise FileError(f"holds {names}: expected one array, or voxels, shape, origin and pitch")
    entry = arrays[0]
    part = open_entry(packed, entry)
    shape, fortran, dtype = npy.read_header(part)
    check_values(dtype, shape)
    a, b, c = shape
    check_length(a * b * c * dtype.itemsize, entry.file_size)
    check_unpacked(entry.file_size, size)
    grid = grid or Grid((a, b, c), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    if grid.shape != (a, b, c):
        raise FileError(f"an array of {a} x {b} x {c}, where shape says {grid.shape}")
    return Stored(Frame(grid), dense_pieces(part, dtype, (a, b, c), fortran=fortran))


def _small(packed: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[Any, ...]:
    """Return three numbers."""
    with open_entry(packed, entry) as part:
        shape, _, dtype = npy.read_header(part)
        if shape != (3,) or dtype.kind not in "iuf":
            raise FileError(f"{entry.filename}: expected three numbers")
        return tuple(np.frombuffer(part.read(3 * dtype.itemsize), dtype, 3).tolist())


def _listed(
    packed: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], grid: Grid, size: int
) -> Iterator[Boxes]:
    """Yield the voxels of a list, each as a box of one voxel."""
    check_unpacked(members["voxels"].file_size, size)
    part = open_entry(packed, members["voxels"])
    shape, fortran, dtype = npy.read_header(part)
    if len(shape) != 2 or shape[1] != 3 or fortran or dtype.kind not in "iu":
        raise FileError("voxels: expected whole numbers, (N, 3) in C order")
    values, kind = None, np.dtype(np.uint8)
    if "values" in members:
        values = open_entry(packed, members["values"])
        count, _, kind = npy.read_header(values)
        if count != shape[:1] or kind.kind not in "biuf":
            raise FileError(f"values: expected {shape[0]} numbers, one a voxel")
    for first in range(0, shape[0], ROWS):
        rows = min(ROWS, shape[0] - first)
        data = part.read(3 * rows * dtype.itemsize)
        check_length(3 * rows * dtype.itemsize, len(data))
        voxels = np.frombuffer(data, dtype).reshape(rows, 3)
        if (voxels < 0).any() or (voxels >= grid.shape).any():
            raise FileError("voxels: one is not in the grid of its shape")
        found = np.ones(rows, kind)
        if values:
            data = values.read(rows * kind.itemsize)
            check_length(rows * kind.itemsize, len(data))
            found = np.frombuffer(data, kind)
        yield Boxes(voxels, found.reshape(rows, 1, 1, 1))
