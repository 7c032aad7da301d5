"""Caps: triangles that close the holes of a mesh.

The boundary of a mesh, as a chain, is its edges with the number of faces that run along each one
way, less those that run along it the other way; where every edge has two faces that agree there is
none. As much of it begins in every vertex as ends there: it is made of loops, and a cone from any
point closes each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import edges_of, positions


@dataclass(frozen=True)
class Caps:
    """The boundary of a mesh, hole by hole, and what closes it.

    A hole is a simple loop, and its cap a fan from one of its vertices.

    loops : (E,) int32 vertices, loop after loop; first : (H + 1,) where each loop begins.
    faces : (C, 3) int32 triangles of the caps, two less than vertices of each loop.
    most : how often the edge counts that counts most; 1 if there is none.
    """

    loops: np.ndarray
    first: np.ndarray
    faces: np.ndarray
    most: int

    @property
    def holes(self) -> int:
        """The number of loops."""
        return len(self.first) - 1

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) int32 vertices of the boundary's edges, loop after loop."""
        ends = np.arange(1, len(self.loops) + 1)
        ends[self.first[1:] - 1] = self.first[:-1]
        return np.stack([self.loops, self.loops[ends]], axis=1)


def find_caps(vertices: np.ndarray, faces: np.ndarray) -> Caps:
    """The boundary of a mesh on a lattice, and its caps.

    Parameters
    ----------
    vertices : (V, 3) int32; those at equal places are one.
    faces : (F, 3) int32; degenerate ones too.
    """
    places = positions(Mesh(vertices.astype(np.float64), faces))
    vertex = np.empty(int(places.max(initial=-1)) + 1, np.int32)  # one of each place
    vertex[places] = np.arange(len(places))
    corners = places[faces]
    edge, forward = edges_of(corners)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    way = np.where(start == end, 0, np.where(forward, 1, -1))
    net = np.bincount(edge, way).astype(np.int64)
    side = np.empty(len(net), np.int64)
    side[edge] = np.arange(len(edge))  # any side of each edge
    side, net = side[net != 0], net[net != 0]
    turned = (net > 0) != forward[side]
    start, end = np.where(turned, [end[side], start[side]], [start[side], end[side]])
    start, end = (np.repeat(each, np.abs(net)) for each in (start, end))
    loops = _loops(start, end, vertices[vertex].astype(np.int64))
    first = np.concatenate([[0], np.cumsum([len(loop) for loop in loops])]).astype(np.int64)
    places_of_loops = np.fromiter(chain.from_iterable(loops), np.int64, int(first[-1]))
    within = np.arange(len(places_of_loops)) - np.repeat(first[:-1], np.diff(first))
    fan = np.flatnonzero(within >= 2)
    apex = fan - within[fan]
    corners = places_of_loops[np.stack([apex, fan, fan - 1], axis=1)]
    most = int(np.abs(net).max(initial=1))
    return Caps(vertex[places_of_loops], first, vertex[corners], most)


def _loops(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> list[list[int]]:
    """Simple loops of edges, of which as many begin in every vertex as end there. Where loops meet,
    a walk goes on to the vertex nearest to the one it comes from, so that they are small."""
    ahead: dict[int, list[int]] = {}
    for u, v in zip(start.tolist(), end.tolist(), strict=True):
        ahead.setdefault(u, []).append(v)
    loops = []
    for first in ahead:
        path, place = [first], {first: 0}
        while ways := ahead[path[-1]]:
            if len(ways) > 1 and len(path) > 1:
                apart = points[ways] - points[path[-2]]
                vertex = ways.pop(int(np.argmin((apart * apart).sum(axis=1))))
            else:
                vertex = ways.pop()
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
