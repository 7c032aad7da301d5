"""The generalized winding number of a triangle mesh.

The winding number [Jacobson 2013] is the solid angle that the faces subtend, over 4 pi: 1 inside of
a closed mesh whose faces point outward, 0 outside of it, and in between where a mesh is open. After
[Barill 2018], nodes of the tree farther away than REACH times their radius count through the Taylor
series of their moments, here to the third order (octupoles) about the centres of their boxes;
nearer triangles count exactly [Oosterom 1983]. Over 8,550 points in and around the teapot,
fandisk, bunny and armadillo, two thirds of them near the surface, the error was at most 8e-4 and
1.7e-4 RMS; with a reach of 2 radii 4.7e-3 and 1.1e-3, in about half of the time. All sums are made
in one order, that of the tree. Faces about crowded vertices and edges are summed by fans.py. Faces
that repeat count once (net_faces in mesh/topology.py).

Kernels: kernels/spatial/winding_number.cl and moments.h.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.mesh.topology import net_faces
from voxtool.opencl import Array, Device, default_device, program
from voxtool.spatial.bvh import ARITY, LEAF, TriangleTree, build_tree
from voxtool.spatial.distance import PointBlock, checked_points, point_blocks
from voxtool.spatial.fans import find_fans

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh

SOURCE = "spatial/winding_number.cl"
MOMENTS = 23  # numbers of a child: centre (3), squared reach, moments of order 1, 2, 3 (3, 6, 10)
FAR_BITS = 60  # beyond 2**60 extents the number is 0
REACH = 3.0  # radii


def moment_bytes(faces: int) -> int:
    """Return the bytes on the device of the moments of a number of faces."""
    return 8 * MOMENTS * (-(-faces // LEAF) * 8 // 7 + 8 * ARITY)


HEADERS = {"spatial/winding_number.h": program.c_constants(MOMENTS=MOMENTS, FAR_BITS=FAR_BITS)}


class WindingNumber:
    """The winding number of a mesh. The moments are computed once, for any number of calls."""

    def __init__(
        self,
        mesh: Mesh,
        device: Device | None = None,
        *,
        tree: TriangleTree | None = None,
        reach: float = REACH,
        repeats: bool = True,
    ) -> None:
        """Compute the moments, on a given tree of the mesh, or a new one if faces repeat. A
        node farther away than `reach` radii counts through its moments. With `repeats` False, every
        copy of a face counts. Raises as TriangleDistance."""
        self.device = device or default_device()
        self.counted = net_faces(mesh) if repeats else None  # faces; None for all
        some, self.fans = self.counted, []
        if repeats:
            self.fans, in_fan = find_fans(mesh, some, self.device)
            if self.fans:
                some = np.flatnonzero(~in_fan) if some is None else some[~in_fan[some]]
        self.all_in_fans = some is not None and not len(some)
        if tree is None or (some is not None and not self.all_in_fans):
            tree = build_tree(self.device, mesh, some=None if self.all_in_fans else some)
        self.tree = tree
        self.reach = reach
        with self.device.stage("moments"):
            self.moments = self._sum_moments()

    def _sum_moments(self) -> Array:
        """Return the moments of the leaves, then of the nodes, level by level up; children in
        order."""
        device, tree = self.device, self.tree
        parts = tree.parts()
        first, count = parts[-1]
        moments = device.empty((first + count) * MOMENTS * ARITY, np.float64)
        device.kernel(SOURCE, "leaf_moments")(
            count * ARITY, tree.leaves, tree.count, tree.nodes, first, self.reach, moments
        )
        for (first, count), (child, children) in zip(parts[-2::-1], parts[:0:-1], strict=True):
            device.kernel(SOURCE, "node_moments")(
                count * ARITY, child, children, tree.nodes, first, self.reach, moments
            )
        return moments

    def __call__(self, points: Any) -> np.ndarray:
        """Return the winding number of each of (N, 3) points, (N,) float64; above 0.5 is inside.

        On the surface it is between the numbers of both sides. Raises as TriangleDistance.
        """
        world = checked_points(points)
        numbers = np.empty(len(world))
        for block in point_blocks(self.device, self.tree, world):
            numbers[block.where] = self.at_block(block)
        return numbers

    def at_block(self, block: PointBlock) -> np.ndarray:
        """Return the winding numbers of a block's points, (n,) float64."""
        numbers = self.device.zeros(block.n, np.float64)
        self.wind(block.n, block.local, block.order, numbers)
        return numbers.take()

    def at_local(self, points: Array, n: int) -> Array:
        """Return the winding numbers of n points on the device, (n, 3) float64, local coordinates;
        fast if consecutive points are near each other."""
        numbers = self.device.zeros(n, np.float64)
        self.wind(n, points, self.device.put(np.arange(n, dtype=np.uint32)), numbers)
        return numbers

    def wind(self, n: int, points: Array, which: Array, numbers: Array) -> None:
        """Replace the zeros in `numbers` at `which` n points, uint32, by their winding numbers;
        fast if consecutive ones are near each other."""
        tree = self.tree
        with self.device.stage("winding number"):
            wind = self.device.kernel(SOURCE, "wind")
            rest = (tree.leaves, tree.count, tree.first_leaf, self.moments)
            wind(0 if self.all_in_fans else n, points, which, *rest, numbers)
            for fan in self.fans:
                fan.add_numbers(n, points, which, numbers)
