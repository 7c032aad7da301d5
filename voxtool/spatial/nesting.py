"""The nesting of the closed shells of a mesh, and their directions.

A shell contains another if its box contains the other's, and its winding number is not 0 at the
other's outermost vertices, those of the least and the greatest x, y and z. Shells that intersect
mostly contain each other in neither direction; self_intersections.py finds those.

A plane sweeps over the boxes along x, from high to low. It meets a shell after those inside it, so
each shell takes those of them that no other has taken: its children.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.loops import find_loops
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.shells import Shells, find_shells
from voxtool.mesh.topology import topology_of
from voxtool.spatial.bvh import Frame
from voxtool.spatial.pseudonormals import PI, angle_of
from voxtool.spatial.winding_number import WindingNumber
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.opencl import Device

FEW = 1 << 16  # products of faces and points up to which winding numbers are summed on the host


@dataclass(frozen=True, eq=False)
class Nesting:
    """A tree of shells.

    parents : (S,) int64: an innermost shell that contains each, or -1; of two that intersect each
        other, one.
    depths : (S,) int64: how many are around each: its parent, the parent's parent and so on.
    """

    parents: np.ndarray
    depths: np.ndarray


def nest(mesh: Mesh, shells: Shells, device: Device) -> Nesting:
    """Return the nesting of the shells of a mesh; raises as WindingNumber."""
    count = len(shells.closed)
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
            if len(inner):
                points = [_outermost(local, faces[starts[i] : starts[i + 1]]) for i in inner]
                own = faces[starts[shell] : starts[shell + 1]]
                number = _winding(local, own, np.concatenate(points), device).reshape(-1, 6)
                parents[inner[(np.abs(number) > 0.5).all(axis=1)]] = shell
                near = near[parents[near] < 0]
                end = first + len(near)
                free[first:end], free_low[first:end] = near, -low[near, 0]
        free[end], free_low[end] = shell, -low[shell, 0]
        end += 1
    depths = np.zeros(count, np.int64)
    for shell, parent in zip(order[::-1], parents[order[::-1]].tolist(), strict=True):
        if parent >= 0:
            depths[shell] = depths[parent] + 1
    return Nesting(parents, depths)


def turn_shells(mesh: Mesh, device: Device) -> Mesh:
    """Return a mesh whose outermost closed shells point outward: those that enclose a negative
    volume are reversed, with all shells within them, so that cavities stay cavities."""
    topology = topology_of(mesh)
    shells = find_shells(mesh, topology, find_loops(mesh, topology))
    nesting = nest(mesh, shells, device)
    outermost = np.arange(len(nesting.parents))
    for _ in range(int(nesting.depths.max(initial=0))):
        around = nesting.parents[outermost]
        outermost = np.where(around >= 0, around, outermost)
    wrong = (shells.closed & (shells.volumes < 0))[outermost]
    flipped = (shells.of >= 0) & wrong[shells.of]
    if not flipped.any():
        return mesh
    return replace(mesh, faces=np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces))


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
    """Return the (6, 3) vertices of faces: of the least and the greatest x, y and z."""
    points = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
    return points[np.concatenate([points.argmin(axis=0), points.argmax(axis=0)])]
