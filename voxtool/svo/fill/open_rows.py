"""Refinement of leaves in which some rows are inside and some outside.

No triangle touches such a leaf. It exists if the mesh is open, or if the grid ends in the leaf. It
is refined until all voxels of every leaf are equal, so that the octree holds exactly the set that
the fill rule defines.
"""

from __future__ import annotations

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.build import DeviceOctree
from voxtool.svo.fill.crossings import Flips
from voxtool.svo.fill.rows import MIXED, sweep_rows
from voxtool.svo.layout import BRICK_BYTES, LINK, MAX_LINK, NODE_BYTES, VALID

ALL_ROWS = np.uint64(0xFFFFFFFFFFFFFFFF)


def refine_open_rows(
    tree: DeviceOctree, flips: Flips, max_memory: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Refine the MIXED leaves of a tree; raise MemoryLimitError if this takes more than max_memory
    bytes. Return the ascending Morton codes of the refined nodes by level, from level 1 up, and the
    (n,) uint32 positions of the tree's level-1 nodes among them."""
    nodes = tree.nodes.get(0, int(tree.offsets[-2]))
    leaves = np.flatnonzero((nodes["child"] & (VALID | MIXED)) == MIXED)
    level, cells = _locate(tree, nodes["parent"], leaves)
    slots = np.concatenate([[0], np.cumsum(4 ** (level - 1))])  # bundles through each leaf
    refuse_beyond(tree, 0, int(slots[-1]), max_memory)
    nodes["child"][leaves] = slots[:-1] + 1
    device = tree.nodes.device
    device.write(tree.nodes, nodes)
    states = device.zeros(int(slots[-1]), np.uint64)
    sweep_rows(tree, flips, states=states, chosen=_bundles_of(cells, level, flips))
    found = states.take()

    bars = []
    for number in np.unique(level):
        chosen = level == number
        side = 1 << (int(number) - 1)
        layers = found[slots[:-1][chosen][:, None] + np.arange(side * side)]
        layers = layers.reshape(-1, side, side)
        bars += _differing_bars(layers, cells[chosen], int(number), flips.shape[0])
    added = sum(int(lengths.sum()) for _, _, lengths in bars)
    refuse_beyond(tree, added, 0, max_memory)
    return _merge(tree, bars)


def _merge(
    tree: DeviceOctree, bars: list[tuple[int, np.ndarray, np.ndarray]]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the refined nodes of a tree and of bars, as refine_open_rows does."""
    lists = [refined.codes.get(0, refined.n) for refined in tree.refined]
    added: list[list[np.ndarray]] = [[] for _ in lists]
    for number, first, lengths in bars:
        added[number - 1].append(_codes_of_bars(first, lengths).astype(lists[0].dtype))
    new = [
        np.sort(np.concatenate([old[:0], *parts])) for old, parts in zip(lists, added, strict=True)
    ]
    places = [np.searchsorted(old, codes) for old, codes in zip(lists, new, strict=True)]
    merged = [np.insert(*each) for each in zip(lists, places, new, strict=True)]
    before = np.bincount(places[0], minlength=len(lists[0]) + 1)[:-1]
    return merged, (np.arange(len(lists[0])) + np.cumsum(before)).astype(np.uint32)


def _bundles_of(cells: np.ndarray, level: np.ndarray, flips: Flips) -> np.ndarray:
    """Return the bundles whose rows pass through leaves, without duplicates."""
    passed = np.zeros((flips.bundles // flips.bundles_y, flips.bundles_y), bool)
    for number in np.unique(level):
        across = np.arange(1 << (int(number) - 1))
        y = cells[level == number, 1, None] + across
        z = cells[level == number, 2, None] + across
        y, z = np.minimum(y, passed.shape[1] - 1), np.minimum(z, passed.shape[0] - 1)
        passed[z[:, :, None], y[:, None, :]] = True
    return np.flatnonzero(passed).astype(np.uint32)


def _locate(
    tree: DeviceOctree, parents: np.ndarray, leaves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the levels of nodes and their low corners in level-1 cells, (n, 3) int64."""
    depth = np.searchsorted(tree.offsets, leaves, side="right") - 1
    level = tree.top - depth
    codes = np.zeros(len(leaves), np.uint64)
    node = leaves - tree.offsets[depth]
    for step in range(int(depth.max())):
        below = depth > 0  # not at the root yet
        octant = (node & 7).astype(np.uint64) << np.uint64(3 * step)
        codes[below] |= octant[below]
        parent = parents[tree.offsets[depth] + node] & LINK
        node = np.where(below, parent, node)
        depth = np.where(below, depth - 1, depth)
    return level, morton_decode(codes) << (level - 1)[:, None]


def refuse_beyond(tree: DeviceOctree, added: int, slots: int, max_memory: int) -> None:
    """Raise MemoryLimitError if a tree with added refined nodes and slots does not fit."""
    nodes = int(tree.offsets[-1]) + 8 * added
    needed = nodes * (NODE_BYTES + 2 * BRICK_BYTES) + 8 * slots  # moving copies the bricks
    if max(nodes, slots) >= MAX_LINK or needed > max_memory:
        raise MemoryLimitError(
            f"the fill leaks from this open mesh and refines the octree to {nodes:,} nodes, "
            f"{human(needed)}, more than fits: close the mesh, or choose a smaller dim or a "
            "surface mode"
        )


def _differing_bars(
    layers: np.ndarray, corners: np.ndarray, level: int, nx: int
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return the nodes in leaves of one level whose voxels differ, as bars along x: for each level
    up to that of the leaves, its number, the (m, 3) first nodes of bars, and their (m,) lengths.

    `layers` holds the states of the leaves' bundles, (n, side, side) uint64 [leaf, z, y], and
    `corners` their (n, 3) low corners in level-1 cells. Along x, a leaf changes only where the grid
    ends, at voxel nx.
    """
    bars = []
    every, some = layers, layers
    for number in range(1, level + 1):
        size = 1 << (number - 1)  # of a node, in cells
        places = 1 << (level - number)  # nodes along x in a leaf
        if number > 1:
            every = _halve(every, np.bitwise_and)
            some = _halve(some, np.bitwise_or)
        whole = np.clip(
            (nx // 8 - corners[:, 0]) // size, 0, places
        )  # nodes before the end of the grid
        cut = (whole < places) & (8 * (corners[:, 0] + size * whole) < nx)  # the end lies in a node

        leaf, k, j = np.nonzero((some != 0) & (every != ALL_ROWS))
        first = corners[leaf] // size + np.stack([np.zeros_like(j), j, k], axis=1)
        bars.append((number, first, whole[leaf]))

        leaf, k, j = np.nonzero((some != 0) & cut[:, None, None])
        first = corners[leaf] // size + np.stack([whole[leaf], j, k], axis=1)
        bars.append((number, first, np.ones_like(leaf)))
    return bars


def _codes_of_bars(first: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the Morton codes of the nodes of bars along x."""
    nodes = np.repeat(first, lengths, axis=0)
    nodes[:, 0] += np.arange(len(nodes)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return morton_encode(nodes)


def _halve(layers: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combine 2 x 2 bundles into one."""
    rows = combine(layers[:, 0::2], layers[:, 1::2])
    return combine(rows[:, :, 0::2], rows[:, :, 1::2])
