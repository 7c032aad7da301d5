"""Wavefront OBJ text to arrays.

Two readers return the same mesh. `_quick` parses whole blocks of lines with numpy, a million
numbers in a tenth of a second, but no continued lines, comments after a statement, indented
statements or errors. `_by_line` reads any OBJ, a statement at a time, and its errors name the line.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MeshError, count_of, shown
from voxtool.files.numbers import (
    BLOCK_BYTES,
    LETTERS,
    NEWLINE,
    SPACE,
    OddityError,
    beside,
    blocks_of,
    by_line,
    fans,
    numbers_in,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

CORNER_LETTERS = b"0123456789+-/ \t\r\n"
SLASH = ord("/")
NUMBER = re.compile(rb"(?i)[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf|infinity)")
REFERENCE = re.compile(rb"^([-+]?\d{1,10})(?:/(?:[-+]?\d+)?){0,2}$")


def parse(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the (V, 3) float64 vertices and (F, 3) int64 faces of an OBJ.

    MeshError names the line. Polygons become fans of triangles; negative indices count back from
    their line. Groups, materials, texture coordinates and normals are ignored.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    try:
        return _quick(data)
    except OddityError:
        return _by_line(name, data)


# --- blocks of lines -----------------------------------------------------------------------------


def _quick(data: bytes, size: int = BLOCK_BYTES) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh of a text of plain lines; raise OddityError for others."""
    lone_return = b"\r" in data and data.count(b"\r") != data.count(b"\r\n")
    if lone_return or (b"\\" in data and re.search(rb"\\\r?(?:\n|$)", data)):
        raise OddityError
    points, corners, known = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for vertices, faces, counted_back in beside(_parse_block, blocks_of(data, size=size)):
        if counted_back is not None:
            faces[counted_back] += known
        known += len(vertices)
        points.append(vertices)
        corners.append(faces)
    faces = np.concatenate(corners)
    if len(faces) and (faces.min() < 0 or faces.max() >= known):
        raise OddityError
    return np.concatenate(points), faces


def _whole(block: bytes) -> np.ndarray:
    """Return the letters of a block, whose last line ends."""
    if not block.endswith(b"\n"):
        last = block[block.rfind(b"\n") + 1 :]
        if last.startswith(b"f") and len(last.split()) < 4:  # it may be cut
            raise OddityError
        block += b"\n"
    return np.frombuffer(block, np.uint8)


def _parse_block(block: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the (V, 3) vertices and (F, 3) faces of a block, and which indices count back, from
    the block's own vertices on, (F, 3) bool; None if none do."""
    text = _whole(block)
    ends = np.flatnonzero(text == NEWLINE) + 1
    starts = np.concatenate([[0], ends[:-1]])
    first, second = text[starts], text[np.minimum(starts + 1, len(text) - 1)]
    if np.isin(first, np.frombuffer(b" \t\v\f", np.uint8)).any():
        raise OddityError
    spaced = (second == SPACE) | (second == ord("\t"))
    is_vertex, is_face = ((first == ord(letter)) & spaced for letter in "vf")

    numbers, begins, counts = _numbers(text, starts, ends, is_vertex, np.float64)
    if (counts < 3).any() or not np.isfinite(numbers).all():
        raise OddityError
    vertices = numbers[begins[:, None] + np.arange(3)]

    indices, begins, counts = _numbers(text, starts, ends, is_face, np.int64)
    back = indices < 0
    if not back.any():
        return vertices, fans(indices - 1, begins, counts), None
    above = np.cumsum(is_vertex)[is_face]  # vertices of the block that stand above each face
    indices = np.where(back, indices + np.repeat(above, counts), indices - 1)
    return vertices, fans(indices, begins, counts), fans(back, begins, counts)


def _numbers(
    text: np.ndarray, starts: np.ndarray, ends: np.ndarray, chosen: np.ndarray, dtype: type
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of the chosen lines, and for each line its first and its count."""
    if chosen.all():  # as in most blocks
        words, first, last = text.copy(), starts, ends
    else:
        lengths = ends - starts
        words = text[np.repeat(chosen, lengths)]
        last = np.cumsum(lengths[chosen])
        first = last - lengths[chosen]
    words[first] = SPACE  # in place of v or f
    allowed = LETTERS if dtype is np.float64 else CORNER_LETTERS
    if words.tobytes().translate(None, allowed):
        raise OddityError
    if dtype is np.int64 and (words == SLASH).any():
        _drop_references(words)
    numbers, begins = numbers_in(words, dtype)
    return numbers, *by_line(begins, last)


def _drop_references(words: np.ndarray) -> None:
    """Blank out /vt/vn after the corners of faces; raise OddityError for other text."""
    places = np.arange(len(words), dtype=np.int32)
    slash, blank = words == SLASH, words <= SPACE
    after_slash = np.maximum.accumulate(np.where(slash, places, -1))
    after_blank = np.maximum.accumulate(np.where(blank, places, -1))
    tail = after_slash > after_blank
    sign = tail & ((words == ord("+")) | (words == ord("-")))
    digit_next = np.append((words[1:] >= ord("0")) & (words[1:] <= ord("9")), False)
    third = np.cumsum(slash, dtype=np.int32)
    third -= np.where(after_blank >= 0, third[after_blank], 0)
    wrong_sign = sign[1:] & ~(slash[:-1] & digit_next[1:])
    if (third > 2).any() or wrong_sign.any() or (slash[1:] & blank[:-1]).any():
        raise OddityError
    words[tail] = SPACE


# --- a statement at a time -----------------------------------------------------------------------


def _by_line(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh of any OBJ; raise MeshError."""
    total = len(re.findall(rb"^[ \t]*v[ \t]", data, re.M))
    points: list[list[float]] = []
    faces: list[list[int]] = []
    line, corners = 0, [0] * 3
    try:
        for line, words in _statements(data):  # noqa: B007 (for the message)
            corners = [0] * 3
            if words[:1] == [b"v"]:
                points.append(_vertex(words[1:4]))
            elif words[:1] == [b"f"]:
                corners = [_index(word, len(points), total) for word in words[1:]]
                faces += [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
        if len(corners) < 3 and not data.endswith((b"\n", b"\r")):
            raise MeshError(
                f"the last face has {count_of(len(corners), 'vertex')}: the file is truncated"
            )
    except MeshError as error:
        raise MeshError(f"{name}, line {line}: {error}") from None
    return np.array(points).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)


def _statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Yield line number and words of each statement; a backslash continues a line."""
    begun, first = b"", 0
    for number, line in enumerate(data.splitlines(), 1):
        line = begun + line.partition(b"#")[0]
        first = first or number
        if line.endswith(b"\\"):
            begun = line[:-1] + b" "
            continue
        yield first, line.split()
        begun, first = b"", 0
    if begun:
        yield first, begun.split()


def _vertex(words: list[bytes]) -> list[float]:
    for word in words:
        if not NUMBER.fullmatch(word):
            raise MeshError(f"{shown(word)} is not a number: correct the vertex")
        if not math.isfinite(float(word)):
            raise MeshError(f"coordinate {shown(word)} is not finite: correct the vertex")
    if len(words) < 3:
        raise MeshError(
            f"a vertex of {count_of(len(words), 'coordinate')} where 3 are needed: correct it, or "
            "the file is truncated"
        )
    return [float(word) for word in words]


def _index(word: bytes, known: int, total: int) -> int:
    """Return a vertex of a face, counted from 0; negative numbers in the file count back."""
    match = REFERENCE.match(word)
    if not match:
        raise MeshError(f"{shown(word)} is no vertex of a face: correct it to v, v/vt or v/vt/vn")
    index = int(match[1])
    absolute = index if index >= 0 else known + 1 + index
    if not 1 <= absolute <= total:
        count = f"there are {total}" if index >= 0 else f"{known} stand above"
        raise MeshError(
            f"the face names vertex {index} where {count}, counted from 1: correct the index, or "
            "the file is truncated"
        )
    return absolute - 1
