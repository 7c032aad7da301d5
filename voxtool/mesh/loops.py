"""The boundary of a mesh as loops: where its holes are, how long they are, and tubes to see them.

The boundary are the edges of exactly one face, by positions. Where a vertex has more than two of
them, as at the middle of a bow tie, a loop goes on along the same fan of faces, so loops that touch
stay apart, and no loop depends on the order of the faces. Only where a fan ends at an edge of more
than two faces is there no such way on: what ends there is joined in pairs, as it comes, and what is
left over makes a chain that does not close.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import Topology, fans_of, next_sides
from voxtool.vector import cross, length, unit

# Corners of a unit triangle in the plane across a segment; the root of 3/4 is given.
ACROSS = ((1.0, 0.0), (-0.5, 0.8660254037844386), (-0.5, -0.8660254037844386))
PRISM = np.array(
    [
        (0, 1, 4), (0, 4, 3),  # sides
        (1, 2, 5), (1, 5, 4),
        (2, 0, 3), (2, 3, 5),
        (0, 2, 1), (3, 4, 5),  # ends
    ],
    np.int32,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Loops:
    """The loops of a boundary, the longest first.

    starts : (L + 1,) int64: where the edges of each loop begin; the last is the number of edges.
    edges : (E, 2) int64 vertices of each edge, in the order of the loop, along its face.
    faces : (E,) int64: the face of each edge.
    closed : (L,) bool: it ends where it begins.
    lengths : (L,) float64, world units.
    low, high : (L, 3) float64: boxes of the loops, world units.
    """

    starts: np.ndarray
    edges: np.ndarray
    faces: np.ndarray
    closed: np.ndarray
    lengths: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """(L,) int64: edges of each loop."""
        return np.diff(self.starts)


def find_loops(mesh: Mesh, topology: Topology) -> Loops:
    """The boundary loops of a mesh.

    Parameters
    ----------
    topology : of the mesh, as topology_of.
    """
    sides = np.flatnonzero(topology.count[topology.edge] == 1)
    ends = np.stack([sides, next_sides(sides)], axis=1)  # corners; end 2 e + i is of edge e
    fan = fans_of(topology)[ends].ravel()
    order, starts, closed = _traced(_partners(fan, topology.corners.ravel()[ends].ravel()))
    proper = np.flatnonzero(topology.proper)
    edges = mesh.faces[proper].astype(np.int64).ravel()[ends[order]]

    loop = np.repeat(np.arange(len(closed)), np.diff(starts))
    points = mesh.vertices[edges] + 0.0
    lengths = np.bincount(loop, length(points[:, 1] - points[:, 0]), len(closed))
    low, high = np.full((len(closed), 3), np.inf), np.full((len(closed), 3), -np.inf)
    np.minimum.at(low, loop, points.min(axis=1))
    np.maximum.at(high, loop, points.max(axis=1))

    longest = np.argsort(-lengths, kind="stable")
    at = np.argsort(np.argsort(longest)[loop], kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.diff(starts)[longest])])
    return Loops(
        starts, edges[at], proper[sides[order[at]] // 3], closed[longest],
        lengths[longest].astype(np.float64),
        low[longest], high[longest],
    )  # fmt: skip


def _partners(fan: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(2E,) int64: the end that follows each end of an edge, or -1: that of the same fan; else
    another at the same place."""
    partner = _paired(fan)
    left = np.flatnonzero(partner < 0)
    more = _paired(place[left])
    partner[left[more >= 0]] = left[more[more >= 0]]
    return partner


def _paired(keys: np.ndarray) -> np.ndarray:
    """(n,) int64: another number of an equal key, two by two, or -1."""
    order = np.argsort(keys, kind="stable")
    numbers = np.arange(len(keys))
    first = np.searchsorted(keys[order], keys[order])
    second = (numbers - first) % 2 == 1
    one, other = order[:-1][second[1:]], order[second]
    partner = np.full(len(keys), -1)
    partner[one], partner[other] = other, one
    return partner


def _traced(partner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edges in order; where loops begin among them; and which close. Chains come first."""
    following, seen = partner.tolist(), bytearray(len(partner) // 2)
    order: list[int] = []
    starts, closed = [0], []
    for first in [*np.flatnonzero(partner < 0).tolist(), *range(0, len(partner), 2)]:
        if seen[first >> 1]:
            continue
        end = first
        while end >= 0 and not seen[end >> 1]:
            seen[end >> 1] = 1
            order.append(end >> 1)
            end = following[end ^ 1]
        starts.append(len(order))
        closed.append(end >= 0)
    return np.array(order, np.int64), np.array(starts), np.array(closed, bool)


def tubes(points: np.ndarray, radius: float) -> Mesh:
    """A mesh to look at: a triangular prism about each segment, closed and facing outward.

    Parameters
    ----------
    points : (E, 2, 3) float64: the ends of each segment, which differ.
    radius : from the segment to the corners of a prism, world units.

    Returns
    -------
    Mesh of 6 E vertices and 8 E faces.
    """
    begin, end = points[:, 0], points[:, 1]
    along = unit(end - begin)
    least = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    u = unit(cross(along, least))
    v = cross(along, u)
    ring = radius * np.stack([a * u + b * v for a, b in ACROSS], axis=1)
    vertices = np.concatenate([begin[:, None] + ring, end[:, None] + ring], axis=1)
    faces = PRISM + 6 * np.arange(len(points), dtype=np.int32)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))
