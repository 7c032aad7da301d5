"""NIfTI images, .nii and .nii.gz; nibabel reads and writes the header, and the array is streamed.

World coordinates are those of the affine: x to the right, y to the front, z up (RAS). The affine is
float32; an extension of code 6 (a comment) has the exact grid, another one the names of labels.
Colours are of the type RGBA32; normals and faces are vectors along the fifth axis. Images that
other programs write may have any axes along those of the world; `scl_slope` and `scl_inter` apply
before a threshold.
https://nifti.nimh.nih.gov/nifti-1/documentation
"""

from __future__ import annotations

import gzip
import io
import struct
import warnings
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, one_line
from voxtool.files.grids.voxels import (
    Boxes,
    Dense,
    Stored,
    check_length,
    check_values,
    dense_pieces,
    exactly,
    frame_of,
    grid_of_text,
    grid_text,
    names_text,
)
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.unpacked import Unpacked, check_unpacked
from voxtool.grid import check_single

HEADER = 1024  # bytes before the array, at most
MOST_SIDE = 32767  # int16
MARK = "voxtool grid "  # before the exact grid in the comment
LABELS = "voxtool labels "  # before the names of labels
LABEL, VECTOR = "label", "vector"  # intents
COLOUR = [(name, "u1") for name in "RGBA"]
UNITS = {"m": "meter", "mm": "mm", "um": "micron"}
UNIT_CODES = {1: "m", 2: "mm", 3: "um"}
LEVEL = 6  # of gzip
# Where the size of the header and the offset of the array lie, by version.
SIZES, OFFSETS = {348: 1, 540: 2}, {1: (108, "f"), 2: (168, "q")}
MAGICS = {1: (344, b"n+1"), 2: (4, b"n+2")}  # of headers whose array is in the same file
MOST_OFFSET = 1 << 22  # bytes of a header and its extensions


def size(image: Dense) -> int:
    """Return the bytes of the file; FileError if a side is too long."""
    if max(image.shape) > MOST_SIDE:
        raise FileError(
            f"a side of {max(image.shape)} cells is more than a .nii can have, {MOST_SIDE}: choose "
            f"{image.smaller}"
        )
    return HEADER + len(names_text(image)) + image.nbytes


def size_packed(image: Dense) -> int:
    """Return the bytes of the file, in which cells far inside or far outside take few."""
    return image.mixed * image.dtype.itemsize + size(image) // (PACKED // 4) + HEADER


def write(image: Dense, file: BinaryIO) -> None:
    """Write the image."""
    _header(image).write_to(file)
    numbers = _numbers(image)
    for number in range(numbers or 1):  # of which each is an array
        for slab in image.slabs((2, 1, 0)):
            values = slab[..., number] if numbers else slab
            file.write(np.ascontiguousarray(values).view(np.uint8).data)


def write_packed(image: Dense, file: BinaryIO) -> None:
    """Write the image, compressed by gzip."""
    with gzip.GzipFile("", "wb", LEVEL, file, mtime=0) as packed:
        write(image, packed)  # pyright: ignore[reportArgumentType]


def _numbers(image: Dense) -> int:
    """Return the numbers of a vector; 0 of other values."""
    return getattr(image, "channels", 1) if image.quantity in ("normal", "faces") else 0


def _dtype(image: Dense) -> np.dtype:
    if image.quantity == "colour":
        return np.dtype(COLOUR)
    return np.dtype(np.uint8) if image.dtype == bool else image.dtype


def _header(image: Dense) -> Any:
    """Return the header, with the exact grid as its extension."""
    from nibabel.nifti1 import Nifti1Extension, Nifti1Header

    header = Nifti1Header(endianness="<")
    header.set_data_dtype(_dtype(image))
    header.set_data_shape(
        (*image.shape, 1, numbers) if (numbers := _numbers(image)) else image.shape
    )
    names = names_text(image)
    if names or numbers:
        header.set_intent(LABEL if names else VECTOR)
    affine = np.diag([*image.pitch, 1.0])
    affine[:3, 3] = np.add(image.origin, np.array(image.pitch) / 2)
    check_single("the head of .nii", image.pitch, affine, "write .nrrd")
    header.set_sform(affine, "scanner")
    header.set_qform(affine, "scanner")
    header.set_xyzt_units(UNITS.get(image.units, "unknown"))
    header.extensions.append(Nifti1Extension(6, (MARK + grid_text(image)).encode()))
    if names:
        header.extensions.append(Nifti1Extension(6, (LABELS + names).encode()))
    return header


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of an image."""
    return _read(file, lambda needed, start: check_length(needed, size - start))


def read_packed(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of a compressed image."""
    packed = Unpacked(gzip.GzipFile(fileobj=file), "gzip data")

    def check(needed: int, _: int) -> None:
        check_length(needed, PACKED * size)
        check_unpacked(needed, size)

    return _read(packed, check)


def _read(file: BinaryIO | Unpacked, check: Callable[[int, int], None]) -> Stored:
    """Return the voxels; `check` takes the bytes of the array and where it begins, and refuses
    what the file cannot hold."""
    header = _read_header(file)
    try:
        shape = list(map(int, header.get_data_shape()))
        dtype = header.get_data_dtype()
        affine = np.asarray(header.get_best_affine(), np.float64)
        slope, inter = header.get_slope_inter()
    except Exception as error:  # damage shows in any of the library's errors
        raise FileError(f"a damaged header: {one_line(error)}") from None
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    check_values(dtype, shape)
    a, b, c = shape
    check(a * b * c * dtype.itemsize, file.tell())
    frame = exactly(frame_of((a, b, c), affine[:3, :3], affine[:3, 3]), _exact(header))
    pieces = dense_pieces(file, dtype, (a, b, c), fortran=True)
    if (slope, inter) not in ((None, None), (1.0, 0.0)):
        pieces = _scaled(pieces, slope, inter)
    return Stored(frame, pieces, UNIT_CODES.get(int(header["xyzt_units"]) & 7, ""))


def _read_header(file: BinaryIO | Unpacked) -> Any:
    """Return the header; the file is then at the array."""
    from nibabel.nifti1 import Nifti1Header
    from nibabel.nifti2 import Nifti2Header

    opening = file.read(max(SIZES))
    order, version = next(
        ((o, SIZES[n]) for o in "<>" for n in struct.unpack(f"{o}i", opening[:4]) if n in SIZES),
        ("", 0),
    )
    place, kind = OFFSETS.get(version, (0, ""))
    if not version or len(opening) < place + 8:
        raise FileError("is no NIfTI image of version 1 or 2, or ends in its header")
    start, magic = MAGICS[version]
    if opening[start : start + len(magic)] != magic:
        raise FileError("is half of a NIfTI image: save header and array as one .nii")
    (offset,) = struct.unpack_from(order + kind, opening, place)
    if not min(SIZES) < offset <= MOST_OFFSET:
        raise FileError(f"its array begins at byte {offset:g}: it must lie in the same file")
    file.seek(0)
    head = file.read(int(offset))
    reader = {1: Nifti1Header, 2: Nifti2Header}[version]
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # of odd extensions
            header = reader.from_fileobj(io.BytesIO(head), check=False)
    except Exception as error:  # damage shows in any of the library's errors
        raise FileError(f"a damaged header: {one_line(error)}") from None
    return header


def _exact(header: Any) -> Any:
    """Return the grid in the header's comments, or None."""
    for extension in header.extensions:
        content = extension.get_content()
        if isinstance(content, str):
            content = content.encode()
        if isinstance(content, bytes) and content.startswith(MARK.encode()):
            return grid_of_text(content.decode("utf-8", "replace").rstrip("\0")[len(MARK) :])
    return None


def _scaled(pieces: Iterator[Boxes], slope: float, inter: float) -> Iterator[Boxes]:
    for corners, values in pieces:
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values.astype(np.float64) * slope + inter
        yield Boxes(corners, scaled)
