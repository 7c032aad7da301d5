"""PLY to arrays, binary and as text: the header, the vertices, and the polygons as triangles.

Elements and properties other than the coordinates of vertices and the lists of faces are skipped;
colours of vertices are read where appearance is asked for.
"""

from __future__ import annotations

import io
import re
import struct
from array import array
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np

from voxtool.arrays import float64
from voxtool.errors import FileError, MeshError, printable
from voxtool.files.meshes.placement import Read
from voxtool.files.storage.numbers import (
    Rows,
    blocks_of,
    check_lines,
    fans,
    rows_in,
    triangles_in,
    vertices_in,
)
from voxtool.mesh.appearance import Appearance
from voxtool.mesh.mesh import check_complete, check_promised
from voxtool.mesh.srgb import to_linear

if TYPE_CHECKING:
    from collections.abc import Iterator

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_LINES = 1000
LINE_LIMIT = 1 << 16  # letters
MOST_ALIKE = 255  # corners of faces that are read as records
LISTS = ("vertex_indices", "vertex_index")  # the names that the corners of faces have


class Property(NamedTuple):
    """A property of an element; `counted` is the type of a list's count, otherwise ""."""

    name: str
    type: str
    counted: str = ""


class Element(NamedTuple):
    """An element of a PLY file."""

    name: str
    count: int
    properties: list[Property]

    def record(self, order: str, fault: str) -> np.dtype:
        """Return the structured type of one element; FileError(fault) if a property is a list."""
        if any(one.counted for one in self.properties):
            raise FileError(fault)
        return np.dtype([(f"{i}", order + one.type) for i, one in enumerate(self.properties)])

    def axes(self) -> tuple[int, ...]:
        """Return the places of x, y and z among the properties; FileError if each is not there
        once."""
        names = [one.name for one in self.properties]
        for axis in "xyz":
            if names.count(axis) != 1:
                raise FileError(f"its vertices have {names.count(axis)} properties {axis}, not one")
        return tuple(map(names.index, "xyz"))

    def colours(self) -> tuple[int, ...]:
        """Return the places of red, green, blue and, if it is there, alpha; () if one of three is
        not."""
        places = {one.name.removeprefix("diffuse_"): i for i, one in enumerate(self.properties)}
        if not all(name in places for name in ("red", "green", "blue")):
            return ()
        return tuple(places[name] for name in ("red", "green", "blue", "alpha") if name in places)


LISTED_VERTEX = "its vertices have a list among their properties: leave it out"


def read_header(file: BinaryIO) -> tuple[str, list[Element], int, int]:
    """Return the format, the elements, and the number of lines and bytes of the header.

    Raises
    ------
    FileError : no PLY header; the message names the line.
    """
    line = file.readline(LINE_LIMIT)
    if line.split() != [b"ply"]:
        raise FileError("is no PLY file: its first line is not ply")
    format, elements, size = "", [], len(line)
    for number in range(2, HEADER_LINES + 1):
        line = file.readline(LINE_LIMIT)
        size += len(line)
        words = line.decode("ascii", "replace").split()
        match words:
            case ["end_header"] if format:
                return format, elements, number, size
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name == "ascii" or name in ORDERS:
                format = name
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(Element(name, int(count), []))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].properties.append(Property(name, TYPES[kind]))
            case ["property", "list", counted, kind, name] if (
                TYPES.get(counted, "f")[0] != "f" and kind in TYPES and elements
            ):
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[counted]))
            case _:
                shown = printable(" ".join(words))[:40]
                raise FileError(f"line {number}: {shown!r} does not belong in a PLY header")
    raise FileError(f"its header has no end within {HEADER_LINES} lines")


def parse(name: str, data: bytes, keep: Sequence[str] = ()) -> Read:
    """Return the mesh of a PLY, with the colours of its vertices as `keep` asks.

    MeshError names the line of a text. Polygons become fans of triangles.
    """
    try:
        format, elements, lines, start = read_header(io.BytesIO(data))
        counts = {element.name: element.count for element in reversed(elements)}  # of the first
        wanted = counts.get("vertex", 0), counts.get("face", 0)
        check_promised(name, *wanted, len(data))
        look = "appearance" in keep
        if format == "ascii":
            found = _of_text(name, elements, wanted, data, start, lines + 1, look)
        else:
            found = _of_bytes(name, elements, data, start, ORDERS[format], look)
    except FileError as error:
        raise MeshError(f"{name}: {error}") from None
    vertices, faces, colours = found
    if colours is None:
        return Read(vertices, faces)
    none = np.full(len(faces), -1, np.int32)
    return Read(vertices, faces, appearance=Appearance((), none, None, colours))


def _linear(element: Element, columns: list[np.ndarray]) -> np.ndarray:
    """Return colours in linear light, (V, 4), of channels in sRGB: whole numbers up to the largest
    of their type, others from 0 to 1."""
    found = np.ones((len(columns[0]), 4))
    for channel, (place, column) in enumerate(zip(element.colours(), columns, strict=True)):
        kind = np.dtype(element.properties[place].type)
        shares = float64(column)
        if kind.kind in "iu":
            shares /= np.iinfo(kind).max
        if not ((shares >= 0) & (shares <= 1)).all():
            raise FileError("a colour of its vertices is not from 0 to 1: correct it")
        found[:, channel] = to_linear(shares) if channel < 3 else shares
    return found


def _corners(face: Element) -> int:
    """Return the place of the list of corners among the properties of faces; FileError if there is
    none."""
    lists = [i for i, one in enumerate(face.properties) if one.counted]
    named = [i for i in lists if face.properties[i].name in LISTS]
    if len(named) != 1 and len(lists) != 1:
        raise FileError(f"its faces have {len(named)} lists {LISTS[0]}, not one")
    found = (named or lists)[0]
    if face.properties[found].type.startswith("f"):
        raise FileError("its faces name vertices by numbers that are not whole")
    return found


# ---- text


def _of_text(
    name: str,
    elements: list[Element],
    wanted: tuple[int, int],
    data: bytes,
    start: int,
    line: int,
    look: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the vertices, the faces and, if `look`, the colours of a text from `start` on, where
    line `line` begins; MeshError for fewer than `wanted`."""
    check_lines(name, data)
    colours: list[np.ndarray] = []
    points, corners, vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0, 0
    done = 0
    for block in blocks_of(data, start):
        rows = rows_in(name, block, line)
        for element, begin, end in _spans(elements, done, len(rows.first)):
            part = rows.part(begin, end)
            if element.name == "vertex":
                element.record("", LISTED_VERTEX)
                points.append(vertices_in(name, part, element.axes()))
                if look and (places := element.colours()):
                    channels = vertices_in(name, part, places).T
                    colours.append(_linear(element, list(channels)))
                vertices += end - begin
            elif element.name == "face":
                corners.append(triangles_in(name, wanted[0], _from_list(name, element, part)))
                faces += end - begin
        done += len(rows.first)
        line += block.count(b"\n")
    check_complete(name, (vertices, faces), wanted)
    whole = np.concatenate(colours) if colours else None
    return np.concatenate(points), np.concatenate(corners), whole


def _spans(elements: list[Element], done: int, rows: int) -> Iterator[tuple[Element, int, int]]:
    """Yield the elements of a block of rows after `done` others, and the rows that each has."""
    begin, seen = -done, set()
    for element in elements:
        end = begin + element.count
        first, last = max(begin, 0), min(end, rows)
        if first < last and element.name not in seen:  # the first of a name counts
            yield element, first, last
        seen.add(element.name)
        begin = end


def _from_list(name: str, face: Element, rows: Rows) -> Rows:
    """Return the rows of faces from the list of corners on, without the properties before it."""
    for one in face.properties[: _corners(face)]:
        passed = 1 + rows.numbers[rows.first] if one.counted else np.ones(len(rows.first))
        fits = (passed >= 1) & (passed < rows.counts) & (passed == np.floor(passed))
        short = np.flatnonzero(~fits)
        if len(short):
            raise MeshError(
                f"{name}, line {rows.lines[short[0]]}: the face ends before its list of vertices: "
                "correct it, or the file is truncated"
            )
        passed = passed.astype(np.int64)
        rows = Rows(rows.numbers, rows.first + passed, rows.counts - passed, rows.lines)
    return rows


# ---- bytes


def _of_bytes(
    name: str, elements: list[Element], data: bytes, start: int, order: str, look: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the vertices, the faces and, if `look`, the colours of binary data from `start` on."""
    colours: np.ndarray | None = None
    points: np.ndarray | None = None
    corners: np.ndarray | None = None
    needed = {element.name for element in elements} & {"vertex", "face"}
    for element in elements:
        if element.name == "vertex" and points is None:
            record = element.record(order, LISTED_VERTEX)
            axes = element.axes()
            _check_end(name, element, start + element.count * record.itemsize, data)
            rows = np.frombuffer(data, record, element.count, start)
            points = np.empty((element.count, 3))
            for axis, place in enumerate(axes):
                points[:, axis] = float64(rows[f"{place}"])
            if look and (places := element.colours()):
                colours = _linear(element, [rows[f"{place}"] for place in places])
            start += element.count * record.itemsize
            needed.discard("vertex")
        elif element.name == "face" and corners is None:
            corners, start = _polygons(name, element, data, start, order)
            needed.discard("face")
        elif needed:
            _, _, start = _lists(name, element, data, start, order, None)
        if not needed:
            break
    none = np.empty((0, 3))
    points = none if points is None else points
    return points, none.astype(int) if corners is None else corners, colours


def _check_end(name: str, element: Element, end: int, data: bytes) -> None:
    if end > len(data):
        raise MeshError(
            f"{name}: its {element.count:,} {printable(element.name)[:40]} rows end beyond its "
            f"{len(data):,} bytes: the file is truncated"
        )


def _polygons(
    name: str, face: Element, data: bytes, start: int, order: str
) -> tuple[np.ndarray, int]:
    """Return the (F, 3) triangles of the faces that begin at `start`, and where they end."""
    which = _corners(face)
    alike = _alike(face, data, start, order)
    if alike is not None:
        end = start + face.count * alike.itemsize
        corners = np.frombuffer(data, alike, face.count, start)[f"{which}"]
        if corners.shape[1] == 3:
            return corners.astype(np.int64), end
        first = corners.shape[1] * np.arange(face.count)
        counts = np.full(face.count, corners.shape[1])
        return fans(corners.astype(np.int64).ravel(), first, counts), end
    begins, counts, end = _lists(name, face, data, start, order, which)
    return _fans_at(data, np.dtype(order + face.properties[which].type), begins, counts), end


def _alike(face: Element, data: bytes, start: int, order: str) -> np.dtype | None:
    """Return the structured type of faces whose lists are all as long as the first face's, or
    None; property i is field i, and its count field ci."""
    fields: list[Any] = []
    for i, one in enumerate(face.properties):
        if one.counted:
            at = start + np.dtype(fields).itemsize
            count = np.dtype(order + one.counted)
            if at + count.itemsize > len(data):
                return None
            length = int(np.frombuffer(data, count, 1, at)[0])
            if not 0 <= length <= MOST_ALIKE:
                return None
            fields += [(f"c{i}", count), (f"{i}", order + one.type, (length,))]
        else:
            fields.append((f"{i}", order + one.type))
    record = np.dtype(fields)
    if start + face.count * record.itemsize > len(data) or not face.count:
        return None
    rows = np.frombuffer(data, record, face.count, start)
    same = all((rows[c] == rows[c][0]).all() for c, *_ in fields if c.startswith("c"))
    return record if same else None


def _lists(
    name: str, element: Element, data: bytes, start: int, order: str, which: int | None
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return where list `which` of each row begins in the data, how many numbers it has, (n,) int64
    each, and where the rows end."""
    begins, counts = array("q"), array("q")
    steps, fixed = [], 0  # bytes before a list, its count, the bytes of an item, and if it is asked
    for i, one in enumerate(element.properties):
        if one.counted:
            count = struct.Struct(order + np.dtype(one.counted).char)
            steps.append((fixed, count, np.dtype(one.type).itemsize, i == which))
            fixed = 0
        else:
            fixed += np.dtype(one.type).itemsize
    if not steps:
        end = start + element.count * fixed
        _check_end(name, element, end, data)
        return np.array(begins), np.array(counts), end
    at = start
    for _ in range(element.count):
        for before, count, size, asked in steps:
            at += before
            _check_end(name, element, at + count.size, data)
            length = int(count.unpack_from(data, at)[0])
            at += count.size
            if asked:
                begins.append(at)
                counts.append(length)
            at += max(length, 0) * size
        at += fixed
    _check_end(name, element, at, data)
    return np.array(begins, np.int64), np.array(counts, np.int64), at


def _fans_at(data: bytes, dtype: np.dtype, begins: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the polygons that begin at places in the data as fans of triangles, (F, 3) int64."""
    counts = np.maximum(counts, 0)
    first = np.cumsum(counts) - counts
    places = np.repeat(begins - dtype.itemsize * first, counts)
    places += dtype.itemsize * np.arange(len(places))
    corners = np.empty(len(places), np.int64)
    for rest in range(dtype.itemsize):
        some = places % dtype.itemsize == rest
        whole = np.frombuffer(data, dtype, (len(data) - rest) // dtype.itemsize, rest)
        corners[some] = whole[places[some] // dtype.itemsize]
    return fans(corners, first, counts)
