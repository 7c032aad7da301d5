"""Subtrees of an octree as the states of their nodes, and the octree that they make together.

A window of a grid, a cube whose side is a power of two and whose corner is a multiple of it, is a
subtree of the grid's octree: voxelized by itself it has the same nodes and bricks. A node's links
follow from the states of the nodes before it, so a byte a node is all that is kept of a window
until the octree is written; its bricks wait elsewhere, in the order of the windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.svo.layout import BRICK_SIDE, INSIDE, NODE, VALID
from voxtool.svo.octree import Octree
from voxtool.svo.prune import EMPTY, FULL, REFINED, states_of

BLOCK = 1 << 17  # nodes whose children are linked at once


@dataclass(frozen=True)
class Subtree:
    """A node and all below it.

    levels : the (n,) uint8 states of the nodes of each level, from the root down to level 1;
    bricks : their number.
    """

    levels: tuple[np.ndarray, ...]
    bricks: int

    @property
    def root(self) -> int:
        """The state of the root."""
        return int(self.levels[0][0])


def empty_subtree(side: int) -> Subtree:
    """Return the subtree of a cube without voxels."""
    depth = (side // (2 * BRICK_SIDE)).bit_length()
    none = np.empty(0, np.uint8)
    return Subtree((np.full(1, EMPTY, np.uint8), *[none] * (depth - 1)), 0)


def subtree_of(octree: Octree, side: int) -> Subtree:
    """Return an octree as the subtree of a cube of `side` voxels, of which it is the low corner."""
    levels = tuple(states_of(octree.offsets, octree.nodes)[::-1])
    found = Subtree(levels, len(octree.bricks))
    while (2 * BRICK_SIDE) << (len(found.levels) - 1) < side:
        beyond = empty_subtree((2 * BRICK_SIDE) << (len(found.levels) - 1))
        found = joined([found, *[beyond] * 7])
    return found


def joined(children: Sequence[Subtree]) -> Subtree:
    """Return the subtree of eight, in Morton order: a leaf if all of them are empty, or full."""
    roots = np.concatenate([child.levels[0] for child in children])
    below = [
        np.concatenate(states) for states in zip(*(c.levels[1:] for c in children), strict=True)
    ]
    bricks = sum(child.bricks for child in children)
    if (roots == EMPTY).all() or (roots == FULL).all():
        return Subtree((roots[:1], roots[:0], *below), bricks)
    return Subtree((np.full(1, REFINED, np.uint8), roots, *below), bricks)


def offsets_of(tree: Subtree) -> np.ndarray:
    """Return the (depth + 1,) int64 offsets of the levels among the nodes of the octree."""
    sizes = [len(states) for states in tree.levels] + [tree.bricks]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def nodes_of(tree: Subtree) -> Iterator[np.ndarray]:
    """Yield the linked nodes of the octree, in blocks of NODE, root first."""
    root = _linked(np.zeros(1, "<u4"), tree.levels[0], 0)
    root["parent"] = 0
    yield root
    for above, own in zip(tree.levels, [*tree.levels[1:], None], strict=True):
        ranks = 0  # refined nodes above, and in this level, before the block
        first_child = 0
        for start in range(0, len(above), BLOCK):
            refined = (start + np.flatnonzero(above[start : start + BLOCK] == REFINED)).astype(
                "<u4"
            )
            parents = np.repeat(refined.astype("<u4"), 8)
            if own is None:
                nodes = np.empty(len(parents), NODE)
                nodes["child"] = VALID | np.arange(8 * ranks, 8 * ranks + len(parents), dtype="<u4")
                nodes["parent"] = VALID | parents
            else:
                states = own[8 * ranks : 8 * ranks + len(parents)]
                nodes = _linked(parents, states, first_child)
                first_child += 8 * int(np.count_nonzero(states == REFINED))
            ranks += len(refined)
            yield nodes


def _linked(parents: np.ndarray, states: np.ndarray, first_child: int) -> np.ndarray:
    """Return the nodes with these states and parents, whose first child has this index."""
    nodes = np.zeros(len(states), NODE)
    refined = np.flatnonzero(states == REFINED)
    nodes["parent"] = VALID | parents
    nodes["child"][states == FULL] = INSIDE
    children = first_child + 8 * np.arange(len(refined), dtype=np.int64)
    nodes["child"][refined] = VALID | children.astype("<u4")
    return nodes
