"""The topology of a mesh: its edges, shells and fans of faces; and its enclosed volume.

Vertices of bit-equal positions (-0.0 is 0.0) count as one; or they are distinguished by index,
for meshes that keep two touching sheets apart.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from voxtool.errors import count_of
from voxtool.mesh.collinear import collinear
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.morton import among
from voxtool.vector import cross, dot


@dataclass(frozen=True)
class TopologyCheck:
    """Counts of a mesh, by positions (vertices of bit-equal positions are one) or by index.

    Faces that name a position twice bound nothing: they count in `faces` and `degenerate_faces`
    alone. An edge is a pair of positions. By index, read "vertex" for "position".

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

    @property
    def watertight(self) -> bool:
        """True if there are edges, and each has exactly two faces, which run along it in opposite
        directions."""
        return self.closed and not (self.nonmanifold_edges or self.inconsistent_edges)

    def as_dict(self) -> dict[str, int | bool | None]:
        """Return the fields by name, of JSON types."""
        return asdict(self)

    def summary(self) -> str:
        """Return one line: "not closed: 223 boundary edges, 0 non-manifold edges, ..."."""
        counts = (
            count_of(self.boundary_edges, "boundary edge"),
            count_of(self.nonmanifold_edges, "non-manifold edge"),
            count_of(self.inconsistent_edges, "inconsistent edge"),
            count_of(self.duplicate_faces, "duplicate face"),
            count_of(self.degenerate_faces, "degenerate face"),
            count_of(self.shells, "shell"),
            f"Euler characteristic {self.euler:,}",
        )
        return f"{'closed' if self.closed else 'not closed'}: {', '.join(counts)}"


@dataclass(frozen=True)
class SurfaceCheck(TopologyCheck):
    """A TopologyCheck that also looks around every vertex: the check of extracted surfaces.

    nonmanifold_vertices : positions whose faces are not one fan, closed or open; the ends of
        non-manifold edges among them.
    """

    nonmanifold_vertices: int

    @property
    def manifold(self) -> bool:
        """True for an oriented 2-manifold, with or without boundary: no non-manifold edge or
        vertex, no inconsistent edge, no duplicate face."""
        faults = self.nonmanifold_edges, self.nonmanifold_vertices, self.inconsistent_edges
        return not (any(faults) or self.duplicate_faces)

    @property
    def genus(self) -> int | None:
        """Handles of all shells together: Euler = 2 shells - 2 genus; None unless the mesh is
        watertight and manifold."""
        if not (self.watertight and self.manifold):
            return None
        return self.shells - self.euler // 2

    def as_dict(self) -> dict[str, int | bool | None]:
        """Return the fields, and what follows from them, by name, of JSON types."""
        derived = {"watertight": self.watertight, "manifold": self.manifold, "genus": self.genus}
        return super().as_dict() | derived

    def summary(self) -> str:
        """Return one line: that of a TopologyCheck, the vertices, and the genus if there is one."""
        vertices = count_of(self.nonmanifold_vertices, "vertex").replace(" ", " non-manifold ")
        genus = "" if self.genus is None else f", genus {self.genus}"
        return f"{super().summary()}, {vertices}{genus}"


def check_topology(mesh: Mesh, *, weld: bool = True) -> TopologyCheck:
    """Return the counts of edges, shells and others of a mesh; weld=False distinguishes vertices by
    index, not by position."""
    return TopologyCheck(**_counts(mesh, topology_of(mesh, weld)))


def watertight(mesh: Mesh) -> bool:
    """Return TopologyCheck.watertight of a mesh, in a fifth of the time."""
    corners = mesh.positions[mesh.faces]
    a, b, c = corners.T
    proper = (a != b) & (b != c) & (c != a)
    start, end = sides_of(corners[proper])
    sides = np.minimum(start, end) << 33 | np.maximum(start, end) << 1 | (start < end)
    sides.sort()
    one, other = sides[::2], sides[1::2]
    return (
        0 < len(one) == len(other)
        and bool((one + 1 == other).all() and (one & 1 == 0).all())
        and bool((one[1:] != one[:-1]).all())
    )


def check_surface(mesh: Mesh, *, weld: bool = True) -> SurfaceCheck:
    """Return the counts of check_topology, and the vertices with more than one fan of faces.

    With weld=False, two cubes that touch in a corner are a manifold if each has its own vertex.
    """
    return surface_counts(mesh, topology_of(mesh, weld))


def surface_counts(mesh: Mesh, topology: Topology) -> SurfaceCheck:
    """Return the counts of check_surface of a mesh whose topology is known."""
    fan = fans_of(topology)
    fans = np.bincount(topology.corners.ravel()[fan == np.arange(len(fan))])
    pinched = int(np.count_nonzero(fans > 1))
    return SurfaceCheck(**_counts(mesh, topology), nonmanifold_vertices=pinched)


def volume(mesh: Mesh) -> float:
    """Return the volume that a closed surface encloses, in cubic world units, positive if its faces
    are counter-clockwise seen from outside; T-junctions are allowed.

    It is the exact sum of the tetrahedra between the faces and the centre of the bounding box, also
    for open surfaces, so it does not depend on the order of the faces.
    """
    if not len(mesh.faces):
        return 0.0
    low, high = mesh.bounds
    triangles = (mesh.vertices - (low + (high - low) / 2))[mesh.faces]
    six = dot(triangles[:, 0], cross(triangles[:, 1], triangles[:, 2]))
    return math.fsum(six.tolist()) / 6


def closed_chain(mesh: Mesh) -> bool:
    """Return whether a surface is closed apart from T-junctions: its boundary, as a chain, is zero.

    Edges in opposite directions between two positions cancel. The remaining edges must be parallel
    to the axes, as between rectangles of different size, and cancel along each line; otherwise the
    surface is open. A surface without faces is closed.
    """
    topology = topology_of(mesh, weld=True)
    edge, forward = topology.edge, topology.forward
    net = 2 * np.bincount(edge, weights=forward) - topology.count
    one = np.empty(len(net), np.int64)
    one[edge] = np.arange(len(edge))  # any side of each edge
    one, net = one[net != 0], net[net != 0]
    net = np.where(forward[one], net, -net)  # along that side
    ends = np.stack([one, next_sides(one)])  # corners
    points = mesh.vertices[mesh.faces[topology.proper].ravel()[ends]]
    along = points[0] != points[1]
    if (np.count_nonzero(along, axis=1) != 1).any():
        return False
    # Segments on a line cancel if as many end at each position as start there. A position and an
    # axis identify the line.
    place = 3 * topology.corners.ravel()[ends] + np.argmax(along, axis=1)
    _, place = np.unique(place, return_inverse=True)
    return not np.bincount(place.ravel(), weights=np.concatenate([-net, net])).any()


def shells_of(mesh: Mesh) -> np.ndarray:
    """Return equal numbers for faces that edges connect, (F,) int64; -1 for faces with fewer than
    three distinct positions."""
    topology = topology_of(mesh, weld=True)
    one, other = topology.pairs // 3
    shells = np.full(len(mesh.faces), -1)
    shells[topology.proper] = components(one, other, len(topology.corners))
    return shells


def repeated_faces(topology: Topology) -> np.ndarray:
    """Return which faces have the same three positions as an earlier one, (F,) bool."""
    repeated = np.zeros(len(topology.proper), bool)
    codes = _mixed(_mixed(np.arange(topology.corners.max(initial=0) + 1, dtype=np.uint64)))
    if _all_differ(codes[topology.corners]):
        return repeated
    corners = np.sort(topology.corners, axis=1)
    order = np.lexsort(corners.T)  # stable: of equal ones the first comes first
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    repeated[np.flatnonzero(topology.proper)[order[1:][same]]] = True
    return repeated


@once
def twins_of(mesh: Mesh) -> np.ndarray | None:
    """Return equal numbers for faces on the same three positions, (F,) int64; None if there are no
    two such faces."""
    points = (mesh.vertices + 0.0).view(np.uint64)  # -0.0 is 0.0
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        code = _mixed(code ^ points[:, axis])
    sums = code[mesh.faces].sum(axis=1)
    ascending = np.sort(sums)
    some = np.flatnonzero(among(ascending[1:][ascending[1:] == ascending[:-1]], sums))
    if not len(some):
        return None
    corners = np.sort(mesh.positions[mesh.faces[some]], axis=1)
    order = np.lexsort(corners.T)  # stable: of equal ones the first comes first
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    if not same.any():
        return None
    numbers = np.arange(len(mesh.faces))
    first = np.flatnonzero(np.concatenate([[True], ~same]))
    numbers[some[order]] = np.repeat(some[order[first]], np.diff(first, append=len(order)))
    return numbers


def _mixed(codes: np.ndarray) -> np.ndarray:
    """Return uint64 codes whose bits depend on many bits of the given ones."""
    codes = codes * np.uint64(0x9E3779B97F4A7C15)
    return codes ^ codes >> np.uint64(32)


def _all_differ(codes: np.ndarray) -> bool:
    """Return whether the sums of (F, 3) codes of corners differ, so that no two faces have the same
    corners in any order."""
    sums = np.sort(codes.sum(axis=1))
    return bool((sums[1:] != sums[:-1]).all())


def merged_faces(mesh: Mesh, *, parity: bool = False) -> np.ndarray | None:
    """Return the first of all faces on the same three positions, (n,) int64, rising; None for all
    faces. With `parity` two of an even number remain, so that rows cross as many, modulo 2."""
    twins = twins_of(mesh)
    if twins is None:
        return None
    order = np.argsort(twins, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order)) - np.searchsorted(twins[order], twins[order])
    even = np.bincount(twins)[twins] % 2 == 0
    return np.flatnonzero(rank < np.where(even & parity, 2, 1))


@once
def net_faces(mesh: Mesh) -> np.ndarray | None:
    """Return the faces that winding numbers count, (n,) int64, ascending; None for all of them.

    Repeated faces, which have the same three positions, are merged. If k faces have one direction
    and m the other, one remains in the direction of the larger number; if this would lengthen the
    boundary of the mesh, |k - m| remain. If k = m, one in each direction remains, which keeps the
    surface. Degenerate faces have no direction, so one of them remains.
    """
    twins = twins_of(mesh)
    if twins is None:
        return None
    corners = mesh.positions[mesh.faces]
    some = np.flatnonzero(np.bincount(twins)[twins] > 1)
    twins, (proper, way) = twins[some], ways_of(corners[some])
    net = np.bincount(twins, way).astype(np.int64)
    net[twins[~proper]] = 1
    order = np.lexsort([way, twins])  # stable
    alike = 2 * twins[order] + (way[order] > 0)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order)) - np.searchsorted(alike, alike)
    net, counted = net[twins], np.ones(len(corners), bool)
    counted[some] = (rank < 1) & (net * way >= 0)
    dropped = np.zeros(len(mesh.positions), bool)
    dropped[corners[~counted]] = True
    near = dropped[corners].any(axis=1)  # the other edges have the same faces as before
    if len(boundary_of(corners[near & counted])) > len(boundary_of(corners[near])):
        counted[some] = (rank < np.maximum(np.abs(net), 1)) & (net * way >= 0)
    return np.flatnonzero(counted)


def ways_of(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whether (F, 3) positions are distinct, and the direction in which each face names
    them: 1 or -1, opposite for opposite faces; 1 where they are not distinct."""
    a, b, c = corners.T
    proper = (a != b) & (b != c) & (c != a)
    return proper, np.where(proper, 2 * ((a < b) * 1 + (b < c) + (c < a)) - 3, 1)


def boundary_of(corners: np.ndarray) -> np.ndarray:
    """Return net_edges of the sides of (F, 3) corners: the boundary of these faces."""
    return net_edges(*sides_of(corners.astype(np.int64)))


def net_edges(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the (n, 2) directed edges that are left after sides from start to end, (m,) int64
    each, have cancelled those in the opposite direction; an edge left k times appears k times in
    succession."""
    proper = start != end
    start, end = start[proper], end[proper]
    sides = np.minimum(start, end) << 33 | np.maximum(start, end) << 1 | (start < end)
    sides.sort()
    first = np.flatnonzero(np.diff(sides >> 1, prepend=-1))
    net = np.add.reduceat(2 * (sides & 1) - 1, first) if len(first) else first
    left = net != 0
    low, high = sides[first[left]] >> 33, sides[first[left]] >> 1 & 0xFFFFFFFF
    forward = (net[left] > 0)[:, None]
    edges = np.where(forward, np.stack([low, high], axis=1), np.stack([high, low], axis=1))
    return np.repeat(edges, np.abs(net[left]), axis=0)


def crowded_edges(mesh: Mesh, topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n, 2) vertices and (n,) face counts of edges of more than two faces."""
    crowded = topology.count > 2
    sides = np.unique(topology.edge, return_index=True)[1][crowded]
    corners = mesh.faces[topology.proper].astype(np.int64).ravel()
    return corners[np.stack([sides, next_sides(sides)], axis=1)], topology.count[crowded]


# --- topology ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Topology:
    """Faces on three different positions, by their sides: side 3 f + k runs from corner k of face
    f to the next.

    proper : (faces of the mesh,) bool: those faces.
    corners : (F, 3) int64 positions of their corners.
    edge : (3F,) int64 edge of each side; forward : (3F,) bool: it runs to the greater position.
    count : (E,) int64 sides of each edge.
    pairs : (2, P) int64 sides that share an edge: each with the next one there.
    """

    proper: np.ndarray
    corners: np.ndarray
    edge: np.ndarray
    forward: np.ndarray
    count: np.ndarray
    pairs: np.ndarray


def topology_of(mesh: Mesh, weld: bool = True) -> Topology:
    """Return which faces share which edges, by positions; or by index, if weld is False."""
    corners = mesh.positions[mesh.faces] if weld else mesh.faces.astype(np.int64)
    a, b, c = corners.T
    proper = (a != b) & (b != c) & (c != a)
    corners = corners[proper]
    key, forward = edge_keys(*sides_of(corners))
    order = np.argsort(key, kind="stable")
    same = key[order[1:]] == key[order[:-1]]
    edge = np.zeros(len(order), np.int64)
    edge[order[1:]] = np.cumsum(~same)
    pairs = np.stack([order[:-1][same], order[1:][same]])
    return Topology(proper, corners, edge, forward, np.bincount(edge), pairs)


def _counts(mesh: Mesh, topology: Topology) -> dict[str, Any]:
    """Return the fields of a TopologyCheck."""
    corners, count = topology.corners, topology.count
    flat = collinear(mesh.vertices[mesh.faces[topology.proper]])
    along = np.bincount(topology.edge, weights=topology.forward)
    even = not (count % 2).any()
    one, other = topology.pairs // 3
    shells = components(one, other, len(corners))
    return {
        "faces": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "closed": even and len(count) > 0,
        "even": even,
        "boundary_edges": int(np.count_nonzero(count == 1)),
        "nonmanifold_edges": int(np.count_nonzero(count > 2)),
        "inconsistent_edges": int(np.count_nonzero((count == 2) & (along != 1))),
        "duplicate_faces": int(np.count_nonzero(repeated_faces(topology))),
        "degenerate_faces": int(np.count_nonzero(~topology.proper) + np.count_nonzero(flat)),
        "shells": int(np.count_nonzero(shells == np.arange(len(shells)))),
        "euler": int(np.count_nonzero(np.bincount(corners.ravel()))) - len(count) + len(corners),
    }


def fans_of(topology: Topology) -> np.ndarray:
    """Return equal numbers for corners at a position that are in one fan of faces, (3F,) int64.

    Faces that share an edge of exactly two faces are in one fan at its ends.
    """
    forward = topology.forward
    s, t = topology.pairs[:, topology.count[topology.edge[topology.pairs[0]]] == 2]
    opposite = forward[s] != forward[t]
    u = np.concatenate([s, next_sides(s)])
    v = np.concatenate([np.where(opposite, next_sides(t), t), np.where(opposite, t, next_sides(t))])
    return components(u, v, len(forward))


def next_sides(sides: np.ndarray) -> np.ndarray:
    """Return the next side in each face, which is also the corner at the end of each side."""
    return sides + np.where(sides % 3 == 2, -2, 1)


def edges_of(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edge, (3F,), and direction, (3F,) bool, of the sides ab, bc, ca of faces."""
    key, forward = edge_keys(*sides_of(corners))
    return np.unique(key, return_inverse=True)[1].reshape(-1), forward


def edge_keys(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a number for the two ends of each side, in any order, and edges_of's directions."""
    return np.minimum(start, end) << 32 | np.maximum(start, end), start < end


def sides_of(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the start and the end of the sides ab, bc, ca of (F, 3) corners, (3F,) each."""
    return corners.ravel(), np.roll(corners, -1, axis=1).ravel()


def boxes_of(of: np.ndarray, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and high corners, (count, 3) each, of the boxes of (n, k, 3) points, by the
    number (n,) of their box; inf and -inf where there are none."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, of, points.min(axis=1))
    np.maximum.at(high, of, points.max(axis=1))
    return low, high


def components(u: np.ndarray, v: np.ndarray, nodes: int) -> np.ndarray:
    """Return the least node of each node's component, (nodes,) int64, under links from u to v."""
    root = np.arange(nodes)
    while len(u):
        u, v = root[u], root[v]
        apart = u != v
        u, v = u[apart], v[apart]
        np.minimum.at(root, np.maximum(u, v), np.minimum(u, v))
        while not np.array_equal(root, jump := root[root]):
            root = jump
    return root
