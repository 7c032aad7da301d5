"""Traversal of the octree along rows of voxel centres in x ([voCCeL], section 3.2, fig. 3.6).

A work-item traverses the octree along a bundle of 8 x 8 rows, from low x to high. The flips of a
level-1 node change the states of the rows. A leaf above level 0 is inside if all rows through it
are inside. Kernels: kernels/svo/fill/rows.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.opencl import Array, program
from voxtool.svo.build import DeviceOctree
from voxtool.svo.fill.crossings import Flips

SOURCE = "svo/fill/rows.cl"
MIXED = np.uint32(1 << 29)  # a leaf that must be refined
HEADERS = {"svo/fill/rows.h": program.c_constants(MIXED=MIXED)}


def walk_rows(tree: DeviceOctree, flips: Flips) -> tuple[Array, int]:
    """Mark leaves of the tree as INSIDE, or as MIXED if only some of their rows are inside. Return
    the states of rows where they enter the level-1 nodes, (n,) uint64, and the number of MIXED
    leaves."""
    device, coarse = tree.nodes.device, int(tree.offsets[-2])
    entries = device.empty(tree.refined[0].n, np.uint64)
    fills = device.zeros(coarse, np.uint32)
    sweep_rows(tree, flips, entries=entries, fills=fills)
    unresolved = device.zeros(1, np.uint32)
    offsets = device.put(tree.offsets)
    tree.kernel(SOURCE, "mark_leaves")(coarse, tree.nodes, offsets, tree.top, fills, unresolved)
    return entries, int(unresolved.take()[0])


def sweep_rows(
    tree: DeviceOctree,
    flips: Flips,
    *,
    entries: Array | None = None,
    fills: Array | None = None,
    states: Array | None = None,
    chosen: np.ndarray | None = None,
) -> None:
    """Traverse all rows and record the states where they enter level-1 nodes in `entries`, and how
    leaves are filled in `fills`; or traverse the chosen bundles and record their `states` in the
    leaves that are to be refined."""
    device = tree.nodes.device
    tree.kernel(SOURCE, "sweep_rows")(
        flips.bundles if chosen is None else len(chosen), nodes=tree.nodes,
        offsets=device.put(tree.offsets), top=tree.top, shape=flips.shape,
        chosen=None if chosen is None else device.put(chosen), entry=flips.entry,
        bricks=flips.bricks, entries=entries, fills=fills, states=states,
    )  # fmt: skip
