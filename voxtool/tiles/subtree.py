"""Subtrees of an octree as the states of their nodes, and the octree that they make together.

A window of a grid, a cube whose side is a power of two and whose corner is a multiple of it, is a
subtree of the grid's octree: voxelized by itself it has the same nodes and bricks. The states of
its nodes are all that is kept of a window until the octree is written (svo/links.py), and labels
of its full leaves; its bricks wait elsewhere, in the order of the windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.svo.layout import BRICK_SIDE, descend
from voxtool.svo.links import EMPTY, FULL, REFINED, level_states
from voxtool.svo.octree import Octree


@dataclass(frozen=True)
class Subtree:
    """A node and all below it.

    levels : the (n,) uint8 states of the nodes of each level, from the root down to level 1;
    bricks : their number;
    labels : labels of the full nodes of each level, or () without labels.
    """

    levels: tuple[np.ndarray, ...]
    bricks: int
    labels: tuple[np.ndarray, ...] = ()

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


def labels_by_level(levels: Sequence[np.ndarray], leaves: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the labels of the full nodes of each level, given those of all."""
    counts = [int(np.count_nonzero(states == FULL)) for states in levels]
    return tuple(np.split(leaves, np.cumsum(counts)[:-1]))


def subtree_of(octree: Octree, side: int) -> Subtree:
    """Return an octree as the subtree of a cube of `side` voxels, of which it is the low corner."""
    levels = tuple(level_states(octree.offsets, octree.nodes)[::-1])
    leaves = [one.leaves for one in octree.attributes if one.name == "label"]
    labels = labels_by_level(levels, leaves[0]) if leaves else ()
    found = Subtree(levels, len(octree.bricks), labels)
    while (2 * BRICK_SIDE) << (len(found.levels) - 1) < side:
        beyond = empty_subtree((2 * BRICK_SIDE) << (len(found.levels) - 1))
        found = joined([found, *[beyond] * 7])
    return found


def codes_of(levels: Sequence[np.ndarray]) -> np.ndarray:
    """Return the Morton codes of the bricks of a subtree, (n,) uint64."""
    codes = np.zeros(1, np.uint64)
    for states in levels:
        codes = descend(codes[states == REFINED])
    return codes


def joined(children: Sequence[Subtree]) -> Subtree:
    """Return the subtree of eight, in Morton order: a leaf if all of them are empty, or full."""
    roots, *below = _by_level([child.levels for child in children])
    labels = _by_level([child.labels for child in children if child.labels])
    bricks = sum(child.bricks for child in children)
    if (roots == EMPTY).all() or (roots == FULL).all():
        labels = labels and [labels[0][:1], labels[0][:0], *labels[1:]]  # they are equal
        return Subtree((roots[:1], roots[:0], *below), bricks, tuple(labels))
    labels = labels and [labels[0][:0], *labels]
    return Subtree((np.full(1, REFINED, np.uint8), roots, *below), bricks, tuple(labels))


def _by_level(parts: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Return arrays of several subtrees, by level, as one for each level."""
    return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
