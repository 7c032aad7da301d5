"""Walking the rows of voxel centres along x through the octree ([voCCeL], section 3.2, fig. 3.6).

Rows go in bundles of 8 x 8. A bundle walks the octree from low x to high: at a level-1 node its
flips turn the state of the bundle's rows, and a leaf above is inside where every bundle through it
says so. Kernels: kernels/svo/fill/rows.cl.
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
    """The states of rows where they enter each level-1 node, (n,) uint64; and the number of leaves
    that are neither inside nor outside, and are now MIXED. Inside leaves are marked in the tree."""
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
    """Walk all rows, and record the `entries` of level-1 nodes and what `fills` each leaf; or walk
    the chosen bundles, and record their `states` in the leaves to refine."""
    device = tree.nodes.device
    tree.kernel(SOURCE, "sweep_rows")(
        flips.bundles if chosen is None else len(chosen),
        nodes=tree.nodes,
        offsets=device.put(tree.offsets),
        top=tree.top,
        shape=flips.shape,
        chosen=None if chosen is None else device.put(chosen),
        entry=flips.entry,
        bricks=flips.bricks,
        entries=entries,
        fills=fills,
        states=states,
    )
