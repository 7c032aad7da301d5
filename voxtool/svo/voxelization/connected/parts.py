"""The connected parts of the inside of a mesh: which shells bound the same one.

Shells bound one part if their triangles meet, or if one is the wall of a cavity in the other. Only
shells that touch a common voxel are compared: others are far enough apart to be thinned apart. Open
shells count as one, since they bound an inside together. Predicates are exact, on the mesh's
lattice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import components
from voxtool.morton import distinct
from voxtool.svo.voxelization.mesh_parts import PartMesh, parts_of
from voxtool.vector import cross, dot

PAIRS_AT_ONCE = 1 << 20  # of triangles
NARROW = 1 << 19  # lattice units across, up to which 64 bits hold volumes of tetrahedra


class Shells:
    """The shells of a mesh on a lattice.

    Attributes
    ----------
    of : (F,) int64
        The shell of each face; those that are open are one.
    closed : (n,) bool
        Which are closed and consistently wound.
    """

    def __init__(self, mesh: Mesh, fixed: np.ndarray) -> None:
        self.triangles = fixed.astype(np.int64)[mesh.faces]
        of = parts_of(mesh, "shell").labels
        own = PartMesh.of_mesh(mesh, of)
        self.closed = np.zeros(int(of.max(initial=-1)) + 1, bool)
        self.closed[own.parts] = own.closed()
        is_open = np.flatnonzero(~self.closed)
        self.of = np.where(self.closed[of], of, is_open[0] if len(is_open) else 0).astype(np.int64)

    @property
    def several(self) -> bool:
        """True if there are at least two."""
        return len(self.of) > 0 and bool((self.of != self.of[0]).any())

    def united(self, voxels: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return equal numbers for the shells of each part, (n,) int64, given the pairs of a voxel
        and a face that touches it."""
        order = np.argsort(voxels, kind="stable")
        voxels, faces = voxels[order], faces[order]
        firsts = np.flatnonzero(np.diff(voxels, prepend=-1))
        own = self.of[faces]
        least, most = np.minimum.reduceat(own, firsts), np.maximum.reduceat(own, firsts)
        shared = np.repeat(least < most, np.diff(firsts, append=len(voxels)))
        part = np.arange(len(self.closed))
        if not shared.any():
            return part
        voxels, faces = voxels[shared], faces[shared]
        near = distinct(self.of[faces])
        u, v = near, self._owners(near)
        for one, other in _pairs(voxels, faces):
            part = components(u, v, len(self.closed))
            apart = part[self.of[one]] != part[self.of[other]]
            one, other = one[apart], other[apart]
            met = meet(self.triangles[one], self.triangles[other])
            u = np.concatenate([u, self.of[one[met]]])
            v = np.concatenate([v, self.of[other[met]]])
        return components(u, v, len(self.closed))

    def _owners(self, some: np.ndarray) -> np.ndarray:
        """Return of some shells those whose cavities they bound, or themselves: a closed shell
        that an odd number of others contain bounds a cavity of the innermost of them."""
        corners = self.triangles.reshape(-1, 3)
        faces = np.argsort(self.of, kind="stable")
        starts = np.searchsorted(self.of[faces], np.arange(len(self.closed) + 1))
        low, high = np.zeros((2, len(self.closed), 3), np.int64)
        for shell in distinct(self.of):
            points = self.triangles[faces[starts[shell] : starts[shell + 1]]].reshape(-1, 3)
            low[shell], high[shell] = points.min(axis=0), points.max(axis=0)

        def around(shell: int) -> list[int]:
            point = corners[3 * faces[starts[shell]]]
            held = (low <= low[shell]).all(axis=1) & (high >= high[shell]).all(axis=1)
            held[shell] = False
            return [
                other
                for other in np.flatnonzero(held & self.closed).tolist()
                if contains(self.triangles[faces[starts[other] : starts[other + 1]]], point)
            ]

        owners = some.copy()
        for row, shell in enumerate(some.tolist()):
            if self.closed[shell] and len(outer := around(shell)) % 2:
                owners[row] = max(outer, key=lambda other: len(around(other)))
        return owners


def _pairs(voxels: np.ndarray, faces: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the pairs of faces in one voxel, some at once, given faces by ascending voxel."""
    ends = np.searchsorted(voxels, voxels, side="right")
    later = ends - np.arange(len(voxels)) - 1  # faces behind each in its voxel
    total = np.concatenate([[0], np.cumsum(later)])
    first = 0
    while first < len(voxels):
        last = max(
            int(np.searchsorted(total, total[first] + PAIRS_AT_ONCE, side="right")) - 1, first + 1
        )
        counts = later[first:last]
        one = np.repeat(np.arange(first, last), counts)
        step = np.arange(len(one)) - np.repeat(total[first:last] - total[first], counts)
        yield faces[one], faces[one + 1 + step]
        first = last


def meet(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return which pairs of (n, 3, 3) triangles have a common point, (n,) bool; those that lie in
    one plane count as apart."""
    both = np.concatenate([one, other], axis=1)
    near = (one.min(axis=1) <= other.max(axis=1)) & (other.min(axis=1) <= one.max(axis=1))
    met = np.zeros(len(one), bool)
    rows = np.flatnonzero(near.all(axis=1))
    both = both[rows] - both[rows, :1]
    wide = np.abs(both).max(initial=0) > NARROW
    if wide:
        both = both.astype(object)
    a, b = both[:, :3], both[:, 3:]
    for side in range(3):
        for p, q in ((a, b), (b, a)):
            met[rows] |= _pierces(p[:, side], p[:, side - 1], *q.transpose(1, 0, 2))
    return met


def _pierces(
    p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> np.ndarray:
    """Return which segments from p to q meet triangles, and do not lie in their planes."""
    normal = cross(b - a, c - a)
    low, high = dot(normal, p - a), dot(normal, q - a)
    sides = [dot(cross(x - p, y - p), q - p) for x, y in ((a, b), (b, c), (c, a))]
    least, most = np.minimum.reduce(sides), np.maximum.reduce(sides)
    crosses = (np.minimum(low, high) <= 0) & (np.maximum(low, high) >= 0) & (low != high)
    return (crosses & ((least >= 0) | (most <= 0))).astype(bool)


def contains(triangles: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a closed surface contains a point that does not lie on it, on a lattice: a ray
    along x crosses it an odd number of times."""
    moved = triangles - point
    y, z = moved[..., 1], moved[..., 2]
    near = (z.min(axis=1) < 0) & (z.max(axis=1) >= 0) & (y.max(axis=1) >= 0) & (y.min(axis=1) <= 0)
    moved = moved[near].astype(object)
    odd = np.zeros(len(moved), bool)
    for corner in range(3):
        p, q = moved[:, corner], moved[:, corner - 1]
        up = q[:, 2] >= 0
        steep = (p[:, 2] >= 0) != up
        area = p[:, 1] * q[:, 2] - q[:, 1] * p[:, 2]
        odd ^= steep & (np.where(up, area, -area) > 0).astype(bool)
    a, b, c = moved[odd].transpose(1, 0, 2)
    normal = cross(b - a, c - a)
    ahead = dot(normal, a) * normal[:, 0] > 0
    return bool(np.count_nonzero(ahead) % 2)
