"""Cells: their faces, how they are split into tetrahedra, and which ones share a face.

A quadrilateral that two cells share is cut along the diagonal from its smallest vertex number, so
both cells cut it alike [Dompierre 1999].
"""

from __future__ import annotations

import numpy as np

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


# ---- splitting


def split(kind: str, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra that fill cells, (N, 4) int64, and the number of the cell of each.

    A cell is the cone from its smallest vertex over the faces that do not have this vertex.
    Tetrahedra that would name a vertex twice are left out.
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
    """Return the tetrahedra of a cell whose smallest vertex is `apex`. A quadrilateral is cut from
    its first vertex where `cuts` is 0, and from its second where it is 1."""
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


# ---- faces


def loops(cells: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of faces, (T, F, k), in one order whichever cell has the face: the
    smallest vertex first, then the smaller of its two neighbours on the face. The second array,
    (T, F) bool, says where the cell winds the face the other way."""
    k = faces.shape[1]
    loop = cells[:, faces]
    start = loop.argmin(axis=2)[:, :, None]
    loop = np.take_along_axis(loop, (start + np.arange(k)) % k, axis=2)
    backward = loop[:, :, 1] > loop[:, :, -1]
    loop[backward, 1:] = loop[backward, :0:-1]
    return loop, backward


def match_faces(cells: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, dict[str, int]]:
    """Return the cell across each face, (T, F) int32, -1 where there is none; and counts of faces.

    Two cells are neighbours if no third cell has the face, and they are on opposite sides of it.
    """
    loop, backward = loops(cells, faces)
    loop, side = loop.reshape(-1, faces.shape[1]).astype(np.int64), backward.ravel()
    low = loop[:, 0] << 32 | loop[:, 1]
    high = loop[:, 2] << 32 | loop[:, -1]
    order = np.lexsort((high, low))
    new = np.ones(len(order) + 1, bool)
    new[1:-1] = (low[order[1:]] != low[order[:-1]]) | (high[order[1:]] != high[order[:-1]])
    begin = np.flatnonzero(new)
    count = np.diff(begin)
    pair = begin[:-1][count == 2]
    one, other = order[pair], order[pair + 1]
    folded = side[one] == side[other]
    one, other = one[~folded], other[~folded]
    neighbours = np.full(len(loop), -1, np.int32)
    neighbours[one] = other // len(faces)
    neighbours[other] = one // len(faces)
    counts = {
        "non_manifold_faces": int(np.count_nonzero(count > 2)),
        "folded_faces": int(np.count_nonzero(folded)),
    }
    return neighbours.reshape(-1, len(faces)), counts
