"""A surface net laid onto targets: each vertex moves to a point of a target within its own cell.

The net separates the set voxels from the others, with a vertex in each cell, the cube between the
centres of eight voxels [Gibson 1998]. Its connections are closed and manifold, and do not depend on
where the vertices lie. A vertex moves to the nearest point of a target, such as a mesh; if that
lies outside its cell, the search goes on from where the tangent plane passes the cell, a few times.
Where the target misses the cell, as over a hole that the fill rule closed, the vertex stays where
the net has it. With several targets the nearest point counts.

Faces that then pass through others are split anew, or get their vertices back from the net
(svo/surface/untangle.py).

All positions are whole numbers of the lattice of the net's points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.spatial.distance import POINTS_AT_ONCE
from voxtool.svo.surface.isosurface import LATTICE, NEAREST, Isosurface
from voxtool.svo.surface.untangle import Untangled, untangle
from voxtool.vector import dot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.opencl import Device
    from voxtool.repairing.targets import Target

PROJECTIONS = 4  # onto the mesh, of each vertex
HALVINGS = 24  # of a range of a few cells: 2**-8 of a step of the lattice
NONE = -1  # in place of a target


@dataclass(frozen=True)
class Fitted:
    """A surface whose vertices were moved, with the faces that others still pass through, and (V,)
    int64 the target on which each vertex lies, or NONE."""

    found: Untangled
    targets: np.ndarray

    @property
    def surface(self) -> Isosurface:
        """The surface."""
        return self.found.surface


def fit(net: Isosurface, targets: Sequence[Target], device: Device) -> Fitted:
    """Return the net with its vertices on the nearest of the targets that pass their cells."""
    points, on = net.points.copy(), np.full(len(net.points), NONE)
    with device.stage("fit"):
        for start in range(0, len(points), POINTS_AT_ONCE):
            block = slice(start, start + POINTS_AT_ONCE)
            points[block], on[block] = _laid(net, points[block], targets)
    with device.stage("self-intersections"):
        found = untangle(replace(net, points=points), [net.points], device)
    return Fitted(found, np.where(found.moved, NONE, on))


def cells_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high corners, (n, 3) int64, of where vertices may lie: of their cells,
    without the margin that points of nets keep."""
    low = (points - LATTICE // 2) // LATTICE * np.int64(LATTICE) + LATTICE // 2
    return low + NEAREST, low + LATTICE - NEAREST


def _laid(
    net: Isosurface, points: np.ndarray, targets: Sequence[Target]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of targets in the cells of vertices, (n, 3) int32, of several the nearest,
    or the vertices themselves; and whose they are, (n,) int64."""
    best, on, least = points.copy(), np.full(len(points), NONE), np.full(len(points), np.inf)
    for number, target in enumerate(targets):
        found, held = _project(net, points, target)
        moved = (found - points).astype(np.float64)
        far = dot(moved, moved)
        nearer = held & (far < least)
        best[nearer], on[nearer], least[nearer] = found[nearer], number, far[nearer]
    return best, on


def _project(net: Isosurface, points: np.ndarray, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a target in the cells of vertices, (n, 3) int32, and for which there is
    one, (n,) bool."""
    step, origin = np.array(net.grid.pitch) * (net.side / LATTICE), np.array(net.grid.origin)
    low, high = cells_of(points)
    found, left, tried = points.copy(), np.arange(len(points)), points.astype(np.float64)
    for _ in range(PROJECTIONS):
        near, normals = target(tried * step + origin)
        near = np.rint((near - origin) / step)
        held = ((near >= low[left]) & (near <= high[left])).all(axis=1)
        found[left[held]] = near[held]
        beyond = ~held
        left = left[beyond]
        tried = onto_planes(points[left], near[beyond], normals[beyond], low[left], high[left])
        if not len(left):
            break
    laid = np.ones(len(points), bool)
    laid[left] = False
    return found, laid


def onto_planes(
    points: np.ndarray, on_planes: np.ndarray, normals: np.ndarray, low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the nearest point to each point that lies on a plane and in a box; where the plane
    misses the box, the point of the box nearest to the plane along its normal.

    points, on_planes, normals, low, high : (n, 3); normals of length 1 or 0.

    That point is `clip(point - t normal)` for some t, and its place along the normal falls with t.
    """
    far = 4.0 * (high - low).max(axis=1, initial=0)
    first, last = -far, far
    for _ in range(HALVINGS):
        middle = 0.5 * (first + last)
        moved = np.clip(points - middle[:, None] * normals, low, high)
        above = dot(moved - on_planes, normals) > 0
        first, last = np.where(above, middle, first), np.where(above, last, middle)
    return np.clip(points - last[:, None] * normals, low, high)
