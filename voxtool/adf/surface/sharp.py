"""Vertices on the features of the mesh that a field was built from: dual contouring [Ju 2002].

The plane of a crossing touches the mesh at the point nearest to it, at right angles to the way
there; at an offset it is moved by that distance along its normal. The vertex of a loop minimises
the squared distances to the planes of its crossings, in its leaf or up to REACH of its edges beside
it. Quadrilaterals are split along features. Vertices of faces that pass through others move towards
the surface without features, and then to the centres of their leaves, where surfaces intersect
less often.

Kernel: kernels/adf/surface/features.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.surface.placing import MARGIN
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import program
from voxtool.spatial.bvh import build_tree
from voxtool.spatial.self_intersections import find_self_intersections, rounds
from voxtool.vector import cross, unit

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.spatial.distance import TriangleDistance

SOURCE = "adf/surface/features.cl"
REACH = 1  # of a leaf's edges, beyond it, that a vertex may be
SMALL_STEPS = (256, 64, 16)  # untangle vertices in a row on an edge, which rounding entangles
NEAR_PLANES = 2.0**-20  # mean squared distance in edges of a leaf up to which a diagonal is near
ON_THE_MESH = 2.0**-26  # of the extent: rounding decides the direction to a point as near
QEF_NUMBERS = 14  # of float64 in a `qef` of kernels/qef.h
HEADERS = {"adf/surface/features.h": program.c_constants(MARGIN=MARGIN, REACH=REACH)}


@dataclass(frozen=True)
class Features:
    """The vertices of loops, and what diagonals are chosen by.

    points : (n, 3) float64, sides; low : (n, 3) and size : (n,), of their leaves, sides;
    errors : (n, 14) float64, the squared distances to the planes of each, from `low` in edges.
    """

    points: np.ndarray
    low: np.ndarray
    size: np.ndarray
    errors: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """(n, 3) float64: the centres of their leaves, sides."""
        return self.low + self.size[:, None] / 2

    def along(self, quads: np.ndarray, shorter: np.ndarray) -> np.ndarray:
        """Return whether each of (q, 4) quads is split from its first vertex to its third: by the
        diagonal that is nearer to the planes of its ends, or as `shorter` where both are near."""
        even, odd = self._error(quads[:, ::2]), self._error(quads[:, 1::2])
        return np.where(np.maximum(even, odd) > NEAR_PLANES, even <= odd, shorter)

    def _error(self, ends: np.ndarray) -> np.ndarray:
        """Return the mean squared distances of the middles of (q, 2) ends to the planes of both."""
        middle = (self.points[ends[:, 0]] + self.points[ends[:, 1]]) / 2
        found = np.zeros(len(ends))
        for end in ends.T:
            x, y, z = ((middle - self.low[end]) / self.size[end, None]).T
            xx, xy, xz, yy, yz, zz, bx, by, bz, c, _, _, _, count = self.errors[end].T
            sum_x = x * (xx * x + xy * y + xz * z - 2 * bx)
            sum_y = y * (xy * x + yy * y + yz * z - 2 * by)
            sum_z = z * (xz * x + yz * y + zz * z - 2 * bz)
            found += np.maximum(sum_x + sum_y + sum_z + c, 0) / count
        return found


def nearest_planes(
    distance: TriangleDistance, mesh: Mesh, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest points of a mesh, (n, 3) float64, and unit normals there: the directions
    to (n, 3) points, in world units, or of the faces where points are too near for these."""
    near = distance.nearest(points)
    assert near.faces is not None
    assert near.points is not None
    assert near.directions is not None
    normals = near.directions.copy()
    close = np.flatnonzero(near.distances <= ON_THE_MESH * np.ptp(mesh.bounds, axis=0).max())
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[near.faces[close]]], 1, 0)
    area = cross(b - a, c - a)
    normals[close[area.any(axis=1)]] = unit(area[area.any(axis=1)])
    return near.points, normals


def place_features(
    device: Device, low: np.ndarray, size: np.ndarray, loops: np.ndarray, on: np.ndarray,
    normals: np.ndarray,
) -> Features:  # fmt: skip
    """Return the vertices of loops.

    low : (n, 3), size : (n,) float64, sides: their leaves; loops : (k,) int64, ascending, the loop
    of each plane; on, normals : (k, 3) float64, a point of it, sides, and its unit normal.
    """
    n = len(low)
    first = np.searchsorted(loops, np.arange(n + 1)).astype(np.uint32)
    local = (on - low[loops]) / size[loops, None]
    points, errors = device.empty(3 * n, np.float64), device.empty(QEF_NUMBERS * n, np.float64)
    place = device.kernel(SOURCE, "place_on_planes")
    place(n, *map(device.put, (first, local, normals)), points, errors)
    found = low + points.take().reshape(-1, 3) * size[:, None]
    return Features(found, low, size, errors.take().reshape(-1, QEF_NUMBERS))


def apart(
    points: np.ndarray, homes: Sequence[np.ndarray], faces: np.ndarray, device: Device
) -> tuple[np.ndarray, int]:
    """Return the (v, 3) vertices, and how many faces pass through others, or may do so: vertices of
    such faces move towards their homes, which are tried in turn."""
    wrong, tangled = _wrong(points, faces, device)
    for home, divisor in rounds(homes, SMALL_STEPS):
        if not wrong.any():
            break
        back = np.zeros(len(points), bool)
        back[faces[wrong]] = True
        back &= (points != home).any(axis=1)
        if not back.any():
            continue
        points = np.where(back[:, None], points + (home - points) / divisor, points)
        wrong, tangled = _wrong(points, faces, device)
    return points, tangled


def _wrong(points: np.ndarray, faces: np.ndarray, device: Device) -> tuple[np.ndarray, int]:
    """Return which faces pass through others, or may do so, or have no area or a vertex in the
    place of another, (f,) bool; and the number of the first two."""
    mesh = Mesh(points, faces.astype(np.int32))
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    flat = (cross(b - a, c - a) == 0).all(axis=1)
    tree = build_tree(device, mesh, flat.astype(np.uint8))
    tangled = find_self_intersections(device, mesh, tree) > 0
    doubled = np.bincount(mesh.positions)[mesh.positions] > 1
    return tangled | flat | doubled[faces].any(axis=1), int(np.count_nonzero(tangled))
