"""The boundary loops of a mesh: their positions and lengths, and tubes that show them.

The boundary consists of the edges of exactly one face, by positions. A vertex may have more than
two of them, as the middle of a bow tie. There a loop continues along the same fan of faces, so
loops that touch remain separate and do not depend on the order of the faces. A fan that ends at
an edge of more than two faces has no such continuation: the ends there are joined in pairs in the
order of the edges, and a remaining end makes a chain that does not close.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import Topology, boxes_of, fans_of, next_sides
from voxtool.vector import cross, length, unit

# corners of a unit triangle in the plane perpendicular to a segment
ACROSS = ((1.0, 0.0), (-0.5, 0.8660254037844386), (-0.5, -0.8660254037844386))
WALLS = [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)]  # of a prism
PRISM = np.array([*WALLS, (0, 2, 1), (3, 4, 5)], np.int32)


@dataclass(frozen=True, eq=False)
class Loops:
    """The loops of a boundary, the longest first.

    starts: (L + 1,) int64, the first edge of each loop, and the number of edges; edges: (E, 2)
    int64, the vertices of each edge, in the order of the loop, along its face; faces: (E,) int64,
    the face of each edge; closed: (L,) bool, whether it ends where it starts; lengths: (L,)
    float64, world units; low, high: (L, 3) float64, bounding boxes, world units.
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
    """Return the boundary loops of a mesh, whose topology is that of topology_of."""
    sides = np.flatnonzero(topology.count[topology.edge] == 1)
    ends = np.stack([sides, next_sides(sides)], axis=1)  # corners; end 2 e + i is of edge e
    fan = fans_of(topology)[ends].ravel()
    order, starts, closed = _traced(_partners(fan, topology.corners.ravel()[ends].ravel()))
    proper = np.flatnonzero(topology.proper)
    edges = mesh.faces[proper].astype(np.int64).ravel()[ends[order]]

    loop = np.repeat(np.arange(len(closed)), np.diff(starts))
    points = mesh.vertices[edges] + 0.0
    lengths = np.bincount(loop, length(points[:, 1] - points[:, 0]), len(closed))
    low, high = boxes_of(loop, points, len(closed))

    longest = np.argsort(-lengths, kind="stable")
    at = np.argsort(np.argsort(longest)[loop], kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.diff(starts)[longest])])
    faces = proper[sides[order[at]] // 3]
    lengths, low, high = lengths[longest].astype(np.float64), low[longest], high[longest]
    return Loops(starts, edges[at], faces, closed[longest], lengths, low, high)


def _partners(fan: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the end that follows each end of an edge, (2E,) int64: that of the same fan, otherwise
    another at the same position, otherwise -1."""
    partner = _paired(fan)
    left = np.flatnonzero(partner < 0)
    more = _paired(place[left])
    partner[left[more >= 0]] = left[more[more >= 0]]
    return partner


def _paired(keys: np.ndarray) -> np.ndarray:
    """Return pairs of equal keys: for each key the index of its partner, or -1, (n,) int64."""
    order = np.argsort(keys, kind="stable")
    numbers = np.arange(len(keys))
    first = np.searchsorted(keys[order], keys[order])
    second = (numbers - first) % 2 == 1
    one, other = order[:-1][second[1:]], order[second]
    partner = np.full(len(keys), -1)
    partner[one], partner[other] = other, one
    return partner


def _traced(partner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges in order, the first edge of each loop, and which close; chains are first."""
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
    """Return a mesh that shows (E, 2, 3) segments of nonzero length: a closed triangular prism
    around each, 6 E vertices and 8 E faces. `radius` is from the segment to the corners of a prism.
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
