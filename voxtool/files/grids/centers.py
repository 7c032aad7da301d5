"""Centres of set cells as points: binary .ply with float64 x, y and z, or .xyz, lines of text.

Cells are in lexicographic order. A .ply of counts or coverages has them as the property `value`.
Normals are float32: nx, ny and nz of a .ply, three more columns of .xyz. Attributes of voxels
follow: the properties label, red, green, blue, alpha, nx, ny, nz, fraction and face_x0 to face_z1,
with the names of labels as comments; of .xyz the same columns.
"""

from __future__ import annotations

from math import prod
from typing import BinaryIO

import numpy as np

from voxtool.choices import FACE_NAMES
from voxtool.errors import printable
from voxtool.svo.images.attribute_image import AttributeImage, attributes_of, listed_with
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.normals import Normals

HEADER = 256  # bytes of the header, at most
LINE = 75  # bytes of a line of text, at most: three numbers of 24 letters
NORMAL = 51  # of a normal in it, at most: three numbers of 16 letters
NUMBER = 17  # of another number
COLUMNS = {
    "colour": ("red", "green", "blue", "alpha"),
    "normal": ("nx", "ny", "nz"),
    "faces": FACE_NAMES,
}
TYPES = {
    "uint8": "uchar",
    "uint16": "ushort",
    "uint32": "uint",
    "float32": "float",
    "float64": "double",
}


def size_ply(image: VoxelImage, normals: bool = False) -> int:
    """Return the bytes of the file."""
    attributes = attributes_of(image)
    each = 24 + image.dtype.itemsize + 12 * normals
    each += sum(attribute.cell_bytes for attribute in attributes)
    named = sum(map(len, _comments(attributes))) + HEADER * len(attributes)
    return HEADER + named + image.count * each


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
    attributes = attributes_of(image)
    for attribute in attributes:
        own = COLUMNS.get(attribute.name, (attribute.name,))
        columns += [(name, attribute.dtype.str) for name in own]
        names += [f"{TYPES[attribute.dtype.name]} {name}" for name in own]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *_comments(attributes),
        f"element vertex {image.count}",
        *(f"property {name}" for name in names),
        "end_header",
        "",
    ]
    file.write("\n".join(lines).encode())
    for cells, values, others in listed_with(image, image.attributes):
        points = np.empty(len(cells), columns)
        for axis, column in zip("xyz", centers(image, cells).T, strict=True):
            points[axis] = column
        if found:
            for axis, column in zip("xyz", found.of(cells).T, strict=True):
                points[f"n{axis}"] = column
        if image.dtype != bool:
            points["value"] = values
        for attribute, held in zip(attributes, others, strict=True):
            own = COLUMNS.get(attribute.name, (attribute.name,))
            for name, column in zip(own, as_rows(held).T, strict=True):
                points[name] = column
        file.write(points.data)


def _comments(attributes: list[AttributeImage]) -> list[str]:
    """Return a comment for each name of a label."""
    return [
        f"comment label {number} {printable(name)}"
        for attribute in attributes
        for number, name in enumerate(attribute.names)
        if number
    ]


def size_xyz(image: VoxelImage, normals: bool = False) -> int:
    """Return the bytes of the file, at most."""
    numbers = sum(attribute.channels for attribute in attributes_of(image))
    return image.count * (LINE + NORMAL * normals + NUMBER * numbers)


def write_xyz(image: VoxelImage, file: BinaryIO, normals: bool = False) -> None:
    """Write the points, a line each; numbers of points are the shortest that read back exactly,
    those of normals have nine digits, which do."""
    found = Normals(image) if normals else None
    for cells, _, others in listed_with(image, image.attributes):
        rows = [f"{x!r} {y!r} {z!r}" for x, y, z in centers(image, cells).tolist()]
        if found:
            vectors = found.of(cells).tolist()
            rows = [
                f"{row} {x:.9g} {y:.9g} {z:.9g}"
                for row, (x, y, z) in zip(rows, vectors, strict=True)
            ]
        for held in others:
            form = ".9g" if held.dtype.kind == "f" else "d"
            added = (" ".join(f"{v:{form}}" for v in numbers) for numbers in as_rows(held).tolist())
            rows = [f"{row} {numbers}" for row, numbers in zip(rows, added, strict=True)]
        file.write("".join(f"{row}\n" for row in rows).encode())


def as_rows(values: np.ndarray) -> np.ndarray:
    """Return the values of cells as rows of numbers, (n, channels), also of no cell."""
    return values.reshape(len(values), prod(values.shape[1:]))


def centers(image: VoxelImage, cells: np.ndarray) -> np.ndarray:
    """Return the world coordinates of the centres of cells, (N, 3) float64."""
    return (cells + 0.5) * image.pitch + image.origin
