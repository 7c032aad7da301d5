"""Wavefront OBJ as text that trimesh reads as it stands.

trimesh counts relative indices from the end of the file, takes index 0 for 1, sorts faces by
material and polygon, and overlooks lines that begin with a blank. So it gets `v x y z` and
`f a b c` lines alone; most files are those once comments, names and texture references are gone.
"""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import TYPE_CHECKING

from voxtool.errors import MeshError, count_of, shown

if TYPE_CHECKING:
    from collections.abc import Iterator

NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
PLAIN_OBJ = re.compile(rb"(?:(?:v(?: +" + NUMBER + rb"){3}|f(?: +[1-9]\d{0,9}){3}|) *\r?\n)*+")
COORDINATE = re.compile(NUMBER)
NOT_FINITE = re.compile(rb"(?i)[-+]?(?:nan|inf|infinity)")
ASIDE = re.compile(rb"^(?:#|v[tnp] |[ogs] |usemtl |mtllib )[^\\\n]*$", re.M)
REFERENCE = re.compile(rb"^([-+]?\d{1,10})(?:/(?:[-+]?\d+)?){0,2}$")


def plain(data: bytes) -> bytes:
    """The v and f lines of an OBJ without oddities, as they stand; b"" if it has some."""
    if b"#" in data or re.search(rb"^[a-eg-uw-z]|^v[tnp]", data, re.M):
        data = ASIDE.sub(b"", data)
    if b"/" in data and not re.search(rb"^v[^\n]*/", data, re.M):
        data = re.sub(rb"(?<=\d)/-?\d*(?:/-?\d*)?(?=\s)", b"", data)
    if not data.endswith(b"\n"):
        data += b"\n"
    match = PLAIN_OBJ.match(data)
    return data if match and match.end() == len(data) else b""


def _statements(data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Line number and words of each statement; a backslash continues a line."""
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


def rewritten(name: str, data: bytes) -> bytes:
    """The OBJ as `v x y z` and `f a b c` lines alone: indices absolute, polygons as fans.

    Raises
    ------
    MeshError : a line cannot be understood; names it.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    total = len(re.findall(rb"^[ \t]*v[ \t]", data, re.M))
    lines, known, line, corners = [], 0, 0, [0] * 3
    try:
        for line, words in _statements(data):  # noqa: B007 (for the message)
            corners = [0] * 3
            if words[:1] == [b"v"]:
                known += 1
                lines.append(_vertex(words[1:4]))
            elif words[:1] == [b"f"]:
                corners = [_index(word, known, total) for word in words[1:]]
                for b, c in pairwise(corners[1:]):
                    lines.append(b"f %d %d %d" % (corners[0], b, c))
        if len(corners) < 3 and not data.endswith((b"\n", b"\r")):
            raise MeshError(
                f"the last face has {count_of(len(corners), 'vertex')}: the file is truncated"
            )
    except MeshError as error:
        raise MeshError(f"{name}, line {line}: {error}") from None
    return b"\n".join(lines) + b"\n"


def _vertex(words: list[bytes]) -> bytes:
    for word in words:
        if not COORDINATE.fullmatch(word) and not NOT_FINITE.fullmatch(word):
            raise MeshError(f"{shown(word)} is not a number: mend the vertex")
        if not math.isfinite(float(word)):
            raise MeshError(f"coordinate {shown(word)} is not finite: mend the vertex")
    if len(words) < 3:
        raise MeshError(
            f"a vertex of {count_of(len(words), 'coordinate')} where 3 are needed: mend it, or the "
            "file is truncated"
        )
    return b"v " + b" ".join(words)


def _index(word: bytes, known: int, total: int) -> int:
    """A vertex of a face, counted from 1; a negative one counts back from its line."""
    match = REFERENCE.match(word)
    if not match:
        raise MeshError(f"{shown(word)} is no vertex of a face: mend it to v, v/vt or v/vt/vn")
    index = int(match[1])
    absolute = index if index >= 0 else known + 1 + index
    if not 1 <= absolute <= total:
        count = f"there are {total}" if index >= 0 else f"{known} stand above"
        raise MeshError(
            f"the face names vertex {index} where {count}, counted from 1: mend the index, or the "
            "file is truncated"
        )
    return absolute
