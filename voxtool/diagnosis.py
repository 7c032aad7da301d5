"""What is wrong with a mesh: open edges, shells, faces that may surprise.

By positions: vertices that are bit-equal (-0.0 is 0.0) are one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from voxtool.errors import count_of
from voxtool.mesh import Mesh


@dataclass(frozen=True)
class Diagnosis:
    """What a mesh is, by positions: vertices that are bit-equal are one.

    Faces that name a position twice bound nothing: they count in `faces` and `degenerate_faces`
    alone. An edge is a pair of positions.

    faces, vertices : as in the file.
    closed : there are edges, and every one is used an even number of times.
    even : every edge is used an even number of times, which is what parity filling needs.
    boundary_edges : edges of exactly one face.
    nonmanifold_edges : edges of more than two faces.
    inconsistent_edges : edges of exactly two faces that both run along it in one direction.
    duplicate_faces : faces on the same three positions as one before, in any order.
    degenerate_faces : faces of zero area: a position named twice, or three on a line (exactly).
    shells : groups of faces connected through shared edges.
    euler : V - E + F of the positions, edges and faces.
    """

    faces: int
    vertices: int
    closed: bool
    even: bool
    boundary_edges: int
    nonmanifold_edges: int
    inconsistent_edges: int
    duplicate_faces: int
    degenerate_faces: int
    shells: int
    euler: int

    def as_dict(self) -> dict[str, int | bool]:
        """The fields by name, of JSON types."""
        return asdict(self)

    def summary(self) -> str:
        """One line: "not closed: 223 boundary edges, 0 non-manifold edges, ..."."""
        counts = (
            count_of(self.boundary_edges, "boundary edge"),
            count_of(self.nonmanifold_edges, "non-manifold edge"),
            count_of(self.inconsistent_edges, "inconsistent edge"),
            count_of(self.duplicate_faces, "duplicate face"),
            count_of(self.degenerate_faces, "degenerate face"),
            count_of(self.shells, "shell"),
            f"Euler characteristic {self.euler}",
        )
        return f"{'closed' if self.closed else 'not closed'}: {', '.join(counts)}"


def diagnose(mesh: Mesh) -> Diagnosis:
    """Describe a mesh: open edges, shells, and what else may surprise.

    Parameters
    ----------
    mesh : any mesh; faces may be degenerate.
    """
    corners = _positions(mesh)[mesh.faces]
    a, b, c = corners.T
    proper = (a != b) & (b != c) & (c != a)
    corners = corners[proper]
    flat = _collinear(mesh.vertices[mesh.faces[proper]])
    edge, forward = _edges(corners)
    count = np.bincount(edge)
    along = np.bincount(edge, weights=forward)
    even = not (count % 2).any()
    return Diagnosis(
        faces=len(mesh.faces),
        vertices=len(mesh.vertices),
        closed=even and len(count) > 0,
        even=even,
        boundary_edges=int(np.count_nonzero(count == 1)),
        nonmanifold_edges=int(np.count_nonzero(count > 2)),
        inconsistent_edges=int(np.count_nonzero((count == 2) & (along != 1))),
        duplicate_faces=len(corners) - _distinct(np.sort(corners, axis=1)),
        degenerate_faces=int(np.count_nonzero(~proper) + np.count_nonzero(flat)),
        shells=_shells(edge, len(corners)),
        euler=len(np.unique(corners)) - len(count) + len(corners),
    )


def _positions(mesh: Mesh) -> np.ndarray:
    """(V,) int64: equal numbers for vertices of bit-equal positions."""
    points = mesh.vertices + 0.0  # -0.0 is 0.0
    order = np.lexsort(points.T)
    new = np.ones(len(points), np.int64)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    numbers = np.empty_like(new)
    numbers[order] = np.cumsum(new) - 1
    return numbers


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3F,) edge number and (3F,) bool direction of the sides ab, bc, ca of (F, 3) corners."""
    start = corners.ravel()
    end = np.roll(corners, -1, axis=1).ravel()
    key = np.minimum(start, end) << 32 | np.maximum(start, end)
    return np.unique(key, return_inverse=True)[1].reshape(-1), start < end


def _distinct(rows: np.ndarray) -> int:
    rows = rows[np.lexsort(rows.T)]
    return len(rows) and 1 + int(np.count_nonzero((rows[1:] != rows[:-1]).any(axis=1)))


def _shells(edge: np.ndarray, faces: int) -> int:
    """Connected components: every root hooks onto its least neighbour, then all paths collapse."""
    order = np.argsort(edge, kind="stable")
    same = edge[order[1:]] == edge[order[:-1]]
    u, v = order[:-1][same] // 3, order[1:][same] // 3
    root = np.arange(faces)
    while len(u):
        u, v = root[u], root[v]
        apart = u != v
        u, v = u[apart], v[apart]
        np.minimum.at(root, np.maximum(u, v), np.minimum(u, v))
        while not np.array_equal(root, jump := root[root]):
            root = jump
    return int(np.count_nonzero(root == np.arange(faces)))


def _collinear(triangles: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3, 3) of zero area, exactly: float64 with an error bound, and whole
    numbers where that cannot tell."""
    with np.errstate(over="ignore", invalid="ignore"):
        p, q = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
        sure = np.zeros(len(triangles), bool)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            left, right = p[:, i] * q[:, j], p[:, j] * q[:, i]
            sure |= np.abs(left - right) > 2**-50 * (np.abs(left) + np.abs(right)) + 2.0**-1000
    flat = ~sure
    for face in np.flatnonzero(flat):
        ratios = [v.as_integer_ratio() for v in triangles[face].ravel().tolist()]
        unit = max(below for _, below in ratios)  # a power of two
        x = [above * (unit // below) for above, below in ratios]
        p, q = ([x[k + i] - x[i] for i in range(3)] for k in (3, 6))
        flat[face] = all(p[i] * q[j] == p[j] * q[i] for i, j in ((0, 1), (1, 2), (2, 0)))
    return flat
