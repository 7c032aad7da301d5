"""The parts of a mesh, which vertices connect, and their volumes.

A shell (shells.py) is connected by edges, so a part consists of one shell, or of several that touch
at vertices. Its volume needs no edges but those of the boundary. Kernels: kernels/mesh/parts.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import boxes_of, components
from voxtool.opencl import Device
from voxtool.vector import cross, dot

SOURCE = "mesh/parts.cl"


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a mesh.

    volumes : (P,) float64, world units cubed, positive where faces are counter-clockwise seen from
        outside: with each connected component of the boundary closed by a cone to the middle of its
        box.
    low, high : (P, 3) float64: boxes, world units.
    """

    volumes: np.ndarray
    low: np.ndarray
    high: np.ndarray


def find_parts(mesh: Mesh, points: np.ndarray, boundary: np.ndarray, device: Device) -> Parts:
    """Return the parts of a mesh whose vertices are at points, (V, 3) float64, with boundary edges
    (n, 2), from vertex to vertex as their faces traverse them, each position by one vertex."""
    positions = mesh.positions
    corners = positions[mesh.faces]
    a, b, c = corners.T
    proper = (a != b) & (b != c) & (c != a)
    faces = mesh.faces
    if not proper.all():
        corners, faces = corners[proper], faces[proper]
    root = _connected(corners, len(positions), device)
    used = np.zeros(len(root), bool)
    used[corners.ravel()] = True
    first = used & (root == np.arange(len(root)))
    of = (np.cumsum(first) - 1)[root][positions]  # vertices
    count, held = int(np.count_nonzero(first)), used[positions]
    low, high = boxes_of(of[held], points[held, None], count)
    middles = low + (high - low) / 2

    tetrahedra = _tetrahedra(points[faces.T], middles, of[faces[:, 0]])
    volumes = np.bincount(of[faces[:, 0]], tetrahedra, count).astype(np.float64)
    if len(boundary):
        tetrahedra = _tetrahedra(_cones(points, boundary), middles, of[boundary[:, 0]])
        volumes += np.bincount(of[boundary[:, 0]], tetrahedra, count)
    return Parts(volumes, low, high)


def _connected(corners: np.ndarray, count: int, device: Device) -> np.ndarray:
    """Return the least position of each position's part, (count,) int64, of (F, 3) positions."""
    roots = device.put(np.arange(count, dtype=np.uint32))
    if len(corners):
        joined = device.view(corners.astype(np.uint32).ravel())
        device.kernel(SOURCE, "join_corners")(len(corners), joined, roots=roots)
        device.kernel(SOURCE, "find_parts")(count, roots)
    return roots.take().astype(np.int64)


def _tetrahedra(triangles: np.ndarray, middles: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the volumes between (3, n, 3) triangles and the middles of their parts, (n,)."""
    a, b, c = triangles - middles[of]
    return dot(a, cross(b, c)) / 6


def _cones(points: np.ndarray, boundary: np.ndarray) -> np.ndarray:
    """Return a triangle for each boundary edge, (3, n, 3), to the middle of the box of the edges
    that are connected to it."""
    used, ends = np.unique(boundary, return_inverse=True)
    begin, end = ends.reshape(-1, 2).T
    loop = components(begin, end, len(used))[begin]
    low, high = (corner[loop] for corner in boxes_of(loop, points[boundary], len(used)))
    return np.stack([low + (high - low) / 2, points[boundary[:, 1]], points[boundary[:, 0]]])
