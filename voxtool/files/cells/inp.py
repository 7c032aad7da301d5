"""Hexahedra as an input file of Abaqus, .inp, which CalculiX reads, too; text.

An element set is a material. A surface is made of sets of the elements that have a face in it, one
for each number of that face: X_S6 is a set of surface X, whose faces are number 6 of their
elements. Nodes that hang are the set `hanging`; an equation ties each of their three displacements
to those of the masters. Lines have columns of fixed width. A coordinate is the shortest text that
reads back exactly, or where that has more than the 20 letters that the format allows, as many
digits as these hold.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from voxtool.files.storage.digits import text_of, width_of
from voxtool.files.storage.sections import Part, begin, size_of
from voxtool.svo.solvers.hexahedra import BOUNDARY, SIDES, Hexahedra, Key, Numbering
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra

# Faces of C3D8, by SIDES: 1 has its nodes 1 2 3 4, 2 has 5 8 7 6, 3 has 1 5 6 2, and so on.
FACES = ("S6", "S4", "S3", "S5", "S1", "S2")
LETTERS = 20  # of a number, at most
TERMS = 12  # numbers of a line of an equation, at most: three a term
HANGING = "hanging"  # the set of nodes that hang
ROW = 16  # numbers of a line of a set


def size(mesh: Hexahedra) -> int:
    """Return the bytes of the file."""
    return size_of(_parts(mesh))


def _width(mesh: Hexahedra) -> int:
    """Return the letters that the number of a node or an element takes."""
    return width_of(max(mesh.sizes.nodes, mesh.sizes.cells))


def _sets(mesh: Hexahedra) -> dict[Key, str]:
    """Return the names of the element sets of the parts of surfaces."""
    return {
        key: f"{own.name}_{FACES[key.side]}"
        for own in mesh.surfaces
        for key in own.parts
        if key in mesh.sizes.faces
    }


def _parts(mesh: Hexahedra) -> list[Part]:
    number, sets = _width(mesh) + 1, _sets(mesh)
    columns = sum(text.itemsize + 1 for text in _coordinates(mesh))
    unit = f", in {mesh.image.units}" if mesh.image.units else ""
    parts: list[Part] = [
        f"*HEADING\n{mesh.text}{unit}\n*NODE\n".encode(),
        ("nodes", mesh.sizes.nodes * (number + columns)),
    ]
    for material, count in mesh.sizes.materials.items():
        head = f"*ELEMENT, TYPE=C3D8, ELSET={mesh.materials[material]}\n"
        parts += [head.encode(), (material, count * 9 * number)]
    for key, name in sets.items():
        head = f"*ELSET, ELSET={name}\n"
        parts += [head.encode(), (key, mesh.sizes.faces[key] * number)]
    surfaces = [(own.name, own.parts) for own in mesh.surfaces]
    every = tuple(key for own in mesh.surfaces[: len(SIDES)] for key in own.parts)
    for name, keys in (*surfaces, (BOUNDARY, every)):
        rows = "".join(f"{sets[key]}, {FACES[key.side]}\n" for key in keys if key in sets)
        parts.append(f"*SURFACE, TYPE=ELEMENT, NAME={name}\n{rows}".encode())
    if isinstance(mesh, LeafHexahedra) and len(mesh.hanging.nodes):
        parts += [b"*NSET, NSET=hanging\n", (HANGING, len(mesh.hanging.nodes) * number)]
        parts.append(b"*EQUATION\n")
        for terms, chosen in _equations(mesh):
            size = _equation(mesh, terms, chosen[:1], 1).nbytes
            parts.append((f"{terms}", 3 * size * len(chosen)))
    return parts


def _equations(mesh: LeafHexahedra) -> list[tuple[int, np.ndarray]]:
    """Return the number of terms of equations, and the places of the nodes that hang and have
    them, those on edges first."""
    masters = np.count_nonzero(mesh.hanging.masters >= 0, axis=1)
    found = [(1 + n, np.flatnonzero(masters == n)) for n in (2, 4)]
    return [(terms, chosen) for terms, chosen in found if len(chosen)]


def _equation(mesh: LeafHexahedra, terms: int, chosen: np.ndarray, along: int) -> np.ndarray:
    """Return the lines of equations for a direction, 1 to 3: that a node moves as its masters."""
    nodes, masters, weights = mesh.hanging
    width, direction = _width(mesh), np.full(len(chosen), f"{along}".encode())
    values, places = np.unique(weights, return_inverse=True)
    texts = [_text(-value) for value in values.tolist()]
    letters = max(map(len, texts))
    column = np.array([text.rjust(letters).encode() for text in texts])
    places = places.reshape(weights.shape)
    one = np.full(len(chosen), b"1.0")
    columns = [text_of(nodes[chosen] + 1, width), direction, one]
    for n in range(terms - 1):
        number = text_of(masters[chosen, n] + 1, width)
        columns += [number, direction, column[places[chosen, n]]]
    head = np.full(len(chosen), f"{terms}\n".encode())
    parts = [head, _lines(*columns[:TERMS]), *([_lines(*columns[TERMS:])] if terms > 4 else [])]
    lines = np.empty(len(chosen), [(f"{n}", part.dtype) for n, part in enumerate(parts)])
    for n, part in enumerate(parts):
        lines[f"{n}"] = part
    return lines


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
    axes, numbers = _coordinates(mesh), Numbering(mesh.sizes, 1)
    lists = {key: _Numbers(count) for key, count in mesh.sizes.faces.items()}

    def numbered(first: int, count: int) -> np.ndarray:
        return text_of(np.arange(first + 1, first + 1 + count), width)

    for layer in mesh.layers():
        for x, first, y, z in layer.nodes():
            xs = np.broadcast_to(axes[0][x], len(y))
            columns = (numbered(first, len(y)), xs, axes[1][y], axes[2][z])
            sections["nodes"].write(_lines(*columns))
        own = text_of(numbers.of(layer), width)
        lines = _lines(own, *layer.at_corners(numbered))
        for material, cells in layer.materials():
            sections[material].write(lines[cells])
        for key, cells in layer.faces:
            sections[key].write(lists[key].rows(own[cells]))

    if isinstance(mesh, LeafHexahedra) and len(mesh.hanging.nodes):
        hanging = _Numbers(len(mesh.hanging.nodes))
        sections[HANGING].write(hanging.rows(text_of(mesh.hanging.nodes + 1, width)))
        for terms, chosen in _equations(mesh):
            for along in (1, 2, 3):
                sections[f"{terms}"].write(_equation(mesh, terms, chosen, along))


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
