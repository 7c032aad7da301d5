"""The faces that lines cross, counted on either side of a point of the mesh.

Every line is sheared onto an axis, after which a crossing is decided by the signs of three areas;
neighbours compute the area of their common edge from the same numbers, so no line passes between
them [Woop 2013]. A line through an edge is moved by an infinitesimal. Crossings as near as single
precision of coordinates are left out: they are of copies of the point's face. Kernels:
kernels/spatial/crossings.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.bvh import TriangleTree

SOURCE = "spatial/crossings.cl"
TOUCHING_BITS = 24  # crossings within 2**-24 of the point, in local units, are left out
HEADERS = {"spatial/crossings.h": program.c_constants(TOUCHING_BITS=TOUCHING_BITS)}


def count_crossings(
    device: Device,
    mesh: Mesh,
    tree: TriangleTree,
    points: np.ndarray,
    along: np.ndarray,
    own: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many faces of a tree of the mesh lines cross ahead of their points and behind
    them, (n,) uint32 each.

    points, along : (n, 3) float64, points on the mesh and directions of any length, local
    coordinates; own : (n,) the face on which each point lies, which does not count.
    """
    n = len(points)
    ahead, behind = device.empty(n, np.uint32), device.empty(n, np.uint32)
    lines = (device.put(points), device.put(along), device.put(own.astype(np.uint32)))
    surface = (device.put(tree.frame.local(mesh.vertices)), device.put(mesh.faces))
    with device.stage("crossings of lines"):
        count = device.kernel(SOURCE, "count_crossings")
        boxes = (tree.face_of, tree.count, tree.nodes, tree.first_leaf)
        count(n, *lines, *surface, *boxes, ahead, behind)
    return ahead.take(), behind.take()
