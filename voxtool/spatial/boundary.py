"""The boundary of a mesh, by which its winding number changes.

Along a path that passes no face the winding number changes with the shape of the boundary alone. By
the law of Biot and Savart its gradient is at most the sum of dl / (4 pi r^2) over the edges of the
boundary. Where holes are far enough away, the number at one point therefore decides others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.topology import boundary_of
from voxtool.morton import morton_encode
from voxtool.vector import length

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.bvh import Frame

SPHERES = 512  # that enclose the boundary, at most


def boundary_spheres(mesh: Mesh, some: np.ndarray | None, frame: Frame) -> np.ndarray:
    """Return spheres that enclose the boundary of the faces of a mesh, or of `some` of them, (S, 5)
    float64: centre and radius in local coordinates, and the length of the boundary in each."""
    corners = mesh.positions[mesh.faces]
    edges = boundary_of(corners if some is None else corners[some])
    if not len(edges):
        return np.empty((0, 5))
    vertex = np.empty(mesh.positions.max() + 1, np.int64)
    vertex[mesh.positions] = np.arange(len(mesh.positions))
    ends = frame.local(mesh.vertices)[vertex[edges]]
    order, spheres = along_curve(ends.mean(axis=1)), []
    for run in np.array_split(order, min(SPHERES, len(order))):
        points = ends[run].reshape(-1, 3)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = length(points - centre).max()
        lengths = length(ends[run, 1] - ends[run, 0])
        spheres.append([*centre, radius, float(np.cumsum(lengths)[-1])])
    return np.array(spheres)


def along_curve(points: np.ndarray) -> np.ndarray:
    """Return an order of (n, 3) local points in which near ones follow each other."""
    cells = ((points + 1) * 512).clip(0, 1023).astype(np.int64)
    return np.argsort(morton_encode(cells), kind="stable")
