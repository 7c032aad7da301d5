"""Cells: their faces, and how they are split into tetrahedra.

A quadrilateral that two cells share is cut along the diagonal from its smallest vertex number, so
both cells cut it alike [Dompierre 1999].
"""

from __future__ import annotations

from functools import cache

import numpy as np

from voxtool.opencl import program

# The vertices of each face, so that the normal by the right-hand rule points out; VTK's numbers.
TETRAHEDRON_FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
HEXAHEDRON_FACES = (
    (0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 3, 2, 1), (4, 5, 6, 7),
)  # fmt: skip
CELL_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": TETRAHEDRON_FACES,
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": HEXAHEDRON_FACES,
}
CORNERS = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
PIECES = {"tetra": 1, "pyramid": 2, "wedge": 3, "hexahedron": 6}  # tetrahedra of a cell, at most

TEMPLATE = 1 + 4 * 6  # bytes of a template: how many tetrahedra, and four corners each


@cache
def quads(kind: str) -> np.ndarray:
    """Return the corners of the quadrilaterals of a kind of cell, (Q, 4) uint8."""
    faces = [face for face in CELL_FACES[kind] if len(face) == 4]
    return np.array(faces, np.uint8).reshape(-1, 4)


@cache
def templates(kind: str) -> np.ndarray:
    """Return how a kind of cell is split, (codes, TEMPLATE) uint8: the number of tetrahedra and
    their corners.

    A code is the corner with the smallest vertex, followed by a bit for each quadrilateral: 0
    where it is cut from its first corner or its third, 1 otherwise. A cell becomes the cone from
    its smallest vertex over the faces that do not have this vertex.
    """
    count = len(quads(kind))
    table = np.zeros((CORNERS[kind] << count, TEMPLATE), np.uint8)
    for code, row in enumerate(table):
        pieces = _template(kind, code >> count, code)
        row[0] = len(pieces)
        row[1 : 1 + 4 * len(pieces)] = np.ravel(pieces)
    return table


def _template(kind: str, apex: int, code: int) -> list[tuple[int, int, int, int]]:
    """Return the tetrahedra of a cell whose smallest vertex is `apex`."""
    if kind == "tetra":
        return [(0, 1, 2, 3)]
    order = [tuple(face) for face in quads(kind).tolist()]
    cuts = {face: code >> (len(order) - 1 - i) & 1 for i, face in enumerate(order)}
    triangles = []
    for face in CELL_FACES[kind]:
        if apex in face:
            continue
        if len(face) == 4:
            a, b, c, d = face[cuts[face] :] + face[: cuts[face]]
            triangles += [(a, b, c), (a, c, d)]
        else:
            triangles.append(face)
    if kind != "hexahedron":
        return [(apex, *triangle) for triangle in triangles]
    seen = {vertex for face in CELL_FACES[kind] if apex in face for vertex in face}
    (far,) = set(range(8)) - seen
    around = [triangle for triangle in triangles if far in triangle]
    if len(around) > 3:
        return [(apex, *triangle) for triangle in triangles]
    # no diagonal ends at the far vertex, so one tetrahedron cuts it off, of five in all
    after = {}
    for triangle in around:
        i = triangle.index(far)
        after[triangle[(i + 1) % 3]] = triangle[(i + 2) % 3]
    a = min(after)
    b, c = after[a], after[after[a]]
    others = [(apex, *triangle) for triangle in triangles if far not in triangle]
    return [*others, (apex, a, b, c), (far, a, c, b)]


def repeats(cells: np.ndarray) -> np.ndarray:
    """Return which cells name a vertex twice, (N,) bool."""
    ordered = np.sort(cells, axis=1)
    return (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)


def _face_table(name: str, faces: tuple[tuple[int, ...], ...]) -> str:
    corners = ", ".join(str(corner) for face in faces for corner in face)
    return f"__constant uchar {name}[] = {{{corners}}};"


HEADERS = {
    "tets/volume/cells.h": "\n".join(
        (
            program.c_constants(TEMPLATE=TEMPLATE),
            _face_table("TETRAHEDRON_FACES", TETRAHEDRON_FACES),
            _face_table("HEXAHEDRON_FACES", HEXAHEDRON_FACES),
        )
    )
}
