"""The shells of a mesh, and the patches of which they consist.

A shell is a set of faces that edges connect. A patch is a part of a shell with consistent winding:
neighbours traverse their common edge in opposite directions. Patches that disagree across edges of
two faces form two groups; the group with less area is flipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.mesh.loops import Loops
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import Topology, boxes_of, components
from voxtool.vector import cross, dot, length

FLAT = 1e-12  # a shell is flat if its volume is less than this times its longest side cubed


@dataclass(frozen=True, eq=False)
class Patches:
    """The patches of a mesh, by falling area.

    of: (F,) int64, the patch of each face, -1 for faces with fewer than three distinct positions;
    areas: (P,) float64, world units squared; flipped: (P,) bool, against the larger area around it;
    one_sided: (P,) bool, parts of a surface with one side, such as a Moebius band; never flipped.
    """

    of: np.ndarray
    areas: np.ndarray
    flipped: np.ndarray
    one_sided: np.ndarray


@dataclass(frozen=True, eq=False)
class Sheets:
    """The sheets of a mesh: faces that edges of two faces connect, whatever their winding.

    of : (n,) int64: the first face of each face's sheet, of the faces on three positions.
    alike : (n,) bool: wound consistently with that face.
    one_sided : (n,) bool: part of a sheet with one side, such as a Moebius band.
    """

    of: np.ndarray
    alike: np.ndarray
    one_sided: np.ndarray


@dataclass(frozen=True, eq=False)
class Shells:
    """The shells of a mesh, by falling number of faces.

    of : (F,) int64: the shell of each face, -1 for faces with fewer than three distinct positions.
    closed : (S,) bool: every edge is used an even number of times.
    consistent : (S,) bool: every edge is used in one direction as often as in the other, or once.
    volumes : (S,) float64, world units cubed, positive where faces are counter-clockwise seen from
        outside: with each boundary loop closed by a cone to the middle of its box. NaN where the
        shell is not consistent, or a loop does not close.
    loops : (S,) int64: boundary loops.
    low, high : (S, 3) float64: boxes, world units.
    """

    of: np.ndarray
    closed: np.ndarray
    consistent: np.ndarray
    volumes: np.ndarray
    loops: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def faces(self) -> np.ndarray:
        """The number of faces of each shell, (S,) int64."""
        return np.bincount(self.of[self.of >= 0], minlength=len(self.closed))


def find_patches(mesh: Mesh, topology: Topology) -> Patches:
    """Return the patches of a mesh, with the result of topology_of."""
    n = len(topology.corners)
    (one, other), agree = _neighbours(topology)
    root = components(one[agree], other[agree], n)
    sheets = find_sheets(topology)
    a, b, c = mesh.vertices[mesh.faces[topology.proper]].transpose(1, 0, 2)
    areas = length(cross(b - a, c - a)) / 2
    surplus = np.bincount(sheets.of, np.where(sheets.alike, areas, -areas), n)
    flipped = sheets.alike != (surplus[sheets.of] >= 0)

    numbers, area = _numbered(root, areas)
    patches = np.full(len(mesh.faces), -1)
    patches[topology.proper] = numbers
    first = np.unique(numbers, return_index=True)[1]
    one_sided = sheets.one_sided[first]
    return Patches(patches, area, flipped[first] & ~one_sided, one_sided)


def find_sheets(topology: Topology) -> Sheets:
    """Return the sheets of a mesh, with the result of topology_of."""
    n = len(topology.corners)
    (one, other), agree = _neighbours(topology)
    # Nodes f and f + n are a face and its reverse; consistent ones are linked. A face linked to its
    # reverse is one-sided; otherwise the least node shows the direction of the first face.
    turned = np.where(agree, 0, n)
    both = components(
        np.concatenate([one, one + n]), np.concatenate([other + turned, other + n - turned]), 2 * n
    )
    as_it_is, over = both[:n], both[n:]
    return Sheets(np.minimum(as_it_is, over), as_it_is < over, as_it_is == over)


def _neighbours(topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of faces that share an edge of two faces, (2, P) int64, and whether they
    traverse it in opposite directions, (P,) bool."""
    pairs = topology.pairs[:, topology.count[topology.edge[topology.pairs[0]]] == 2]
    return pairs // 3, topology.forward[pairs[0]] != topology.forward[pairs[1]]


def find_shells(mesh: Mesh, topology: Topology, loops: Loops) -> Shells:
    """Return the shells of a mesh, with the results of topology_of and find_loops."""
    n = len(topology.corners)
    one, other = topology.pairs // 3
    of, faces = _numbered(components(one, other, n), np.ones(n))
    count = len(faces)
    shells = np.full(len(mesh.faces), -1)
    shells[topology.proper] = of

    of_edge = np.empty(len(topology.count), np.int64)
    of_edge[topology.edge] = np.repeat(of, 3)
    odd = topology.count % 2 == 1
    net = 2 * np.bincount(topology.edge, topology.forward, len(of_edge)) - topology.count
    uneven = (net != 0) & (topology.count > 1)
    closed = np.bincount(of_edge[odd], minlength=count) == 0
    consistent = np.bincount(of_edge[uneven], minlength=count) == 0

    triangles = mesh.vertices[mesh.faces[topology.proper]] + 0.0
    low, high = boxes_of(of, triangles, count)

    shell_of_loop = shells[loops.faces[loops.starts[:-1]]]
    of_cap = shells[loops.faces]
    middles = np.repeat(loops.low + (loops.high - loops.low) / 2, loops.sizes, axis=0)
    begin, end = mesh.vertices[loops.edges].transpose(1, 0, 2)
    cones = np.stack([middles, end, begin], axis=1)
    which = np.concatenate([of, of_cap])
    centres = low + (high - low) / 2
    a, b, c = (np.concatenate([triangles, cones]) - centres[which][:, None]).transpose(1, 0, 2)
    parts = dot(a, cross(b, c)) / 6  # tetrahedra between the faces and the middle
    volumes = np.bincount(which, parts, count).astype(np.float64)  # of nothing it is integers
    volumes[~consistent] = np.nan
    volumes[shell_of_loop[~loops.closed]] = np.nan
    holes = np.bincount(shell_of_loop, minlength=count)
    return Shells(shells, closed, consistent, volumes, holes, low, high)


def _numbered(roots: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers in place of roots, by falling sum of weights, and these sums."""
    numbers = np.unique(roots, return_inverse=True)[1].reshape(-1)
    sums = np.bincount(numbers, weights).astype(np.float64)
    order = np.argsort(-sums, kind="stable")
    return np.argsort(order)[numbers], sums[order]
