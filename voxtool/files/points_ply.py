"""Points that are the vertices of a PLY file, ascii or binary.

Parsed here, as trimesh loads the whole file, refuses binary files whose polygons differ in size,
and passes over text that is no number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import FileError, printable
from voxtool.files.points_text import LINE_LIMIT, Columns, by_line, cut_short, lines_of

if TYPE_CHECKING:
    from collections.abc import Iterator

RECORD_BYTES = 1 << 26  # of a PLY file's vertices that are in memory at once

PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
PLY_HEADER_LINES = 1000


@dataclass
class _Element:
    """An element of a PLY file; a property that is a list has the type None."""

    name: str
    count: int
    properties: list[tuple[str, str | None]]

    def record(self, order: str, fault: str) -> np.dtype:
        """The structured type of one element; FileError(fault) if a property is a list."""
        if not all(kind for _, kind in self.properties):
            raise FileError(fault)
        return np.dtype([(f"{i}", f"{order}{t}") for i, (_, t) in enumerate(self.properties)])


def read_ply(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    """Yield the vertices of a PLY file, in blocks of (k, 3) float64."""
    format, elements, lines, start = _ply_header(file)
    at = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if at is None:
        raise FileError("has no element vertex: points are its vertices")
    before, vertices = elements[:at], elements[at]
    order = PLY_ORDERS.get(format, "=")
    fault = "its vertices have a list among their properties: leave it out"
    record = vertices.record(order, fault)
    names = [name for name, _ in vertices.properties]
    for axis in "xyz":
        if names.count(axis) != 1:
            raise FileError(f"its vertices have {names.count(axis)} properties {axis}, not one")
    places = tuple(map(names.index, "xyz"))
    if format == "ascii":
        skipped = sum(element.count for element in before)
        rows = islice(lines_of(file, lines + 1), skipped, skipped + vertices.count)
        blocks = by_line(rows, Columns(None, places), block)
    else:
        fault = "a list comes before its vertices: write the vertices first"
        skipped = sum(e.count * e.record(order, fault).itemsize for e in before)
        if size is not None and start + skipped + vertices.count * record.itemsize > size:
            raise cut_short(vertices.count, max(size - start - skipped, 0) // record.itemsize)
        while skipped and (data := file.read(min(skipped, LINE_LIMIT))):
            skipped -= len(data)
        blocks = _by_record(file, record, places, vertices.count, block)
    count = 0
    for points in blocks:
        count += len(points)
        yield points
    if count < vertices.count:
        raise cut_short(vertices.count, count)


def _ply_header(file: BinaryIO) -> tuple[str, list[_Element], int, int]:
    """The format, the elements, and the number of lines and bytes of the header."""
    line = file.readline(LINE_LIMIT)
    if line.split() != [b"ply"]:
        raise FileError("is no PLY file: its first line is not ply")
    format, elements, size = "", [], len(line)
    for number in range(2, PLY_HEADER_LINES + 1):
        line = file.readline(LINE_LIMIT)
        size += len(line)
        words = line.decode("ascii", "replace").split()
        match words:
            case ["end_header"] if format:
                return format, elements, number, size
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name == "ascii" or name in PLY_ORDERS:
                format = name
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(_Element(name, int(count), []))
            case ["property", kind, name] if kind in PLY_TYPES and elements:
                elements[-1].properties.append((name, PLY_TYPES[kind]))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, None))
            case _:
                shown = printable(" ".join(words))[:40]
                raise FileError(f"line {number}: {shown!r} does not belong in a PLY header")
    raise FileError(f"its header has no end within {PLY_HEADER_LINES} lines")


def _by_record(
    file: BinaryIO, record: np.dtype, places: tuple[int, ...], count: int, block: int
) -> Iterator[np.ndarray]:
    """Yield the points of at most `count` records, in blocks."""
    rows = min(block, max(RECORD_BYTES // record.itemsize, 1))
    while count:
        data = file.read(min(rows, count) * record.itemsize)
        records = np.frombuffer(data, record, len(data) // record.itemsize)
        if not len(records):
            return
        count -= len(records)
        yield np.stack([records[f"{place}"].astype(np.float64) for place in places], axis=1)
