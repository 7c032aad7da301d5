"""Caps: triangles that close the holes of a mesh.

The boundary of a mesh counts, for every edge, the faces that traverse it in one direction minus the
faces that traverse it in the other. The count is 0 for an edge of two consistently wound faces. The
edges that remain form closed loops, because at every vertex as many begin as end. Triangles that
halve each loop, and its halves in turn, close it: most of them are small, so that few are near a
point. (A fan of n triangles about one vertex has n long ones.)
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import net_edges, positions

MEETING = 64  # edges at a vertex among which the nearest is sought


@dataclass(frozen=True)
class Caps:
    """The holes of a mesh and their caps: a hole is a simple loop of boundary edges, and its cap
    consists of triangles between its vertices."""

    loops: np.ndarray  # (E,) int32 vertices, loop after loop
    first: np.ndarray  # (H + 1,) where each loop begins
    faces: np.ndarray  # (C, 3) int32 triangles; a loop of n vertices has n - 2
    most: int  # the largest multiplicity of a boundary edge, at least 1

    @property
    def holes(self) -> int:
        """The number of loops."""
        return len(self.first) - 1

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) int32 vertices of the boundary edges, loop after loop."""
        ends = np.arange(1, len(self.loops) + 1)
        ends[self.first[1:] - 1] = self.first[:-1]
        return np.stack([self.loops, self.loops[ends]], axis=1)


def find_caps(vertices: np.ndarray, boundary: np.ndarray) -> Caps:
    """Return the holes of a mesh on a lattice and their caps. The boundary is given by (n, 2)
    vertices, as net_edges returns it; vertices at one position are merged."""
    used, ends = np.unique(boundary, return_inverse=True)
    points = Mesh(vertices[used].astype(np.float64), np.empty((0, 3), np.int32))
    places = positions(points)
    vertex = np.empty(int(places.max(initial=-1)) + 1, np.int32)  # a vertex at each position
    vertex[places] = used
    edges = net_edges(*places[ends.reshape(-1, 2)].T)
    start, end = edges.T
    changed = (edges[1:] != edges[:-1]).any(axis=1)
    copies = np.diff(np.flatnonzero(np.concatenate([[True], changed, [True]])))
    loops = _loops(start, end, vertices[vertex].astype(np.int64))
    first = np.concatenate([[0], np.cumsum([len(loop) for loop in loops])]).astype(np.int64)
    places_of_loops = np.fromiter(chain.from_iterable(loops), np.int64, int(first[-1]))
    most = int(copies.max(initial=1))
    return Caps(vertex[places_of_loops], first, vertex[places_of_loops[_halve(first)]], most)


def _halve(first: np.ndarray) -> np.ndarray:
    """Return the triangles of the caps of all loops, loop after loop: (C, 3) places in `loops`."""
    low, high, triangles = first[:-1], first[1:] - 1, [np.empty((0, 3), np.int64)]
    while len(low):
        wide = high - low >= 2
        low, high = low[wide], high[wide]
        middle = (low + high) // 2
        triangles.append(np.stack([low, high, middle], axis=1))
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    halves = np.concatenate(triangles)
    return halves[np.argsort(halves[:, 2])]


def _loops(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> list[list[int]]:
    """Return the simple loops of directed edges; at every vertex as many edges begin as end.
    Where loops meet, the walk continues to the vertex nearest to the previous one, which keeps
    loops small; where more than MEETING vertices follow, to the last one, which keeps it fast."""
    ahead: dict[int, list[list[int]]] = {}  # the vertices after a vertex, and how many edges lead
    for u, v in zip(start.tolist(), end.tolist(), strict=True):
        ways = ahead.setdefault(u, [])
        if ways and ways[-1][0] == v:  # copies follow each other
            ways[-1][1] += 1
        else:
            ways.append([v, 1])
    loops = []
    for first in ahead:
        path, place = [first], {first: 0}
        while ways := ahead[path[-1]]:
            chosen = len(ways) - 1
            if 1 < len(ways) <= MEETING and len(path) > 1:
                apart = points[[v for v, _ in ways]] - points[path[-2]]
                chosen = int(np.argmin((apart * apart).sum(axis=1)))
            vertex, left = ways[chosen]
            if left == 1:
                ways.pop(chosen)
            else:
                ways[chosen][1] = left - 1
            if vertex in place:  # a loop is closed
                loop = path[place[vertex] :]
                loops.append(loop)
                del path[place[vertex] + 1 :]
                for passed in loop[1:]:
                    del place[passed]
            else:
                place[vertex] = len(path)
                path.append(vertex)
    return loops
