"""Wavefront OBJ text to arrays.

Two readers return the same mesh. `_quick` parses whole blocks of lines with numpy, a million
numbers in a tenth of a second, but no continued lines, comments after a statement, indented
statements or errors. `_by_line` reads any OBJ, a statement at a time, and its errors name the line.
Both gather the statements of parts and appearance where these are asked for.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from voxtool.errors import MeshError, count_of, shown
from voxtool.files.meshes.placement import Read
from voxtool.files.storage.numbers import (
    BLOCK_BYTES,
    LETTERS,
    MOST_LINE,
    NEWLINE,
    SPACE,
    SPLIT_FACE,
    OddityError,
    beside,
    blocks_of,
    by_line,
    check_lines,
    fans,
    numbers_in,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.files.meshes.companions import Companions
    from voxtool.files.meshes.obj_materials import Statements

CORNER_LETTERS = b"0123456789+-/ \t\r\n"
SLASH = ord("/")
NO_UV, NO_CORNERS = np.empty((0, 2)), np.empty((0, 3), np.int64)
NO_FACES = np.empty(0, np.int64)
NUMBER = re.compile(rb"(?i)[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?|nan|inf|infinity)")
REFERENCE = re.compile(rb"^([-+]?\d{1,10})(?:/(?:[-+]?\d+)?){0,2}$")


def parse(
    name: str, data: bytes, keep: Sequence[str], companions: Companions, max_memory: int | None
) -> Read:
    """Return the mesh of an OBJ, with its groups, objects, materials and textures as `keep` asks.

    MeshError names the line. Polygons become fans of triangles; negative indices count back from
    their line. Normals are ignored.
    """
    check_lines(name, data, b"\n \r")
    data = data.removeprefix(b"\xef\xbb\xbf")
    try:
        vertices, faces, statements = _quick(data, bool(keep))
    except OddityError:
        vertices, faces, statements = _by_line(name, data, bool(keep))
    if statements is None:
        return Read(vertices, faces)
    from voxtool.files.meshes.obj_materials import described

    return described(vertices, faces, statements, keep, companions, max_memory)


# --- blocks of lines -----------------------------------------------------------------------------


class _Block(NamedTuple):
    """The mesh of a block of lines, and what is said of it if that is asked for."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    counted_back: np.ndarray | None  # (F, 3) bool: from the block's own vertices on
    begun: list[tuple[int, str, str]]
    uv: np.ndarray  # (T, 2)
    corners: np.ndarray  # (F, 3): texture coordinates, counted from 1, from -1 back, 0 for none
    above: np.ndarray  # (F,): texture coordinates of the block that stand above
    colours: np.ndarray | None  # (V, 3)


def _quick(
    data: bytes, describe: bool, size: int = BLOCK_BYTES
) -> tuple[np.ndarray, np.ndarray, Statements | None]:
    """Return the mesh of a text of plain lines; raise OddityError for others."""
    lone_return = b"\r" in data and data.count(b"\r") != data.count(b"\r\n")
    if lone_return or (b"\\" in data and re.search(rb"\\\r?(?:\n|$)", data)):
        raise OddityError
    points, corners, known = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    said: list[_Block] = []
    for block in beside(partial(_parse_block, describe=describe), blocks_of(data, size=size)):
        if block.counted_back is not None:
            block.faces[block.counted_back] += known
        known += len(block.vertices)
        points.append(block.vertices)
        corners.append(block.faces)
        if describe:
            said.append(block)
    faces = np.concatenate(corners)
    if len(faces) and (faces.min() < 0 or faces.max() >= known):
        raise OddityError
    return np.concatenate(points), faces, _said(said) if describe else None


def _said(blocks: list[_Block]) -> Statements:
    """Return what is said of the mesh of all blocks; raise OddityError for a wrong index."""
    from voxtool.files.meshes.obj_materials import Statements

    begun, corners, known, faces = [], [np.empty((0, 3), np.int64)], 0, 0
    for block in blocks:
        begun += [(face + faces, one, words) for face, one, words in block.begun]
        back = block.corners < 0
        corners.append(
            np.where(back, block.corners + block.above[:, None] + known + 1, block.corners)
        )
        if (back & (corners[-1] <= 0)).any():
            raise OddityError
        known += len(block.uv)
        faces += len(block.faces)
    uv = np.concatenate([np.empty((0, 2)), *(block.uv for block in blocks)])
    places = np.concatenate(corners) - 1
    if len(places) and places.max() >= known:
        raise OddityError
    colours = [block.colours for block in blocks if len(block.vertices)]
    whole = [one for one in colours if one is not None]
    coloured = whole and len(whole) == len(colours)
    return Statements(begun, uv, places, np.concatenate(whole) if coloured else None)


def _whole(block: bytes) -> np.ndarray:
    """Return the letters of a block, whose last line ends."""
    if not block.endswith(b"\n"):
        last = block[block.rfind(b"\n") + 1 :]
        if last.startswith(b"f") and len(last.split()) < 4:  # it may be cut
            raise OddityError
        block += b"\n"
    return np.frombuffer(block, np.uint8)


def _parse_block(block: bytes, describe: bool) -> _Block:
    """Return the mesh of a block, and what is said of it."""
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
    colours = None
    if describe and len(counts) and (counts == 6).all():
        colours = numbers[begins[:, None] + np.arange(3, 6)]

    indices, begins, counts = _numbers(text, starts, ends, is_face, np.int64)
    back = indices < 0
    if not back.any():
        faces, counted_back = fans(indices - 1, begins, counts), None
    else:
        above = np.cumsum(is_vertex)[is_face]  # vertices of the block above each face
        indices = np.where(back, indices + np.repeat(above, counts), indices - 1)
        faces, counted_back = fans(indices, begins, counts), fans(back, begins, counts)
    if not describe:
        return _Block(vertices, faces, counted_back, [], NO_UV, NO_CORNERS, NO_FACES, None)

    after = second == ord("t")
    is_uv = (first == ord("v")) & after
    numbers, uv_begins, uv_counts = _numbers(text, starts, ends, is_uv, np.float64, letters=2)
    if (uv_counts < 1).any() or not np.isfinite(numbers).all():
        raise OddityError
    uv = np.zeros((len(uv_counts), 2))
    uv[:, 0] = numbers[uv_begins]
    two = uv_counts > 1
    uv[two, 1] = numbers[uv_begins[two] + 1]

    triangles = np.maximum(counts - 2, 0)
    references = _references(text, starts, ends, is_face)
    corners = fans(references, begins, counts)
    above = np.repeat(np.cumsum(is_uv)[is_face], triangles)
    upto = np.zeros(len(starts) + 1, np.int64)  # triangles before each line
    upto[1:][is_face] = triangles
    upto = np.cumsum(upto)
    said = np.flatnonzero(np.isin(first, np.frombuffer(b"goum", np.uint8)))
    begun = [
        (int(upto[line]), *statement)
        for line in said.tolist()
        if (statement := _statement(block[starts[line] : ends[line]].split(b"#")[0]))
    ]
    return _Block(vertices, faces, counted_back, begun, uv, corners, above, colours)


def _statement(row: bytes) -> tuple[str, str] | None:
    """Return a statement of parts or appearance, and its words; None for others."""
    words = row.split(None, 1)
    if not words or words[0] not in (b"g", b"o", b"usemtl", b"mtllib"):
        return None
    rest = words[1] if len(words) > 1 else b""
    from voxtool.files.meshes.obj_materials import name_of, text_of

    if words[0] == b"mtllib":
        return "mtllib", text_of(rest)
    return words[0].decode(), " ".join(name_of(rest).split())


def _references(
    text: np.ndarray, starts: np.ndarray, ends: np.ndarray, is_face: np.ndarray
) -> np.ndarray:
    """Return the texture coordinate that each corner of the faces names, 0 where none is, as
    _numbers returns the corners."""
    words, _, _ = _words(text, starts, ends, is_face, letters=1)
    blank = words <= SPACE
    begins = np.flatnonzero(~blank & np.append(True, blank[:-1])) if len(words) else NO_FACES
    result = np.zeros(len(begins), np.int64)
    slash = words == SLASH
    if not slash.any():
        return result
    nth = np.cumsum(slash, dtype=np.int32)
    before = nth - slash
    corner = np.cumsum(~blank & np.append(True, blank[:-1]), dtype=np.int32) - 1
    nth -= before[begins][np.maximum(corner, 0)]  # slashes of the corner up to a letter
    words[(nth != 1) | slash] = SPACE
    numbers, places = numbers_in(words, np.int64)
    result[corner[places]] = numbers
    return result


def _numbers(
    text: np.ndarray,
    starts: np.ndarray,
    ends: np.ndarray,
    chosen: np.ndarray,
    dtype: type,
    letters: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers of the chosen lines after their first letters, and for each line its first
    and its count."""
    words, _, last = _words(text, starts, ends, chosen, letters)
    allowed = LETTERS if dtype is np.float64 else CORNER_LETTERS
    if words.tobytes().translate(None, allowed):
        raise OddityError
    if dtype is np.int64 and (words == SLASH).any():
        _drop_references(words)
    numbers, begins = numbers_in(words, dtype)
    return numbers, *by_line(begins, last)


def _words(
    text: np.ndarray, starts: np.ndarray, ends: np.ndarray, chosen: np.ndarray, letters: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the text of the chosen lines without their first letters, and where each line begins
    and ends in it."""
    if chosen.all():  # as in most blocks
        words, first, last = text.copy(), starts, ends
    else:
        lengths = ends - starts
        words = text[np.repeat(chosen, lengths)]
        last = np.cumsum(lengths[chosen])
        first = last - lengths[chosen]
    for letter in range(letters):
        words[first + letter] = SPACE  # in place of v, f or vt
    return words, first, last


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


def _by_line(
    name: str, data: bytes, describe: bool
) -> tuple[np.ndarray, np.ndarray, Statements | None]:
    """Return the mesh of any OBJ; raise MeshError."""
    total = sum(1 for _ in re.finditer(rb"(?:\A|[\r\n])[ \t]*v[ \t]", data))
    all_uv = sum(1 for _ in re.finditer(rb"(?:\A|[\r\n])[ \t]*vt[ \t]", data))
    points, uv, colours = array("d"), array("d"), array("d")  # 3, 2 and 3 numbers each
    faces, uv_faces = array("q"), array("q")  # 3 corners a triangle
    begun: list[tuple[int, str, str]] = []
    line, corners = 0, [0] * 3
    try:
        for line, words in _statements(data):  # noqa: B007 (for the message)
            corners = [0] * 3
            if words[:1] == [b"v"]:
                points.extend(_vertex(words[1:4]))
                if describe and len(words) == 7:
                    colours.extend(_vertex(words[4:7]))
            elif words[:1] == [b"f"]:
                known = len(points) // 3
                corners = [_index(word, known, total) for word in words[1:]]
                _add_fan(faces, corners)
                if describe:
                    known = len(uv) // 2
                    _add_fan(uv_faces, [_uv_index(word, known, all_uv) for word in words[1:]])
            elif describe and words[:1] == [b"vt"]:
                uv.extend(_vertex([*words[1:3], *[b"0"] * 3][:3])[:2])
            elif describe and (statement := _statement(b" ".join(words))):
                begun.append((len(faces) // 3, *statement))
        if len(corners) < 3 and not data.endswith((b"\n", b"\r")):
            raise MeshError(
                f"the last face has {count_of(len(corners), 'vertex')}: the file is truncated"
            )
    except MeshError as error:
        raise MeshError(f"{name}, line {line}: {error}") from None
    statements = None
    if describe:
        from voxtool.files.meshes.obj_materials import Statements

        coloured = len(colours) == len(points) > 0
        statements = Statements(
            begun, np.array(uv).reshape(-1, 2), np.array(uv_faces).reshape(-1, 3),
            np.array(colours).reshape(-1, 3) if coloured else None,
        )  # fmt: skip
    return np.array(points).reshape(-1, 3), np.array(faces).reshape(-1, 3), statements


def _add_fan(faces: array[int], corners: list[int]) -> None:
    """Add a polygon as a fan of triangles."""
    for i in range(1, len(corners) - 1):
        faces.extend((corners[0], corners[i], corners[i + 1]))


def _statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Yield line number and words of each statement; a backslash continues a line."""
    begun: list[bytes] = []
    first, letters = 0, 0
    lines = (line for block in blocks_of(data) for line in block.splitlines())
    for number, line in enumerate(lines, 1):
        line = line.partition(b"#")[0]
        first = first or number
        letters += len(line)
        if letters > MOST_LINE:
            raise MeshError(f"a statement of more than {MOST_LINE >> 20} MiB: {SPLIT_FACE}")
        if line.endswith(b"\\"):
            begun.append(line[:-1])
            continue
        yield first, b" ".join([*begun, line]).split()
        begun.clear()
        first, letters = 0, 0
    if begun:
        yield first, b" ".join(begun).split()


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
        count = f"there are {total:,}" if index >= 0 else f"{known:,} stand above"
        raise MeshError(
            f"the face names vertex {index} where {count}, counted from 1: correct the index, or "
            "the file is truncated"
        )
    return absolute - 1


def _uv_index(word: bytes, known: int, total: int) -> int:
    """Return the texture coordinate that a corner names, counted from 0; -1 if none."""
    second = word.split(b"/")[1:2]
    if second in ([], [b""]):
        return -1
    index = int(second[0])
    if not index:  # as some programs write for none
        return -1
    absolute = index if index >= 0 else known + 1 + index
    if not 1 <= absolute <= total:
        raise MeshError(
            f"the face names texture coordinate {index} where there are {total}: correct the index"
        )
    return absolute - 1
