"""The parts of a mesh: their labels, vertices and boxes, and whether they are closed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.choices import LABELS, PRIORITIES
from voxtool.errors import VoxtoolError
from voxtool.mesh.appearance import FILE, Parts
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import shells_of, sides_of
from voxtool.morton import distinct

SHELL = "shell"


def parts_of(mesh: Mesh, labels: str | Parts) -> Parts:
    """Return the parts of a mesh by their kind, equal names as one; VoxtoolError if it has none.

    Shells are numbered by falling number of faces; faces with fewer than three distinct positions
    belong to the first one.
    """
    if labels == SHELL:
        return _shells(mesh)
    if isinstance(labels, str):
        if labels not in LABELS:
            raise VoxtoolError(f"labels {labels!r}: choose one of {', '.join(LABELS)}")
        if labels not in mesh.parts:
            hint = "join meshes first" if labels == FILE else "choose labels 'shell'"
            raise VoxtoolError(f"{mesh.name or 'mesh'} names no {labels}s: {hint}")
        labels = mesh.parts[labels]
    if labels.labels.shape != (len(mesh.faces),):
        raise VoxtoolError(f"{len(labels.labels)} labels for {len(mesh.faces)} faces: one each")
    numbers = {name: number for number, name in enumerate(dict.fromkeys(labels.names))}
    merged = np.array([numbers[name] for name in labels.names], np.int32)
    return Parts(merged[labels.labels], tuple(numbers))


def _shells(mesh: Mesh) -> Parts:
    shells = shells_of(mesh)
    roots, sizes = np.unique(shells[shells >= 0], return_counts=True)
    numbers = np.zeros(len(mesh.faces) + 1, np.int32)  # the last one is of faces without a shell
    numbers[roots[np.argsort(-sizes, kind="stable")]] = np.arange(len(roots))
    names = tuple(f"shell {number}" for number in range(1, max(len(roots), 1) + 1))
    return Parts(numbers[shells], names)


def ranks_of(names: Sequence[str], priority: str | Sequence[str]) -> np.ndarray:
    """Return the rank of each name, (n,) uint32: of two parts in a voxel, the lower one counts.

    Parameters
    ----------
    names : sequence of str
        Names of the labels.
    priority : str or sequence of str
        One of PRIORITIES: the order of the names, or its reverse; or names, in a str separated by
        commas, that come first, in this order.
    """
    order = list(range(len(names)))
    if priority == "last":
        order.reverse()
    elif priority not in PRIORITIES:
        given = priority.split(",") if isinstance(priority, str) else priority
        numbers = {name: number for number, name in enumerate(names)}
        for name in given:
            if name not in numbers:
                known = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
                raise VoxtoolError(f"priority: there is no part {name!r}: choose of {known}")
        first = [numbers[name] for name in dict.fromkeys(given)]
        order = first + [number for number in order if number not in set(first)]
    ranks = np.empty(len(names), np.uint32)
    ranks[order] = np.arange(len(names))
    return ranks


@dataclass(frozen=True, eq=False)
class PartMesh:
    """A mesh whose parts share no vertex.

    points : (V, 3) float64
    faces : (F, 3) int32
    of : (F,) int32, the part of each face
    part_of : (V,) int32, that of each vertex
    parts : (n,) the parts that have faces, ascending
    """

    points: np.ndarray
    faces: np.ndarray
    of: np.ndarray
    part_of: np.ndarray
    parts: np.ndarray

    @classmethod
    def of_mesh(cls, mesh: Mesh, labels: np.ndarray) -> PartMesh:
        """Return the mesh with its vertices at bit-equal positions made one in each part."""
        corners = mesh.positions[mesh.faces]
        keys = labels[:, None].astype(np.int64) << 32 | corners
        ascending = distinct(keys.ravel())
        faces = np.searchsorted(ascending, keys).astype(np.int32)
        vertex_at = np.zeros(len(mesh.vertices), np.int64)
        vertex_at[mesh.positions] = np.arange(len(mesh.vertices))
        part_of = (ascending >> 32).astype(np.int32)
        points = mesh.vertices[vertex_at[ascending & 0xFFFFFFFF]]
        return cls(points, faces, labels, part_of, distinct(part_of))

    def some(self, faces: np.ndarray) -> PartMesh:
        """Return the mesh of some faces, which ascend."""
        used = np.zeros(len(self.points), bool)
        used[self.faces[faces]] = True
        index = np.cumsum(used, dtype=np.int32) - 1
        arrays = self.points[used], index[self.faces[faces]], self.of[faces], self.part_of[used]
        return PartMesh(*arrays, distinct(arrays[-1]))

    def boxes(self, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and high corners, (n, 3) int32 each, of the vertices of the parts, given
        the vertices on the lattice of a grid."""
        firsts = np.flatnonzero(np.diff(self.part_of, prepend=-1))  # vertices lie part by part
        return np.minimum.reduceat(fixed, firsts), np.maximum.reduceat(fixed, firsts)

    def closed(self) -> np.ndarray:
        """Return which parts are closed and consistently wound, (n,) bool: every edge has exactly
        two faces, which run along it in opposite directions."""
        a, b, c = self.faces.astype(np.int64).T
        proper = (a != b) & (b != c) & (c != a)
        start, end = sides_of(self.faces[proper].astype(np.int64))
        sides = np.minimum(start, end) << 33 | np.maximum(start, end) << 1 | (start < end)
        sides.sort()
        edges = sides >> 1
        firsts = np.flatnonzero(np.diff(edges, prepend=-1))
        counts = np.diff(firsts, append=len(edges))
        forward = np.add.reduceat(sides & 1, firsts) if len(firsts) else firsts
        wrong = self.part_of[edges[firsts[(counts != 2) | (forward != 1)]] >> 32]
        closed = np.ones(len(self.parts), bool)
        closed[np.searchsorted(self.parts, wrong)] = False
        flat = np.ones(len(self.parts), bool)  # parts of improper faces alone
        flat[np.searchsorted(self.parts, self.of[proper])] = False
        return closed & ~flat

    def alone(self, part: int, mesh: Mesh) -> Mesh:
        """Return a part as a mesh of its own."""
        name = f"{mesh.name or 'mesh'}, part {part}"
        first, last = np.searchsorted(self.part_of, [part, part + 1])
        return Mesh(
            self.points[first:last],
            self.faces[self.of == part] - np.int32(first),
            mesh.source_sha256, name, mesh.units, mesh.transform,
        )  # fmt: skip
