"""NRRD images, .nrrd, compressed by gzip.

World coordinates are x to the right, y to the front, z up (RAS), as in NIfTI: those of an image in
another anatomical space are turned. Positions are those of centres; the key `voxtool grid` has the
exact grid, and `voxtool labels` the names of labels as JSON. Channels of colours, normals and
faces are the first axis. Detached headers, which name another file, are refused.
https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import bz2
import gzip
import io
from typing import BinaryIO

import numpy as np

from voxtool.errors import FileError, shown
from voxtool.files.grids.voxels import (
    Dense,
    Readable,
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
from voxtool.files.storage.text_numbers import array_of_text, real, whole
from voxtool.files.storage.unpacked import Unpacked, check_unpacked
from voxtool.memory import check_memory

HEADER = 1024  # bytes before the array, at most
MOST_HEADER = 1 << 20
LEVEL = 6  # of gzip
GRID, LABELS = "voxtool grid", "voxtool labels"
KINDS = {4: "RGBA-color", 3: "3-normal", 6: "list"}  # of the axis of channels
TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int",
           "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}  # fmt: skip
NAMES = {"bool": "uint8", "float32": "float", "float64": "double"}
# The signs of x and y of an anatomical space, in RAS.
SPACES = {
    "right-anterior-superior": (1, 1),
    "ras": (1, 1),
    "left-anterior-superior": (-1, 1),
    "las": (-1, 1),
    "left-posterior-superior": (-1, -1),
    "lps": (-1, -1),
}
DIRECTIONS, ORIGIN = "space directions", "space origin"


def size(image: Dense) -> int:
    """Return the bytes of the file, in which cells far inside or far outside take few."""
    return (
        HEADER
        + len(names_text(image))
        + image.mixed * image.dtype.itemsize
        + image.nbytes // (PACKED // 4)
    )


def write(image: Dense, file: BinaryIO) -> None:
    """Write the image."""
    steps = " ".join(_vector(row) for row in np.diag(image.pitch).tolist())
    center = np.add(image.origin, np.array(image.pitch) / 2)
    channels, names = getattr(image, "channels", 1), names_text(image)
    before = [[], []] if channels == 1 else [[KINDS[channels]], [channels]]
    lines = [
        "NRRD0005",
        f"type: {NAMES.get(image.dtype.name, image.dtype.name)}",
        f"dimension: {3 + len(before[0])}",
        "space: right-anterior-superior",
        f"sizes: {' '.join(map(str, [*before[1], *image.shape]))}",
        f"{DIRECTIONS}: {'none ' * len(before[0])}{steps}",
        f"kinds: {' '.join([*before[0], *['domain'] * 3])}",
        "endian: little",
        "encoding: gzip",
        *([f"space units: {' '.join([_quoted(image.units)] * 3)}"] if image.units else []),
        f"{ORIGIN}: {_vector(center.tolist())}",
        f"{GRID}:={grid_text(image)}",
        *([f"{LABELS}:={names}"] if names else []),
    ]
    file.write("\n".join([*lines, "", ""]).encode())
    with gzip.GzipFile("", "wb", LEVEL, file, mtime=0) as packed:
        for slab in image.slabs((2, 1, 0)):
            packed.write(np.ascontiguousarray(slab).view(np.uint8).data)


def _vector(numbers: list[float]) -> str:
    return f"({','.join(map(repr, numbers))})"


def _quoted(text: str) -> str:
    return '"' + "".join(c for c in text if c.isalnum() or c in " ^/-_.") + '"'


def read(file: BinaryIO, size: int) -> Stored:
    """Return the voxels of an image."""
    fields, keys = _read_header(file)
    shape = tuple(map(whole, _need(fields, "sizes").split()))
    name = _need(fields, "type").lower()
    kind = next((kind for kind, names in TYPES.items() if name in names), None)
    if kind is None:
        raise FileError(f"values of type {shown(name.encode())}: expected integers or floats")
    dtype = np.dtype(f"{'>' if fields.get('endian') == 'big' else '<'}{kind}")
    check_values(dtype, shape)
    a, b, c = shape
    matrix, center = _place(fields)
    frame = exactly(frame_of((a, b, c), matrix, center), grid_of_text(keys.get(GRID, "")))
    needed = a * b * c * dtype.itemsize
    stream = _stream(file, fields, dtype, needed, size - file.tell())
    units = set(fields.get("space units", "").split('"')[1::2])
    unit = units.pop() if len(units) == 1 else ""
    return Stored(frame, dense_pieces(stream, dtype, (a, b, c), fortran=True), unit)


def _read_header(file: BinaryIO) -> tuple[dict[str, str], dict[str, str]]:
    """Return the fields and the keys of the header, up to the empty line."""
    if not file.readline(16).startswith(b"NRRD000"):
        raise FileError("is no NRRD image")
    fields: dict[str, str] = {}
    keys: dict[str, str] = {}
    while line := file.readline(MOST_HEADER):
        text = line.decode("utf-8", "replace").rstrip("\r\n")
        if not text:
            break
        if file.tell() > MOST_HEADER:
            raise FileError(f"its header has more than {MOST_HEADER} bytes")
        if text.startswith("#"):
            continue
        name, mark, value = text.partition(":=")
        if mark:
            keys[name] = value
        else:
            name, mark, value = text.partition(": ")
            if not mark:
                raise FileError(f"a header line that is no field: {shown(line)}")
            fields[name.strip().lower()] = value.strip()
    for name in ("data file", "datafile"):
        if name in fields:
            raise FileError("its array lies in another file: save it as one .nrrd")
    return fields, keys


def _need(fields: dict[str, str], name: str) -> str:
    if name not in fields:
        raise FileError(f"its header has no {name}")
    return fields[name]


def _place(fields: dict[str, str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps along the axes as columns, and the first centre, in RAS."""
    matrix, center = np.eye(3), np.zeros(3)
    if DIRECTIONS in fields:
        rows = [_numbers(word) for word in fields[DIRECTIONS].split(")") if word.strip()]
        matrix = np.array(rows, float).T
    elif "spacings" in fields:
        matrix = np.diag([real(word) for word in fields["spacings"].split()])
    if ORIGIN in fields:
        center = np.array(_numbers(fields[ORIGIN]), float)
    if matrix.shape != (3, 3) or center.shape != (3,):
        raise FileError("its axes are not three directions of space")
    x, y = SPACES.get(fields.get("space", "").lower(), (1, 1))
    signs = np.array([x, y, 1.0])
    return matrix * signs[:, None], center * signs


def _numbers(text: str) -> list[float]:
    return [real(word) for word in text.strip(" ()").split(",")]


def _stream(
    file: BinaryIO, fields: dict[str, str], dtype: np.dtype, needed: int, held: int
) -> Readable:
    """Return the array as a stream of bytes."""
    encoding = _need(fields, "encoding").lower()
    skip = whole(fields.get("byte skip", fields.get("byteskip", "0")))
    if fields.get("line skip", fields.get("lineskip", "0")) != "0" or skip < -1:
        raise FileError("lines between header and array: save it without")
    if encoding == "raw":
        skip = held - needed if skip < 0 else skip
        check_length(needed, held - skip)
        file.seek(skip, io.SEEK_CUR)
        return file
    if skip:
        raise FileError("bytes between header and array: save it without")
    if encoding in ("gz", "gzip"):
        check_length(needed, PACKED * held)
        check_unpacked(needed, held)
        return Unpacked(gzip.GzipFile(fileobj=file), "gzip data")
    if encoding in ("bz2", "bzip2"):
        check_unpacked(needed, held)
        return Unpacked(bz2.BZ2File(file), "bzip2 data")
    if encoding in ("txt", "text", "ascii"):
        check_length(needed, held * dtype.itemsize)
        check_memory(100 * held, "an array of text")
        return io.BytesIO(array_of_text(file.read(), dtype).tobytes())
    raise FileError(f"encoding {shown(encoding.encode())} is not read: save it with gzip")
