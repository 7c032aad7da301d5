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
from voxtool.mesh.topology import boundary_of, net_edges
from voxtool.morton import among

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


@dataclass(frozen=True)
class Boundary:
    """The boundary of a mesh: edges that more faces traverse in this direction than in the other.
    One vertex stands for all at its position, always the same.

    edges : (n, 2) vertices, as net_edges returns them.
    alone : (F,) bool, the faces whose three sides are among these edges, each side its own.
    corners : (A, 3) vertices of these faces.
    """

    edges: np.ndarray
    alone: np.ndarray
    corners: np.ndarray


def find_boundary(mesh: Mesh, some: np.ndarray | None = None) -> Boundary:
    """Return the boundary of a mesh, or of `some` of its faces."""
    places = mesh.positions
    vertex = np.empty(len(places), np.int64)  # one at each position
    vertex[places] = np.arange(len(places))
    corners = vertex[places[mesh.faces if some is None else mesh.faces[some]]]
    edges = boundary_of(corners)
    alone = _alone(corners, edges)
    return Boundary(edges, alone, corners[alone])


def _alone(corners: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return Boundary.alone of (F, 3) corners."""
    on_boundary = np.zeros(int(corners.max(initial=0)) + 1, bool)
    on_boundary[edges] = True
    alone = np.asarray(on_boundary[corners].all(axis=1))
    start = corners[alone]
    left = np.sort(edges[:, 0] << 32 | edges[:, 1])
    sides = start << 32 | np.roll(start, -1, axis=1)
    bounding = among(left, sides.ravel()).reshape(-1, 3).all(axis=1)
    alone[alone] = bounding
    sides = sides[bounding].ravel()
    order = np.argsort(sides, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order)) - np.searchsorted(sides[order], sides[order])
    times = np.searchsorted(left, sides, "right") - np.searchsorted(left, sides)
    alone[alone] = (rank < times).reshape(-1, 3).all(axis=1)
    return alone


def find_caps(vertices: np.ndarray, boundary: Boundary) -> Caps:
    """Return the holes of a mesh on a lattice and their caps, those of faces that are alone last;
    vertices at one position are merged."""
    used, ends = np.unique(boundary.edges, return_inverse=True)
    points = Mesh(vertices[used].astype(np.float64), np.empty((0, 3), np.int32))
    places = points.positions
    vertex = np.empty(int(places.max(initial=-1)) + 1, np.int32)  # a vertex at each position
    vertex[places] = used
    edges = net_edges(*places[ends.reshape(-1, 2)].T)
    changed = (edges[1:] != edges[:-1]).any(axis=1)
    copies = np.diff(np.flatnonzero(np.concatenate([[True], changed, [True]])))
    alone = places[np.searchsorted(used, boundary.corners)]
    start, end = edges.T
    if len(alone):  # without their sides
        back = np.roll(alone, -1, axis=1).ravel()
        start, end = net_edges(np.append(start, back), np.append(end, alone.ravel())).T
    loops = _loops(start, end, vertices[vertex].astype(np.int64))
    sizes = np.append([len(loop) for loop in loops], np.full(len(alone), 3))
    first = np.append(0, np.cumsum(sizes)).astype(np.int64)
    in_loops = np.fromiter(chain.from_iterable(loops), np.int64, int(first[len(loops)]))
    around = vertex[np.append(in_loops, alone.ravel())]
    return Caps(around, first, around[_halve(first)], int(copies.max(initial=1)))


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
    """Return the simple loops of directed edges; at every vertex as many edges begin as end, and
    copies of an edge follow each other. Where loops meet, the walk continues to the vertex nearest
    to the previous one, which keeps loops small; where more than MEETING vertices follow, to the
    last one, which keeps it fast."""
    ahead: dict[int, list[int]] = {}  # the vertices after a vertex, one for each edge
    for u, v in zip(start.tolist(), end.tolist(), strict=True):
        ahead.setdefault(u, []).append(v)
    x, y, z = points.T.tolist()

    def nearest(ways: list[int], to: int) -> int:
        """Return which of the ways leads to the vertex nearest to another one."""
        if len(ways) > MEETING and len(set(ways)) > MEETING:
            return -1
        a, b, c = x[to], y[to], z[to]
        apart = [(x[v] - a) ** 2 + (y[v] - b) ** 2 + (z[v] - c) ** 2 for v in ways]
        return apart.index(min(apart))

    loops = []
    place = [-1] * len(points)  # in the path
    for first in ahead:
        path = [first]
        place[first] = 0
        vertex = first
        while ways := ahead[vertex]:
            choose = len(ways) > 1 and len(path) > 1
            vertex = ways.pop(nearest(ways, path[-2]) if choose else -1)
            if place[vertex] < 0:
                place[vertex] = len(path)
                path.append(vertex)
                continue
            loop = path[place[vertex] :]  # it is closed
            loops.append(loop)
            del path[place[vertex] + 1 :]
            for passed in loop[1:]:
                place[passed] = -1
        place[first] = -1
    return loops
