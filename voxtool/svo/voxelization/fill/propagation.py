"""The voxels between flips, level by level ([voCCeL], section 3.2, fig. 3.6, listings A.2 and A.3).

Nodes are linked with their neighbours along x. The bricks of a string of neighbours are filled as
if its rows began outside. Where the string ends, a leaf of a level above follows, and the rows must
agree: inside, they flip the node of that level, which passes the flip on along its own string, and
so on up to the root. Then each node that was flipped flips its children, from the root down to the
bricks.

A flip is one bit of a node, so this serves only where the rows that enter a leaf agree: in closed
meshes whose grid ends in no leaf that is inside.

Kernels: kernels/svo/voxelization/fill/propagation.cl.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from voxtool.opencl import Array
from voxtool.svo.octree.build import DeviceOctree
from voxtool.svo.octree.layout import BRICK

SOURCE = "svo/voxelization/fill/propagation.cl"
NOWHERE = np.uint32(0xFFFFFFFF)


def propagate(tree: DeviceOctree, flips: Array, shape: tuple[int, int, int]) -> Array | None:
    """Return the (8 n,) uint64 bricks between the flips of n level-1 nodes, and mark the leaves of
    the tree that are INSIDE; None if rows that enter a leaf differ, or a leaf that is inside
    reaches beyond the grid. All rows begin outside."""
    device, nodes, top = tree.nodes.device, tree.nodes, tree.top
    kernels = {
        name: tree.kernel(SOURCE, name)
        for name in ("stitch_level", "concatenate_bricks", "flip_level1", "flip_level",
                     "concatenate_level", "propagate_level", "propagate_bricks")
    }  # fmt: skip
    # of each level from the root down to level 1: its first node, and that of the level below
    levels = list(pairwise(tree.offsets[:-1].tolist()))
    last, bricks_of = levels[-1]
    before, after = (device.put(np.full(nodes.size, NOWHERE)) for _ in range(2))
    for first, below in levels:
        kernels["stitch_level"](below - first, nodes, first, below, before, after)

    bricks, open_ = device.empty(flips.size, BRICK), device.zeros(1, np.uint32)
    kernels["concatenate_bricks"](flips.size, before, after, bricks_of, flips, bricks)
    flip, inside = device.zeros(bricks_of, np.uint8), device.zeros(bricks_of, np.uint8)
    for first, below in reversed(levels):
        sized = below - first
        if first == last:
            kernels["flip_level1"](sized, nodes, after, first, below, bricks, flip)
        else:
            kernels["flip_level"](sized, nodes, after, first, below, flip)
        kernels["concatenate_level"](sized, before, after, first, flip, inside, open_)

    for level, (first, below) in zip(range(top, 0, -1), levels, strict=True):
        above = tree.refined[min(level, top - 1)].codes
        side = 4 << level
        kernels["propagate_level"](
            below - first, nodes, above, level == top, first, below, side, shape,
            level == 1, inside, open_,
        )  # fmt: skip
    level1 = tree.refined[0]
    kernels["propagate_bricks"](
        level1.n, level1.codes, level1.parent_index, top == 1, last, shape, inside, bricks
    )
    return None if open_.take()[0] else bricks
