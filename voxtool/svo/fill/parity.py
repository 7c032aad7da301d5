"""Filling between flips ([voCCeL], section 3.2).

A voxel is inside if the number of flips up to it along x is odd. If every crossing of the mesh
makes a flip, this is the parity rule. Kernels: kernels/svo/fill/rows.cl.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device
from voxtool.svo.build import DeviceOctree, build_from_lists
from voxtool.svo.fill.crossings import Flips
from voxtool.svo.fill.open_rows import refine_open_rows
from voxtool.svo.fill.rows import SOURCE, walk_rows
from voxtool.svo.layout import BRICK


@dataclass(frozen=True)
class Filled:
    """An octree on the device with its inside voxels and leaves."""

    tree: DeviceOctree
    bricks: Array  # (8 n,) uint64 masks
    # (m,) uint32 index of each active node among the refined level-1 nodes; None if they are equal
    positions: np.ndarray | None


def fill_rows(tree: DeviceOctree, flips: Flips, max_memory: int) -> Filled:
    """Return the octree of the active nodes, filled between flips; changes the tree's nodes and the
    flips' bricks. Raises MemoryLimitError if an open mesh needs an octree of more than max_memory
    bytes, which a plan cannot predict."""
    device, positions = tree.nodes.device, None
    with device.stage("rows"):
        entries, unresolved = walk_rows(tree, flips)
    if unresolved:
        with device.stage("refine open rows"):
            lists, positions = refine_open_rows(tree, flips, max_memory)
            tree = build_from_lists(device, lists)
            flips = replace(flips, bricks=_move(flips.bricks, positions, tree.refined[0].n))
            entries, unresolved = walk_rows(tree, flips)
            if unresolved:
                raise VoxtoolError(
                    f"{unresolved} leaves are neither inside nor outside: report this mesh"
                )
    with device.stage("fill"):
        level1 = tree.refined[0]
        fill_bricks = tree.kernel(SOURCE, "fill_bricks")
        fill_bricks(level1.n, level1.codes, flips.shape, entries, flips.bricks)
    return Filled(tree, flips.bricks, positions)


def _move(bricks: Array, positions: np.ndarray, n: int) -> Array:
    """Return the bricks moved to the new positions of their nodes, with zeros between them."""
    device = bricks.device
    moved = device.zeros(8 * n, BRICK)
    move_bricks = device.kernel(SOURCE, "move_bricks", CODE="uint")
    move_bricks(bricks.size, bricks, device.put(positions), moved)
    return moved


def unite(device: Device, filled: Filled, added: Array) -> None:
    """Add the voxels of the active nodes' bricks `added`."""
    positions = filled.positions
    if positions is None:
        positions = np.arange(added.size // 8, dtype=np.uint32)
    unite_bricks = device.kernel(SOURCE, "unite_bricks", CODE="uint")
    unite_bricks(added.size, added, device.put(positions), filled.bricks)
