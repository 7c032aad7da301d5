"""The winding number beside each face of a mesh, which spares most points a sum of their own.

Go from a point to the nearest point of the mesh, and along that face to its centroid. No face is
passed on the way, so that the winding number changes little where holes are far away (boundary.py).
There the number near the centroid of a face, on the side of the point, decides the point's. It does
not where another face intersects this one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.topology import components, edges_of
from voxtool.spatial.boundary import along_curve, boundary_spheres
from voxtool.spatial.distance import others_within
from voxtool.spatial.winding_number import WindingNumber
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.bvh import Frame, TriangleTree
    from voxtool.spatial.pseudonormals import Pseudonormals

ABOVE = 2.0**-10  # heights of a face: the distance at which the number in front is computed
CLEAR = 8.0  # such distances: within them, other faces are found
MANY = 1 / 16  # of the faces: if more are asked for, all are found at once
THIN = 2.0**-32  # a smaller such distance, in local coordinates, may be lost in rounding


class Sides:
    """The winding number in front of faces, which is found where kernels ask for it.

    front : (F,) float64: on the side to which the face's normal points; behind the face it is 1
        more. Infinite where it has not been found. NaN where it is not known: the face is flat, has
        a non-manifold edge, is intersected (self_intersections.py), or folds back onto another, so
        that it is not 1 more.
    spheres : (S, 5) float64, of boundary_spheres.
    arguments : the kernels', by name: the numbers, and a bit for each face whose number is wanted.
    """

    def __init__(
        self,
        mesh: Mesh,
        normals: Pseudonormals,
        winding: WindingNumber,
        tree: TriangleTree,
        meeting: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        """Prepare the sides of a mesh. tree : of its distinct faces; meeting : returns which of
        (n,) faces others intersect or repeat, (n,) bool."""
        self.mesh, self.normals, self.winding, self.tree = mesh, normals, winding, tree
        self.meeting = meeting
        edges, forth = edges_of(mesh.positions[mesh.faces])
        faces_of = np.bincount(edges)
        way, some = np.where(forth, 1.0, -1.0), winding.counted
        if some is not None:
            way *= np.repeat(np.isin(np.arange(len(mesh.faces)), some), 3)
        net = np.bincount(edges, way)
        odd = ((faces_of != 2) | (net != 0)) & (faces_of != 1)
        self._edges, self._odd = edges, odd[edges].reshape(-1, 3).any(axis=1)
        self.spheres = boundary_spheres(mesh, some, winding.tree.frame)
        self.front = np.full(len(mesh.faces), np.inf)
        put = winding.device.put
        self.arguments = {
            "front": put(self.front),
            "wanted": put(np.zeros(-(-len(mesh.faces) // 32), np.uint32)),
            "spheres": put(self.spheres),
            "sphere_count": len(self.spheres),
        }

    @property
    def is_partial(self) -> bool:
        """True if there are faces whose numbers have not been found."""
        return bool(np.isinf(self.front).any())

    def find_wanted(self) -> bool:
        """Find the numbers that kernels have asked for, if there are any that have not been found:
        return whether there are. From MANY faces on all are found."""
        unknown = np.isinf(self.front)
        bits = np.unpackbits(self.arguments["wanted"].get().view(np.uint8), bitorder="little")[
            : len(unknown)
        ]
        faces = np.flatnonzero(bits)
        if not len(faces):
            return False
        if np.count_nonzero(~unknown) + len(faces) > len(unknown) * MANY:
            # without a boundary, numbers of all faces are few: see _shells
            faces = np.flatnonzero(unknown | (len(self.spheres) == 0))
        self.find(faces)
        self.write()
        return True

    def write(self) -> None:
        """Give kernels the numbers that have been found."""
        device, wanted = self.winding.device, self.arguments["wanted"]
        device.write(wanted, np.zeros(wanted.size, np.uint32))
        device.write(self.arguments["front"], self.front)

    def find(self, faces: np.ndarray) -> None:
        """Find the numbers in front of (n,) faces, rising."""
        known = faces[~(self.meeting(faces) | self._odd[faces])]
        middle, rise = _centroids(self.mesh, known, self.normals, self.winding.tree.frame)
        height = length(rise)
        # beside a single layer of faces, the number behind need not be computed
        folded = height < THIN
        folded |= others_within(self.winding.device, self.tree, middle, CLEAR * height, known)
        alike = np.arange(len(known))
        if not len(self.spheres) and len(faces) == len(self.mesh.faces):
            # without a boundary, the number is the same in front of all of a shell
            alike = _shells(self._edges, known, ~folded)
        ahead = np.empty(len(known))
        first = np.unique(alike)
        ahead[first] = _numbers(self.winding, middle[first] + rise[first])
        ahead = ahead[alike]
        behind = _numbers(self.winding, middle[folded] - rise[folded])
        ahead[folded] = np.where(np.abs(behind - ahead[folded] - 1) < 0.25, ahead[folded], np.nan)
        self.front[faces] = np.nan
        self.front[known] = ahead


def _shells(edges: np.ndarray, known: np.ndarray, single: np.ndarray) -> np.ndarray:
    """Return the first of the known faces that edges connect to each of them, (n,) int64, past
    faces that are `single` alone, (n,) bool. edges : (3F,), of all faces; at most two known faces
    share one."""
    sides = edges.reshape(-1, 3)[known[single]].ravel()
    number = np.repeat(np.flatnonzero(single), 3)
    one, other = (np.zeros(edges.max(initial=-1) + 1, np.int64) for _ in range(2))
    one[sides], other[sides[::-1]] = number, number[::-1]
    return components(one[sides], other[sides], len(known))


def _centroids(
    mesh: Mesh, faces: np.ndarray, normals: Pseudonormals, frame: Frame
) -> tuple[np.ndarray, np.ndarray]:
    """Return the centroid of each of (n,) faces, and the way from there to the point in front of
    it, (n, 3) float64 each, local coordinates; 0 where a face is flat, or a point in this frame."""
    triangles = frame.local(mesh.vertices)[mesh.faces[faces]]
    normal = normals.normals[normals.features[faces, 0]]
    size = length(normal)
    a, b, c = (triangles[:, i] for i in range(3))
    edges = np.stack([b - a, c - a, (c - a) - (b - a)])
    longest = length(edges).max(axis=0)
    twice_area = length(cross(edges[0], edges[1]))
    known = (normals.flat[faces] == 0) & (size > 0) & (longest > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = np.where(known, ABOVE * twice_area / longest / size, 0)[:, None] * normal
    return (a + b + c) / 3, rise


def _numbers(winding: WindingNumber, points: np.ndarray) -> np.ndarray:
    """Return the winding number at each of (n, 3) local points, (n,) float64."""
    order, numbers = along_curve(points), np.empty(len(points))
    near = winding.device.put(points[order])
    numbers[order] = winding.at_local(near, len(points)).take()
    return numbers
