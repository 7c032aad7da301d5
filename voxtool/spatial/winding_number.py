"""The generalized winding number of a triangle mesh.

Jacobson et al., "Robust inside-outside segmentation using generalized winding numbers" (2013): the
solid angle that the faces subtend, by 4 pi: 1 inside of a closed mesh that faces outward, 0 outside
of it, and in between where a mesh is open. Barill et al., "Fast winding numbers for soups and
clouds" (2018): what is further away than REACH times its radius counts through the Taylor series of
its moments, here to the third order (octupoles), about the middles of the boxes of the tree; nearer
triangles exactly, by van Oosterom and Strackee. The error was at most 8e-4, and 1.7e-4 in the root
mean square, over 8,550 points in and around the teapot, fandisk, bunny and armadillo, two thirds of
them near the surface; with 2 radii 4.7e-3 and 1.1e-3, in about half of the time. The sums are made
in one order, that of the tree.

Kernels: kernels/spatial/winding_number.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.opencl import Array, Device, default_device, program
from voxtool.spatial.bvh import ARITY, TriangleTree, build_tree
from voxtool.spatial.distance import at_points

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

SOURCE = "spatial/winding_number.cl"
MOMENTS = 23  # numbers of a child: centre (3), squared reach, moments of order 1, 2, 3 (3, 6, 10)
FAR_BITS = 60  # from 2**60 extents on, the number is 0
REACH = 3.0  # radii

HEADERS = {"spatial/winding_number.h": program.c_constants(MOMENTS=MOMENTS, FAR_BITS=FAR_BITS)}


class WindingNumber:
    """The winding number of a mesh, whose moments are computed once and asked many times."""

    def __init__(
        self,
        mesh: Mesh,
        device: Device | None = None,
        *,
        tree: TriangleTree | None = None,
        reach: float = REACH,
    ) -> None:
        """Compute the moments.

        Parameters
        ----------
        tree : of the mesh on this device, if there is one.
        reach : in radii, from which on a node counts through its moments.

        Raises
        ------
        MeshError, DeviceError : as TriangleDistance.
        """
        self.device = device or default_device()
        self.tree = tree or build_tree(self.device, mesh)
        self.reach = np.float64(reach)
        with self.device.stage("moments"):
            self.moments = self._sum_moments()

    def _sum_moments(self) -> Array:
        """Of the leaves, then level by level up; children in their order."""
        device, tree = self.device, self.tree
        parts = tree.parts()
        first, count = parts[-1]
        moments = device.empty((first + count) * MOMENTS * ARITY, np.float64)
        device.kernel(SOURCE, "leaf_moments")(
            count * ARITY,
            tree.leaves,
            np.uint32(tree.count),
            tree.nodes,
            np.uint32(first),
            self.reach,
            moments,
        )
        for (first, count), (child, children) in zip(parts[-2::-1], parts[:0:-1], strict=True):
            device.kernel(SOURCE, "node_moments")(
                count * ARITY,
                np.uint32(child),
                np.uint32(children),
                tree.nodes,
                np.uint32(first),
                self.reach,
                moments,
            )
        return moments

    def __call__(self, points: Any) -> np.ndarray:
        """The winding number of each point: inside where it is more than 0.5.

        Parameters
        ----------
        points : (N, 3) numbers, world units.

        Returns
        -------
        (N,) float64; on the surface, something between the numbers of both sides.

        Raises
        ------
        VoxtoolError : as TriangleDistance.
        """
        with self.device.stage("winding number"):
            return at_points(self.device, self.tree, points, self._wind)

    def at_local(self, points: Array, n: int) -> Array:
        """The numbers of n points on the device, (n, 3) float64 in the frame of the tree: (n,)
        float64; as the call, for points that are near each other where they follow each other."""
        order, found = (self.device.put(np.arange(n, dtype=np.uint32)),
                        self.device.empty(n, np.float64))  # fmt: skip
        with self.device.stage("winding number"):
            self._wind(n, points, order, "double", found)
        order.release()
        return found

    def _wind(self, n: int, points: Array, order: Array, _box: str, found: Array) -> None:
        self.device.kernel(SOURCE, "wind")(
            n,
            points,
            order,
            np.uint32(n),
            self.tree.leaves,
            np.uint32(self.tree.count),
            np.uint32(self.tree.first_leaf),
            self.moments,
            found,
        )
