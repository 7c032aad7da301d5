"""The winding number beside each face of a mesh, which spares most points a sum of their own.

Go from a point to the nearest point of the mesh, and along that face to its centroid. No face is
passed on the way, so that the winding number changes little where holes are far away (boundary.py).
There the number near the centroid of a face, on the side of the point, decides the point's. It does
not where another face intersects this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.topology import edges_of, shells_of
from voxtool.spatial.boundary import along_curve, boundary_spheres
from voxtool.spatial.winding_number import WindingNumber
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.bvh import TriangleTree
    from voxtool.spatial.pseudonormals import Pseudonormals

ABOVE = 2.0**-10  # heights of a face: the distance at which the number in front is computed


@dataclass(frozen=True, eq=False)
class Sides:
    """The winding number in front of faces, and where it may change.

    front : (F,) float64: on the side to which the face's normal points; behind the face it is 1
        more. NaN where it is not known: the face is flat, has a non-manifold edge, is intersected
        (self_intersections.py), or folds back onto another, so that it is not 1 more.
    spheres : (S, 5) float64, of boundary_spheres.
    """

    front: np.ndarray
    spheres: np.ndarray


def find_sides(
    mesh: Mesh, normals: Pseudonormals, winding: WindingNumber, intersecting: np.ndarray
) -> Sides:
    """Return the sides of a mesh's faces; `intersecting` is that of find_self_intersections."""
    edges, forth = edges_of(mesh.positions[mesh.faces])
    faces_of = np.bincount(edges)
    way, some = np.where(forth, 1.0, -1.0), winding.counted
    if some is not None:
        way *= np.repeat(np.isin(np.arange(len(mesh.faces)), some), 3)
    net = np.bincount(edges, way)
    odd = ((faces_of != 2) | (net != 0)) & (faces_of != 1)
    known = np.flatnonzero(~(intersecting | odd[edges].reshape(-1, 3).any(axis=1)))
    front = np.full(len(mesh.faces), np.nan)
    ahead, behind = _beside(mesh, known, normals, winding)
    front[known] = np.where(np.abs(behind - ahead - 1) < 0.25, ahead, np.nan)
    return Sides(front, boundary_spheres(mesh, some, winding.tree.frame))


def shells_agree(mesh: Mesh, normals: Pseudonormals, device: Device, tree: TriangleTree) -> bool:
    """Return whether the winding number in front of every shell is 0; or -1, if the mesh is inside
    out. The mesh is closed and has no self-intersections; nested shells wound alike differ."""
    shells = shells_of(mesh)
    faces = np.unique(shells, return_index=True)[1]
    if len(faces) == 1:
        return True
    front, _ = _beside(mesh, faces, normals, WindingNumber(mesh, device, tree=tree))
    outside = 0.0 if front[0] > -0.5 else -1.0
    return bool((np.abs(front - outside) < 0.25).all())


def _beside(
    mesh: Mesh, faces: np.ndarray, normals: Pseudonormals, winding: WindingNumber
) -> tuple[np.ndarray, np.ndarray]:
    """Return the winding number above and below the centroid of each of (n,) faces, (n,) float64
    each; NaN where one is flat."""
    triangles = winding.tree.frame.local(mesh.vertices)[mesh.faces[faces]]
    normal = normals.normals[normals.features[faces, 0]]
    size = length(normal)
    a, b, c = (triangles[:, i] for i in range(3))
    edges = np.stack([b - a, c - a, (c - a) - (b - a)])
    longest = length(edges).max(axis=0)
    twice_area = length(cross(edges[0], edges[1]))
    known = (normals.flat[faces] == 0) & (size > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = np.where(known, ABOVE * twice_area / longest / size, 0)[:, None] * normal
    middle = (a + b + c) / 3
    order = along_curve(middle)
    numbers = np.full((2, len(faces)), np.nan)
    for number, points in zip(numbers, (middle + rise, middle - rise), strict=True):
        near = winding.device.put(points[order])
        number[order] = winding.at_local(near, len(faces)).take()
    return np.where(known, numbers[0], np.nan), np.where(known, numbers[1], np.nan)
