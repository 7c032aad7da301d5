"""The nesting of the closed shells of a mesh, and their directions.

A shell contains another if its box contains the other's, no edge of either passes through a face
of the other (self_intersections.py), and its winding number is not 0 at the other's outermost
vertices, those of the least and the greatest x, y and z, or at the centroids of faces there. Shells
may touch: the number that is farthest from 1/2 decides.

A plane sweeps over the boxes along x, from high to low. It meets a shell after those inside it, so
each shell takes those of them that no other has taken: its children.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.morton import among, distinct
from voxtool.spatial.bvh import Frame
from voxtool.spatial.pseudonormals import PI, angle_of
from voxtool.spatial.winding_number import WindingNumber
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.mesh.shells import Shells
    from voxtool.opencl import Device

FEW = 1 << 16  # products of faces and points up to which winding numbers are summed on the host


@dataclass(frozen=True, eq=False)
class Nesting:
    """A tree of shells.

    parents : (S,) int64: an innermost shell that contains each, or -1; one of two if they intersect
        each other.
    depths : (S,) int64: how many are around each: its parent, the parent's parent and so on.
    roots : (S,) int64: the outermost shell around each, or the shell itself.
    """

    parents: np.ndarray
    depths: np.ndarray
    roots: np.ndarray


def nest(mesh: Mesh, shells: Shells, crossing: np.ndarray, device: Device) -> Nesting:
    """Return the nesting of the shells of a mesh, given pairs that cross, (n, 2) int64, clear of
    edges (crossing_shells); raises as WindingNumber."""
    count = len(shells.closed)
    crosses = distinct(np.concatenate([crossing, crossing[:, ::-1]]) @ [count, 1])
    low, high, closed = shells.low, shells.high, shells.closed.tolist()
    order = np.lexsort((*high.T[::-1], *-low.T[::-1])).tolist()  # inner boxes come first
    local = Mesh(Frame.of(mesh).local(mesh.vertices), mesh.faces)
    faces = np.argsort(shells.of, kind="stable")
    starts = np.searchsorted(shells.of[faces], np.arange(count + 1))
    parents = np.full(count, -1)
    free, free_low, end = np.empty(count, np.int64), np.empty(count), 0  # shells without a parent
    for shell in order:
        if closed[shell]:
            first = int(np.searchsorted(free_low[:end], -high[shell, 0]))
            near = free[first:end]
            inside = (low[near] >= low[shell]) & (high[near] <= high[shell])
            smaller = (low[near] > low[shell]) | (high[near] < high[shell])
            inner = near[inside.all(axis=1) & smaller.any(axis=1)]
            inner = inner[~among(crosses, shell * count + inner)]
            if len(inner):
                points = [_outermost(local, faces[starts[i] : starts[i + 1]]) for i in inner]
                own = faces[starts[shell] : starts[shell + 1]]
                number = _winding(local, own, np.concatenate(points), device)
                beyond = np.abs(number).reshape(len(inner), -1) - 0.5
                farthest = np.abs(beyond).argmax(axis=1)
                parents[inner[beyond[np.arange(len(inner)), farthest] > 0]] = shell
                near = near[parents[near] < 0]
                end = first + len(near)
                free[first:end], free_low[first:end] = near, -low[near, 0]
        free[end], free_low[end] = shell, -low[shell, 0]
        end += 1
    depths, roots = np.zeros(count, np.int64), np.arange(count)
    for shell, parent in zip(order[::-1], parents[order[::-1]].tolist(), strict=True):
        if parent >= 0:
            depths[shell], roots[shell] = depths[parent] + 1, roots[parent]
    return Nesting(parents, depths, roots)


def _winding(mesh: Mesh, faces: np.ndarray, points: np.ndarray, device: Device) -> np.ndarray:
    """Return the winding number of some faces about (n, 3) points, (n,) float64."""
    if len(faces) * len(points) > FEW:
        return WindingNumber(_part(mesh, faces), device)(points)
    a, b, c = (mesh.vertices[mesh.faces[faces, i]] - points[:, None] for i in range(3))
    u, v, w = length(a), length(b), length(c)
    x = u * v * w + dot(a, b) * w + dot(b, c) * u + dot(c, a) * v
    return np.cumsum(angle_of(dot(a, cross(b, c)), x), axis=1)[:, -1] / (2 * PI)


def _part(mesh: Mesh, faces: np.ndarray) -> Mesh:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    return Mesh(mesh.vertices[used], corners.reshape(-1, 3).astype(np.int32))


def _outermost(mesh: Mesh, faces: np.ndarray) -> np.ndarray:
    """Return the vertices of faces of the least and the greatest x, y and z, and the centroids of a
    face at each, (12, 3)."""
    triangles = mesh.vertices[mesh.faces[faces]]
    points = triangles.reshape(-1, 3)
    corners = np.concatenate([points.argmin(axis=0), points.argmax(axis=0)])
    a, b, c = triangles[corners // 3].transpose(1, 0, 2)
    return np.concatenate([points[corners], (a + b + c) / 3])
