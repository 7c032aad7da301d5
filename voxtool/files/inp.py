"""Hexahedra as an input file of Abaqus, .inp, which CalculiX reads, too; text.

An element set is a material. A surface is the set of the elements that have a face in it, and the
number of that face: X_S6 is the set of surface X, whose faces are number 6 of their elements. Lines
have columns of fixed width. A coordinate is the shortest text that reads back exactly, or where
that has more than the 20 letters that the format allows, as many digits as these hold.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from voxtool.files.digits import text_of, width_of
from voxtool.files.sections import Part, begin, size_of
from voxtool.svo.hexahedra import BOUNDARY, MATERIAL, SIDES, Hexahedra

# Faces of C3D8, by SIDES: 1 has its nodes 1 2 3 4, 2 has 5 8 7 6, 3 has 1 5 6 2, and so on.
FACES = ("S6", "S4", "S3", "S5", "S1", "S2")
LETTERS = 20  # of a number, at most
ROW = 16  # numbers of a line of a set


def size(mesh: Hexahedra) -> int:
    """Bytes of the file."""
    return size_of(_parts(mesh))


def _width(mesh: Hexahedra) -> int:
    """Letters of a number of a node or an element."""
    return width_of(max(mesh.sizes.nodes, mesh.sizes.cells))


def _sets() -> list[str]:
    """Return the names of the element sets of the surfaces."""
    return [f"{side.name}_{face}" for side, face in zip(SIDES, FACES, strict=True)]


def _parts(mesh: Hexahedra) -> list[Part]:
    nodes, cells, faces, _ = mesh.sizes
    number = _width(mesh) + 1
    columns = sum(text.itemsize + 1 for text in _coordinates(mesh))
    unit = f", in {mesh.image.units}" if mesh.image.units else ""
    parts: list[Part] = [
        f"*HEADING\n{mesh.text}{unit}\n*NODE\n".encode(),
        ("nodes", nodes * (number + columns)),
        f"*ELEMENT, TYPE=C3D8, ELSET={MATERIAL}\n".encode(),
        (MATERIAL, cells * 9 * number),
    ]
    for name, count in zip(_sets(), faces, strict=True):
        parts += [f"*ELSET, ELSET={name}\n".encode(), (name, count * number)]
    rows = [f"{name}, {face}\n" for name, face in zip(_sets(), FACES, strict=True)]
    for name, own in (*((side.name, [row]) for side, row in zip(SIDES, rows, strict=True)),
                      (BOUNDARY, rows)):  # fmt: skip
        parts.append(f"*SURFACE, TYPE=ELEMENT, NAME={name}\n{''.join(own)}".encode())
    return parts


def _coordinates(mesh: Hexahedra) -> list[np.ndarray]:
    """Return the text of the coordinates along each axis, in one width."""
    columns = []
    for values in mesh.coordinates():
        texts = [_text(value) for value in values.tolist()]
        width = max(map(len, texts))
        columns.append(np.array([text.rjust(width).encode() for text in texts]))
    return columns


def _text(value: float) -> str:
    text, digits = repr(value), 17
    while len(text) > LETTERS:
        digits -= 1
        text = f"{value:.{digits}g}"
    return text


def write(mesh: Hexahedra, file: BinaryIO) -> None:
    """Write the mesh."""
    sections, width = begin(file, _parts(mesh)), _width(mesh)
    axes = _coordinates(mesh)
    lists = {name: _Numbers(count) for name, count in zip(_sets(), mesh.sizes.faces, strict=True)}
    texts: dict[int, np.ndarray] = {}  # of the numbers of nodes, by plane
    for layer in mesh.layers():
        for x, first, y, z in layer.nodes():
            texts[x] = text_of(np.arange(first + 1, first + 1 + len(y)), width)
            xs = np.broadcast_to(axes[0][x], len(y))
            sections["nodes"].write(_lines(texts[x], xs, axes[1][y], axes[2][z]))
        texts = {plane.x: texts[plane.x] for plane in (layer.low, layer.high)}
        own = text_of(np.arange(layer.first + 1, layer.first + 1 + len(layer.cells)), width)
        sections[MATERIAL].write(_lines(own, *layer.at_corners(*texts.values())))
        for name, cells in zip(_sets(), layer.faces, strict=True):
            sections[name].write(lists[name].rows(own[cells]))


def _lines(*columns: np.ndarray) -> np.ndarray:
    """Return the lines of a table, with commas between its columns of text."""
    kinds = [(f"{n}{what}", kind) for n, column in enumerate(columns)
             for what, kind in (("", column.dtype), ("end", "S1"))]  # fmt: skip
    lines = np.empty(len(columns[0]), kinds)
    for n, column in enumerate(columns):
        lines[f"{n}"] = column
        lines[f"{n}end"] = b"\n" if n == len(columns) - 1 else b","
    return lines


class _Numbers:
    """A list of numbers, ROW a line, that is written in parts."""

    def __init__(self, count: int) -> None:
        self._count, self._done = count, 0

    def rows(self, texts: np.ndarray) -> np.ndarray:
        """Return the next numbers with what comes behind each of them."""
        found = np.empty(len(texts), [("number", texts.dtype), ("end", "S1")])
        found["number"], found["end"] = texts, b","
        found["end"][ROW - 1 - self._done % ROW :: ROW] = b"\n"
        self._done += len(texts)
        if self._done == self._count and len(texts):
            found["end"][-1] = b"\n"
        return found
