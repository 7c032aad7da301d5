"""Voxels up to a number of steps from a surface, and the outside grown by steps, brick by brick.

A step leads to a voxel that shares a face, an edge or a corner, so the voxels within `steps` of one
voxel are a cube, and a surface is dilated along one axis after the other. Kernels:
kernels/svo/voxelization/fill/dilation.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.opencl import Array
from voxtool.opencl.primitives import exclusive_scan, radix_sort, unique
from voxtool.svo.octree.build import DeviceOctree, code_name
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE
from voxtool.svo.voxelization.plan import CELL

SOURCE = "svo/voxelization/fill/dilation.cl"


def reached_nodes(codes: Array, n: int, masks: Array, steps: int, bits: int) -> tuple[Array, int]:
    """Return the ascending Morton codes, of `bits` bits, of n level-1 nodes and of those that hold
    a voxel up to `steps` steps from theirs, and their number; a few more may be among them."""
    device = codes.device
    list_reached = device.kernel(SOURCE, "list_reached", CODE=code_name(codes.dtype))
    known: Array | None = masks
    while steps:
        reach = (steps - 1) % CELL + 1  # later rounds lead on from whole nodes by whole nodes
        firsts = device.empty(n + 1, np.uint32)
        list_reached(n, codes, known, reach, firsts, None)
        total = exclusive_scan(firsts, n)
        found = device.empty(total, codes.dtype)
        list_reached(n, codes, known, reach, firsts, found)
        codes, n = unique(radix_sort(found, total, bits)[0], total)
        known, steps = None, steps - reach
    return codes, n


def dilate(tree: DeviceOctree, beside: Array, masks: Array, steps: int) -> Array:
    """Return the masks of all voxels up to `steps` steps from those of the bricks' masks.

    `beside` holds what lies around each level-1 node of the tree; every voxel that is reached lies
    in one of them.
    """
    for done in range(0, steps, BRICK_SIDE):
        for axis in range(3):
            grown = masks.device.empty(masks.size, BRICK)
            dilate_along = tree.kernel(SOURCE, "dilate_along")
            dilate_along(masks.size, beside, axis, min(steps - done, BRICK_SIDE), masks, grown)
            masks = grown
    return masks


def grow_outside(
    tree: DeviceOctree, beside: Array, states: Array, barrier: Array, outside: Array, steps: int
) -> Array:
    """Return the masks of the outside after a number of steps within the barrier."""
    for _ in range(steps):
        grown = outside.device.empty(outside.size, BRICK)
        tree.kernel(SOURCE, "grow_outside")(outside.size, beside, states, barrier, outside, grown)
        outside = grown
    return outside
