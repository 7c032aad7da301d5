"""The faces that lines cross, counted on either side of a point of the mesh.

Every line is sheared onto an axis, after which a crossing is decided by the signs of three areas;
neighbours compute the area of their common edge from the same numbers, so no line passes between
them [Woop 2013]. A line through an edge is moved by an infinitesimal. If a line passes through a
point of a face, crossings as near as single precision of coordinates are left out: they are of
copies of that face. Kernels: kernels/spatial/crossings.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.bvh import TriangleTree
    from voxtool.spatial.distance import PointBlock

SOURCE = "spatial/crossings.cl"
TOUCHING_BITS = 24  # crossings within 2**-24 of the point, in local units, are left out
HEADERS = {"spatial/crossings.h": program.c_constants(TOUCHING_BITS=TOUCHING_BITS)}


def row_crossings(
    device: Device, mesh: Mesh, tree: TriangleTree, block: PointBlock
) -> tuple[np.ndarray, np.ndarray]:
    """Return how many faces the row along x through each point of a block crosses before it, (n,)
    uint32, and how many of them enter minus how many leave, (n,) int32. The tree has all faces."""
    n = block.n
    counts, numbers = device.zeros(n, np.uint32), device.zeros(n, np.int32)
    surface = (device.put(tree.frame.local(mesh.vertices)), device.put(mesh.faces))
    boxes = (tree.face_of, tree.count, tree.nodes, tree.first_leaf)
    with device.stage("crossings of lines"):
        count = device.kernel(SOURCE, "count_before")
        count(n, block.local, block.order, *surface, *boxes, counts, numbers)
    return counts.take(), numbers.take()


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
