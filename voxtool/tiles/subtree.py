"""Subtrees of an octree as the states of their nodes, and the octree that they make together.

A window of a grid, a cube whose side is a power of two and whose corner is a multiple of it, is a
subtree of the grid's octree: voxelized by itself it has the same nodes and bricks. The states of
its nodes are all that is kept of a window until the octree is written (svo/links.py); its bricks
wait elsewhere, in the order of the windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.links import EMPTY, FULL, REFINED, level_states
from voxtool.svo.octree import Octree


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


def depth_of(side: int) -> int:
    """Return the number of levels above the bricks of a cube of `side` voxels."""
    return (side // (2 * BRICK_SIDE)).bit_length()


def leaf_subtree(side: int, state: int) -> Subtree:
    """Return the subtree of a cube that is a leaf, EMPTY or FULL."""
    none = np.empty(0, np.uint8)
    return Subtree((np.full(1, state, np.uint8), *[none] * (depth_of(side) - 1)), 0)


def empty_subtree(side: int) -> Subtree:
    """Return the subtree of a cube without voxels."""
    return leaf_subtree(side, EMPTY)


def subtree_of(octree: Octree, side: int) -> Subtree:
    """Return an octree as the subtree of a cube of `side` voxels, of which it is the low corner."""
    levels = tuple(level_states(octree.offsets, octree.nodes)[::-1])
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
