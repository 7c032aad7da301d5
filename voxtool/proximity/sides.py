"""Which sides of a mesh's faces are inside, by the winding number, so that most points need none.

From a point, go to the nearest point of the mesh, and along that face to its middle. On the way
the winding number changes only as the boundary's shape lets it, for no face is crossed: by the law
of Biot and Savart its gradient is at most the sum of dl / (4 pi r^2) over the edges of the
boundary. So the number near the middle of a face, on the side on which the point is, tells the
point's, where holes are far enough away. It does not where another face passes through this one:
faces next to which the number is another are unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.diagnosis import edges_of, positions
from voxtool.morton import morton_encode

if TYPE_CHECKING:
    from voxtool.mesh import Mesh
    from voxtool.proximity.pseudonormals import Pseudonormals
    from voxtool.proximity.winding import WindingNumber

SPHERES = 512  # that hold the boundary, at most
ABOVE = 2.0**-10  # of its height, how far above a face the number in front of it is taken


@dataclass(frozen=True, eq=False)
class Sides:
    """What the winding number is in front of faces, and where it may change.

    front : (F,) float64: on the side to which the face's normal points; behind it is 1 more. NaN
        where it is unknown: the face is flat, is at an edge that is not manifold, or has another
        number than a face beside it.
    spheres : (S, 5) float64: centre, radius, in the frame of the tree, and the length of boundary
        in each.
    """

    front: np.ndarray
    spheres: np.ndarray


def find_sides(mesh: Mesh, normals: Pseudonormals, winding: WindingNumber) -> Sides:
    """The sides of a mesh's faces."""
    corners = positions(mesh)[mesh.faces]
    edges, forth = edges_of(corners)
    faces_of = np.bincount(edges)
    net = np.bincount(edges, np.where(forth, 1.0, -1.0))
    triangles = winding.tree.frame.local(mesh.vertices)[mesh.faces]
    front = _in_front(triangles, normals, winding)
    front[(((faces_of != 2) | (net != 0)) & (faces_of != 1))[edges].reshape(-1, 3).any(axis=1)] = (
        np.nan
    )
    # the two faces of each edge that has two
    inner = np.flatnonzero(faces_of[edges] == 2)
    pairs = inner[np.argsort(edges[inner], kind="stable")].reshape(-1, 2) // 3
    apart = np.abs(front[pairs[:, 0]] - front[pairs[:, 1]]) > 0.5
    front[pairs[apart].ravel()] = np.nan
    side = np.flatnonzero(net[edges] != 0)
    _, first = np.unique(edges[side], return_index=True)
    side = side[first]
    ends = np.stack(
        [triangles.reshape(-1, 3)[side], np.roll(triangles, -1, axis=1).reshape(-1, 3)[side]],
        axis=1,
    )
    return Sides(front, _spheres(ends, np.abs(net[edges[side]])))


def _in_front(triangles: np.ndarray, normals: Pseudonormals, winding: WindingNumber) -> np.ndarray:
    """(F,) float64: the winding number above the middle of each face; NaN where it is flat."""
    normal = normals.normals[normals.features[:, 0]]
    x, y, z = normal.T
    length = np.sqrt(x * x + y * y + z * z)
    a, b, c = (triangles[:, i] for i in range(3))
    edges = np.stack([b - a, c - b, a - c])
    longest = np.sqrt((edges * edges)[..., 0] + (edges * edges)[..., 1] + (edges * edges)[..., 2])
    u, v = (b - a).T, (c - a).T
    area = np.stack([u[i - 2] * v[i - 1] - u[i - 1] * v[i - 2] for i in range(3)])
    double = np.sqrt(area[0] * area[0] + area[1] * area[1] + area[2] * area[2])
    known = (normals.flat == 0) & (length > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = double / longest.max(axis=0)
        points = (a + b + c) / 3 + normal * (ABOVE * height / length)[:, None]
    device = winding.device
    points[~known] = 0
    found = winding.at_local(device.put(points), len(points)).take()
    return np.where(known, found, np.nan)


def _spheres(ends: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(S, 5): spheres about runs of (E, 2, 3) edges along a Morton curve."""
    if not len(ends):
        return np.empty((0, 5))
    middles = ends.mean(axis=1)
    cells = ((middles + 1) * 512).clip(0, 1023).astype(np.int64)
    order = np.argsort(morton_encode(cells), kind="stable")
    spheres = []
    for run in np.array_split(order, min(SPHERES, len(order))):
        points = ends[run].reshape(-1, 3)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        x, y, z = (points - centre).T
        dx, dy, dz = (ends[run, 1] - ends[run, 0]).T
        lengths = weights[run] * np.sqrt(dx * dx + dy * dy + dz * dz)
        radius = np.sqrt((x * x + y * y + z * z).max())
        spheres.append([*centre, radius, float(np.cumsum(lengths)[-1])])
    return np.array(spheres)
