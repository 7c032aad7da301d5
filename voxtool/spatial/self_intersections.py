"""Self-intersections: faces of a mesh through which others pass.

Two triangles are apart if their projections on some axis are: the normals, the products of their
edges, and, where they are coplanar, the products of normals and edges [Gottschalk 1996]. If they
share a corner, a plane through it must separate them; if they share two, they must not fold back
onto each other. What rounding cannot decide counts as an intersection: edges that meet at an angle
of a, some 2e-17 / a apart.

Kernels: kernels/spatial/self_intersections.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.topology import positions

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.bvh import TriangleTree

SOURCE = "spatial/self_intersections.cl"


def find_self_intersections(device: Device, mesh: Mesh, tree: TriangleTree) -> np.ndarray:
    """Return the faces that another one meets outside their common corners and edges, (F,) bool.

    Faces without area do not count. The tree is that of the mesh, with names.
    """
    vertices, faces = device.put(tree.frame.local(mesh.vertices)), device.put(mesh.faces)
    corners = device.put(positions(mesh)[mesh.faces].astype(np.int32))
    found = device.zeros(len(mesh.faces), np.uint8)
    with device.stage("self-intersections"):
        device.kernel(SOURCE, "find_self_intersections")(
            tree.count, tree.names, vertices, faces, corners, tree.nodes, tree.first_leaf, found
        )
        return found.take() != 0
