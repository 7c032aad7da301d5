"""The cubes along a bar of a grid: subtrees of the octree of the bar, which is made at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from voxtool.files.octrees.windows import Window
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.links import FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.tiles.subtree import Subtree, leaf_subtree, subtree_of, voxels_of


@dataclass(frozen=True)
class Cube:
    """A cube of an octree.

    tree : its nodes
    first, last : its bricks are those from the first up to the last one of the octree
    """

    tree: Subtree
    first: int
    last: int

    def window(self, bricks: np.ndarray, attributes: list[Attribute], known: object) -> Window:
        """Return the cube as a window, given its own bricks and attributes."""
        levels = self.tree.levels
        return Window(levels, bricks, voxels_of(levels, bricks), attributes, known)


def cubes_along(octree: Octree, side: int, axis: int) -> Iterator[Cube]:
    """Yield the cubes of `side` voxels along an axis of an octree, whose grid is no wider across
    it."""
    top = max(side, octree.grid.side)
    whole = subtree_of(octree, top)
    ranks = [_before(states == REFINED) for states in whole.levels]
    fulls = [_before(states == FULL) for states in whole.levels]
    above = (top // side).bit_length() - 1  # levels above the cubes
    for number in range(-(-octree.grid.shape[axis] // side)):
        node, level = 0, 0
        while level < above and whole.levels[level][node] == REFINED:
            half = number >> (above - 1 - level) & 1
            node, level = 8 * int(ranks[level][node]) + (half << axis), level + 1
        first, last, levels, labels = node, node + 1, [], []
        for number_of, states in enumerate(whole.levels[level:], level):
            levels.append(states[first:last])
            if whole.labels:
                own = fulls[number_of]
                labels.append(whole.labels[number_of][own[first] : own[last]])
            first, last = (8 * int(ranks[number_of][at]) for at in (first, last))
        tree = Subtree(tuple(levels), last - first, tuple(labels))
        if level < above:  # it lies in a leaf
            leaf = leaf_subtree(side, int(levels[0][0]))
            none = [one[:0] for one in labels[1 : len(leaf.levels)]]
            tree = Subtree(leaf.levels, 0, (*labels[:1], *none))
        yield Cube(tree, first, last)


def _before(states: np.ndarray) -> np.ndarray:
    """Return how many of some states hold before each place."""
    return np.concatenate([[0], np.cumsum(states, dtype=np.int64)])


def attributes_within(octree: Octree, cube: Cube) -> list[Attribute]:
    """Return the attributes of a cube of an octree."""
    found = []
    for one in octree.attributes:
        start, stop = (int(one.starts(octree.bricks)[at]) for at in (cube.first, cube.last))
        own = cube.tree.labels if one.name == "label" else ()
        leaves = np.concatenate([one.leaves[:0], *own])
        masks = None if one.masks is None else one.masks[cube.first : cube.last]
        arrays = one.values[start:stop], leaves, masks
        found.append(Attribute(one.name, *arrays, one.default, one.names))
    return found
