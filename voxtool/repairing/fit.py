"""A surface net laid onto a mesh: each vertex moves to a point of the mesh within its own cell.

The net separates the set voxels from the others, with a vertex in each cell, the cube between the
centres of eight voxels [Gibson 1998]. Its connections are closed and manifold, and do not depend on
where the vertices lie. A vertex moves to the nearest point of the mesh; if that lies outside its
cell, the search goes on from where the mesh's tangent plane passes the cell, a few times. Where the
mesh misses the cell, as over a hole that the fill rule closed, the vertex stays where the net has
it.

Faces that then pass through others get their vertices back from the net, in rounds.

All positions are whole numbers of the lattice of the net's points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.spatial.bvh import build_tree
from voxtool.spatial.distance import POINTS_AT_ONCE, TriangleDistance
from voxtool.spatial.self_intersections import find_self_intersections
from voxtool.svo.surface.isosurface import LATTICE, NEAREST, Isosurface

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

PROJECTIONS = 4  # onto the mesh, of each vertex
HALVINGS = 24  # of a range of a few cells: 2**-8 of a step of the lattice
ROUNDS = 4  # in which faces that pass through others get the net's vertices back


@dataclass(frozen=True)
class Fitted:
    """A surface whose vertices were moved, (V,) bool which of them lie on the mesh, and (F,) uint8
    which faces others pass through, as find_self_intersections says."""

    surface: Isosurface
    on_mesh: np.ndarray
    crossed: np.ndarray


def fit_to_mesh(net: Isosurface, mesh: Mesh, device: Device) -> Fitted:
    """Return the net with its vertices on the mesh, where the mesh passes their cells."""
    points, on_mesh = net.points.copy(), np.zeros(len(net.points), bool)
    distance = TriangleDistance(mesh, device)
    with device.stage("fit"):
        for start in range(0, len(points), POINTS_AT_ONCE):
            block = slice(start, start + POINTS_AT_ONCE)
            points[block], on_mesh[block] = _project(net, points[block], distance)
    with device.stage("self-intersections"):
        return _untangle(net, points, on_mesh, device)


def cells_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high corners, (n, 3) int64, of where vertices may lie: of their cells,
    without the margin that points of nets keep."""
    low = (points - LATTICE // 2) // LATTICE * np.int64(LATTICE) + LATTICE // 2
    return low + NEAREST, low + LATTICE - NEAREST


def _project(
    net: Isosurface, points: np.ndarray, distance: TriangleDistance
) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the mesh in the cells of vertices, (n, 3) int32, or the vertices themselves;
    and which are of the mesh, (n,) bool."""
    step, origin = np.array(net.grid.pitch) * (net.side / LATTICE), np.array(net.grid.origin)
    low, high = cells_of(points)
    found, left, tried = points.copy(), np.arange(len(points)), points.astype(np.float64)
    for _ in range(PROJECTIONS):
        near, normals = (np.empty((len(left), 3)) for _ in range(2))
        for block in distance.blocks(tried * step + origin):
            nearest = distance.at_block(block, located=True)
            near[block.where], normals[block.where] = nearest.points, nearest.directions
        near = np.rint((near - origin) / step)
        held = ((near >= low[left]) & (near <= high[left])).all(axis=1)
        found[left[held]] = near[held]
        beyond = ~held
        left = left[beyond]
        tried = onto_planes(points[left], near[beyond], normals[beyond], low[left], high[left])
        if not len(left):
            break
    on_mesh = np.ones(len(points), bool)
    on_mesh[left] = False
    return found, on_mesh


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
        x, y, z = ((moved - on_planes) * normals).T
        above = x + y + z > 0
        first, last = np.where(above, middle, first), np.where(above, last, middle)
    return np.clip(points - last[:, None] * normals, low, high)


def _untangle(net: Isosurface, points: np.ndarray, on_mesh: np.ndarray, device: Device) -> Fitted:
    """Return the surface of these points; faces without area, or that pass through others, get the
    net's points."""
    for turn in range(ROUNDS + 1):
        surface = replace(net, points=points)
        flat = flat_faces(surface)
        crossed = crossed_faces(surface, flat, device)
        if turn == ROUNDS or not (crossed.any() or flat.any()):
            break
        back = net.faces[(crossed > 0) | flat]
        points = points.copy()
        points[back], on_mesh[back] = net.points[back], False
    return Fitted(surface, on_mesh, crossed)


def flat_faces(surface: Isosurface) -> np.ndarray:
    """Return which faces have no area, (F,) bool, exactly: corners are a few cells apart."""
    a, b, c = (surface.points[surface.faces[:, i]].astype(np.int64) for i in range(3))
    return (np.cross(b - a, c - a) == 0).all(axis=1)


def crossed_faces(surface: Isosurface, flat: np.ndarray, device: Device) -> np.ndarray:
    """Return find_self_intersections of a surface, (F,) uint8; `flat` faces have no area."""
    mesh = surface.mesh()
    return find_self_intersections(device, mesh, build_tree(device, mesh, flat.astype(np.uint8)))
