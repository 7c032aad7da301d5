"""Cells of any kind split into tetrahedra whose faces match across cells.

A quadrilateral that two cells share is cut along the diagonal from its smallest vertex number, so
both cells cut it alike [Dompierre 1999].
"""

from __future__ import annotations

import numpy as np

from voxtool.tets.mesh import CELL_FACES


def split(kind: str, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra of cells, (N, 4) int64, and the number of each one's cell; those that would name
    a vertex twice are left out.

    A cell is the cone from its smallest vertex over the faces that do not have it.
    """
    if kind == "tetra":
        whole = np.flatnonzero(~repeats(block))
        return block[whole], whole
    quads = [face for face in CELL_FACES[kind] if len(face) == 4]
    code = block.argmin(axis=1)
    for face in quads:
        code = 2 * code + block[:, face].argmin(axis=1) % 2
    pieces, sources = [], []
    for value in np.unique(code).tolist():
        cuts = {face: value >> (len(quads) - 1 - i) & 1 for i, face in enumerate(quads)}
        template = _template(kind, value >> len(quads), cuts)
        cells = np.flatnonzero(code == value)
        pieces.append(block[cells][:, template].reshape(-1, 4))
        sources.append(np.repeat(cells, len(template)))
    cells, source = np.concatenate(pieces), np.concatenate(sources)
    order = np.argsort(source, kind="stable")
    order = order[~repeats(cells[order])]
    return cells[order], source[order]


def _template(
    kind: str, apex: int, cuts: dict[tuple[int, ...], int]
) -> list[tuple[int, int, int, int]]:
    """The tetrahedra of a cell whose smallest vertex is `apex`; of each quadrilateral, whether it
    is cut from its first vertex (0) or from its second (1)."""
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
    # no diagonal from the far vertex, so it can be cut off whole: five tetrahedra do
    after = {}
    for triangle in around:
        i = triangle.index(far)
        after[triangle[(i + 1) % 3]] = triangle[(i + 2) % 3]
    a = min(after)
    b, c = after[a], after[after[a]]
    others = [(apex, *triangle) for triangle in triangles if far not in triangle]
    return [*others, (apex, a, b, c), (far, a, c, b)]


def repeats(cells: np.ndarray) -> np.ndarray:
    """(N,) bool: cells that name a vertex twice."""
    ordered = np.sort(cells, axis=1)
    return (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
