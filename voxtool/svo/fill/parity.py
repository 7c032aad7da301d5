"""Fill by flips: from the voxels at which rows change to the inside ([voCCeL], section 3.2).

A voxel is inside where the number of flips up to it along x is odd. With a flip for every crossing
of the mesh that is the parity rule. Kernels: kernels/svo/fill/rows.cl.
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
    """An octree on the device with its inside voxels and leaves.

    Attributes
    ----------
    tree : the nodes; bricks : (8 n,) uint64 masks.
    positions : (m,) uint32 where the active nodes are among the refined level-1 nodes, or None if
        they are all of them.
    """

    tree: DeviceOctree
    bricks: Array
    positions: np.ndarray | None


def fill_rows(tree: DeviceOctree, flips: Flips, max_memory: int) -> Filled:
    """The octree with what is inside between flips.

    Parameters
    ----------
    tree : of the active nodes; its nodes are changed.
    flips : of the active nodes; their bricks are changed.
    max_memory : bytes that the octree of an open mesh may take, which no plan can predict.

    Raises
    ------
    MemoryLimitError : it would take more.
    """
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
    """The bricks at their nodes' new places among n, zero elsewhere."""
    device = bricks.device
    moved = device.zeros(8 * n, BRICK)
    move_bricks = device.kernel(SOURCE, "move_bricks", CODE="uint")
    move_bricks(bricks.size, bricks, device.put(positions), moved)
    return moved


def unite(device: Device, filled: Filled, added: Array) -> None:
    """Set the voxels of the active nodes' bricks `added`, too."""
    positions = filled.positions
    if positions is None:
        positions = np.arange(added.size // 8, dtype=np.uint32)
    unite_bricks = device.kernel(SOURCE, "unite_bricks", CODE="uint")
    unite_bricks(added.size, added, device.put(positions), filled.bricks)
