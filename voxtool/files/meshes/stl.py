"""STL to arrays: triangles of three points each, binary or as text. Normals are not read."""

from __future__ import annotations

import re

import numpy as np

from voxtool.arrays import float64
from voxtool.errors import MeshError, shown
from voxtool.files.storage.numbers import (
    LETTERS,
    NEWLINE,
    NUMBER,
    OddityError,
    blocks_of,
    by_line,
    check_lines,
    numbers_in,
)
from voxtool.mesh.mesh import check_counts

HEAD = 84  # bytes: a text and the number of triangles
TRIANGLE = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("more", "<u2")])
THREE = re.compile(rb"(?:[ \t]*" + NUMBER + rb"(?![^ \t])){3}[ \t]*")
VERTEX = re.compile(rb"(?im)^[ \t]*vertex[ \t]+([^\r\n]*)")


def binary_size(data: bytes) -> int:
    """Return the size of a binary STL with the number of triangles in its header, bytes."""
    return HEAD + TRIANGLE.itemsize * int.from_bytes(data[HEAD - 4 : HEAD], "little")


def parse(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the (3 F, 3) float64 vertices and (F, 3) int64 faces of an STL; MeshError if it is
    damaged."""
    size = binary_size(data)
    if len(data) == size:
        count = (size - HEAD) // TRIANGLE.itemsize
        check_counts(name, 3 * count, count)
        points = np.frombuffer(data, TRIANGLE, offset=HEAD)["points"]
    elif b"\0" in data[:1024] or not re.match(rb"\s*solid\b", data):
        raise MeshError(
            f"{name}: {len(data):,} bytes where an STL of "
            f"{(size - HEAD) // TRIANGLE.itemsize:,} "
            f"triangles, as the header counts, has {size:,}: the file is truncated or no STL"
        )
    elif b"endsolid" not in data[-4096:].lower():
        raise MeshError(f"{name}: 'endsolid' is missing at its end: the file is truncated")
    else:
        points = _text_points(name, data)
    vertices = float64(points).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _text_points(name: str, data: bytes) -> np.ndarray:
    """Return the (3 F, 3) vertices of the triangles of a text."""
    check_lines(name, data)
    points, known = [np.empty((0, 3))], 0
    for block in blocks_of(data):
        rows = VERTEX.findall(block)
        text = b"".join(row + b"\n" for row in rows)
        words = np.frombuffer(text, np.uint8)
        try:
            if text.translate(None, LETTERS):
                raise OddityError
            numbers, begins = numbers_in(words, np.float64)
            if (by_line(begins, np.flatnonzero(words == NEWLINE))[1] != 3).any():
                raise OddityError
        except OddityError:
            odd = next(i for i, row in enumerate(rows) if not THREE.fullmatch(row))
            raise MeshError(
                f"{name}: vertex {known + odd} of the STL is {shown(rows[odd])}, which is not "
                "three numbers: correct it"
            ) from None
        points.append(numbers.reshape(-1, 3))
        known += len(rows)
    if known % 3:
        raise MeshError(
            f"{name}: {known} vertices in an STL of triangles: it is damaged, export it again"
        )
    return np.concatenate(points)
