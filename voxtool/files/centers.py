"""Centres of set cells as points: binary .ply with float64 x, y and z, or .xyz, lines of text.

Cells are in lexicographic order. A .ply of counts or coverages has them as the property `value`.
Normals are float32: nx, ny and nz of a .ply, three more columns of .xyz.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from voxtool.svo.image import VoxelImage
from voxtool.svo.normals import Normals

HEADER = 256  # bytes of the header, at most
LINE = 75  # bytes of a line of text, at most: three numbers of 24 letters
NORMAL = 51  # of a normal in it, at most: three numbers of 16 letters
TYPES = {
    "uint8": "uchar",
    "uint16": "ushort",
    "uint32": "uint",
    "float32": "float",
    "float64": "double",
}


def size_ply(image: VoxelImage, normals: bool = False) -> int:
    """Bytes of the file."""
    return HEADER + image.count * (24 + image.dtype.itemsize + 12 * normals)


def write_ply(image: VoxelImage, file: BinaryIO, normals: bool = False) -> None:
    """Write the points."""
    found = Normals(image) if normals else None
    columns = [(axis, "<f8") for axis in "xyz"]
    names = [f"double {axis}" for axis in "xyz"]
    if found:
        columns += [(f"n{axis}", "<f4") for axis in "xyz"]
        names += [f"float n{axis}" for axis in "xyz"]
    if image.dtype != bool:
        columns.append(("value", image.dtype.str))
        names.append(f"{TYPES[image.dtype.name]} value")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {image.count}",
        *(f"property {name}" for name in names),
        "end_header",
        "",
    ]
    file.write("\n".join(lines).encode())
    for cells, values in image.listed():
        points = np.empty(len(cells), columns)
        for axis, column in zip("xyz", centers(image, cells).T, strict=True):
            points[axis] = column
        if found:
            for axis, column in zip("xyz", found.of(cells).T, strict=True):
                points[f"n{axis}"] = column
        if image.dtype != bool:
            points["value"] = values
        file.write(points.data)


def size_xyz(image: VoxelImage, normals: bool = False) -> int:
    """Bytes of the file, at most."""
    return image.count * (LINE + NORMAL * normals)


def write_xyz(image: VoxelImage, file: BinaryIO, normals: bool = False) -> None:
    """Write the points, a line each; numbers of points are the shortest that read back exactly,
    those of normals have nine digits, which do."""
    found = Normals(image) if normals else None
    for cells in image.coordinates():
        rows = [f"{x!r} {y!r} {z!r}" for x, y, z in centers(image, cells).tolist()]
        if found:
            vectors = found.of(cells).tolist()
            rows = [
                f"{row} {x:.9g} {y:.9g} {z:.9g}"
                for row, (x, y, z) in zip(rows, vectors, strict=True)
            ]
        file.write("".join(f"{row}\n" for row in rows).encode())


def centers(image: VoxelImage, cells: np.ndarray) -> np.ndarray:
    """Return the world coordinates of the centres of cells, (N, 3) float64."""
    return (cells + 0.5) * image.pitch + image.origin
