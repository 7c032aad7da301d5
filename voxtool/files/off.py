"""OFF text to arrays: counts, a line for each vertex, and a line for each polygon.

Colours, normals and texture coordinates, which may follow on a line, are ignored.
"""

from __future__ import annotations

import re

import numpy as np

from voxtool.errors import MeshError, shown
from voxtool.files.numbers import (
    LETTERS,
    NEWLINE,
    NUMBER,
    OddityError,
    blocks_of,
    by_line,
    fans,
    numbers_in,
)
from voxtool.mesh.mesh import check_complete, check_promised

WORD = re.compile(rb"[^ \t\r]+")
HEAD = re.compile(rb"\s*(?:ST)?C?N?OFF\s+(\d{1,20})[ \t]+(\d{1,20})(?:[ \t]+\d+)?[ \t\r]*(?:\n|$)")


def parse(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of an OFF.

    MeshError names the line. Polygons become fans of triangles.
    """
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    head = HEAD.match(data)
    if head is None:
        raise MeshError(
            f"{name}: not readable as OFF: it does not begin with OFF and the numbers of vertices "
            "and faces: export it again"
        )
    wanted = int(head[1]), int(head[2])
    check_promised(name, *wanted, len(data))
    points, corners, vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0, 0
    line = data.count(b"\n", 0, head.end()) + 1
    for block in blocks_of(data, head.end()):
        numbers, first, counts, lines = _rows(name, block, line)
        split = min(wanted[0] - vertices, len(first))
        end = min(split + wanted[1] - faces, len(first))
        points.append(_vertices(name, numbers, *(rows[:split] for rows in (first, counts, lines))))
        polygons = (rows[split:end] for rows in (first, counts, lines))
        corners.append(_triangles(name, wanted[0], numbers, *polygons))
        vertices, faces = vertices + split, faces + end - split
        line += block.count(b"\n")
    check_complete(name, (vertices, faces), wanted)
    return np.concatenate(points), np.concatenate(corners)


def _rows(name: str, block: bytes, line: int) -> tuple[np.ndarray, ...]:
    """Return the numbers of a block; and of each line that has some, the first, their count, and
    the number of the line."""
    block = block if block.endswith(b"\n") else block + b"\n"
    words = np.frombuffer(block, np.uint8)
    try:
        if block.translate(None, LETTERS):
            raise OddityError
        numbers, begins = numbers_in(words, np.float64)
    except OddityError:
        texts = enumerate(block.split(b"\n"), line)
        found = ((n, word) for n, text in texts for word in WORD.findall(text))
        line, word = next((n, word) for n, word in found if not re.fullmatch(NUMBER, word))
        raise MeshError(f"{name}, line {line}: {shown(word)} is not a number: correct it") from None
    first, counts = by_line(begins, np.flatnonzero(words == NEWLINE))
    rows = np.flatnonzero(counts)
    return numbers, first[rows], counts[rows], line + rows


def _vertices(
    name: str, numbers: np.ndarray, first: np.ndarray, counts: np.ndarray, lines: np.ndarray
) -> np.ndarray:
    """Return the (V, 3) vertices of lines."""
    short = np.flatnonzero(counts < 3)
    if len(short):
        raise MeshError(
            f"{name}, line {lines[short[0]]}: a vertex of {counts[short[0]]} numbers where 3 are "
            "needed: correct it, or the file is truncated"
        )
    return numbers[first[:, None] + np.arange(3)]


def _triangles(
    name: str,
    vertices: int,
    numbers: np.ndarray,
    first: np.ndarray,
    counts: np.ndarray,
    lines: np.ndarray,
) -> np.ndarray:
    """Return the (F, 3) triangles of lines, which name vertices from 0."""
    sides = numbers[first]
    short = np.flatnonzero(~((sides >= 0) & (sides < counts) & (sides == np.floor(sides))))
    if len(short):
        raise MeshError(
            f"{name}, line {lines[short[0]]}: a face of {sides[short[0]]:g} vertices names "
            f"{counts[short[0]] - 1}: correct it, or the file is truncated"
        )
    sides = sides.astype(np.int64)
    corners = fans(numbers, first + 1, sides)
    wrong = ~((corners >= 0) & (corners < vertices) & (corners == np.floor(corners)))
    if wrong.any():
        face = int(np.argmax(wrong.any(axis=1)))
        line = np.repeat(lines, np.maximum(sides - 2, 0))[face]
        raise MeshError(
            f"{name}, line {line}: the face names vertex {corners[face][wrong[face]][0]:g} where "
            f"there are {vertices}, counted from 0: correct the index, or the file is truncated"
        )
    return corners.astype(np.int64)
