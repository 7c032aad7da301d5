"""Attributes of parts of an octree, whose values may stay in a file.

Only the values of the bricks and leaves of a part that cells.py cuts out are read. Their
places follow from a sum for each block of bricks and of nodes, so nothing is held for each brick.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from voxtool.arrays import blocks_of
from voxtool.svo.cells.subtrees import EIGHT, Cut, groups_of
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.content import AttributedContent
from voxtool.svo.octree.layout import INSIDE

BLOCK = 1 << 14  # bricks or nodes that are read at once, and have one sum; whole groups of eight


class AttributeParts:
    """An attribute, of which parts are asked for.

    Parameters
    ----------
    octree : AttributedContent
        The octree.
    name : str
        The attribute.
    """

    def __init__(self, octree: AttributedContent, name: str) -> None:
        self.attribute = one = octree.attribute(name)
        self._values = _Sums(one.held(octree.bricks), np.bitwise_count, len(octree.bricks))
        upper = int(octree.offsets[-2]) if len(one.leaves) else 0  # the nodes above the bricks
        self._leaves = _Sums(octree.nodes, _inside, upper)

    def masks(self, cut: Cut) -> np.ndarray:
        """Return the masks of the voxels of the bricks of a part that have values."""
        masks = self.attribute.masks
        return cut.octree.bricks if masks is None else groups_of(masks, cut.bricks)

    def nbytes(self, cut: Cut) -> int:
        """Return the bytes of the values and masks of a part."""
        masks, one = self.masks(cut), self.attribute
        count = int(np.bitwise_count(masks).sum(dtype=np.int64))
        return count * one.leaves.itemsize * int(np.prod(one.values.shape[1:])) + masks.nbytes

    def of(self, cut: Cut) -> Attribute:
        """Return the attribute of a part."""
        one, masks = self.attribute, self.masks(cut)
        count = int(np.bitwise_count(masks).sum(dtype=np.int64))
        values, done = np.empty((count, *one.values.shape[1:]), one.values.dtype), 0
        for groups in _by_block(cut.bricks):
            first, last = int(groups[0]), int(groups[-1]) + 8
            sums = self._values.before(first, last)
            chosen = np.zeros(last - first, bool)
            chosen[(groups - first)[:, None] + EIGHT] = True
            own = one.values[int(sums[0]) : int(sums[-1])][np.repeat(chosen, np.diff(sums))]
            values[done : done + len(own)] = own
            done += len(own)
        leaves = one.leaves
        if len(leaves):
            leaves = leaves[self._ranks(cut.inside)]
        return replace(one, values=values, leaves=leaves, masks=masks if one.masked else None)

    def _ranks(self, nodes: np.ndarray) -> np.ndarray:
        """Return how many inside leaves come before each of some nodes, (n,) int64."""
        found = [np.empty(0, np.int64)]
        for part in _by_block(nodes):
            first, last = int(part[0]), int(part[-1])
            found.append(self._leaves.before(first, last)[part - first])
        return np.concatenate(found)


class _Sums:
    """The counts before each item of an array; only the sum before each block is held.

    Parameters
    ----------
    array : its slices are arrays.
    count : returns the counts of the items of a slice.
    size : the number of items that are counted.
    """

    def __init__(self, array: Any, count: Callable[[Any], np.ndarray], size: int) -> None:
        self._array, self._count = array, count
        parts = (count(part) for part in blocks_of(array, BLOCK, 0, size))
        sums = [0, *(int(part.sum(dtype=np.int64)) for part in parts)]
        self._before = np.cumsum(sums, dtype=np.int64)

    def before(self, first: int, last: int) -> np.ndarray:
        """Return the counts before each of the items from `first` to `last`, (n,) int64; `last` may
        be the number of items."""
        block = first // BLOCK
        counts = self._count(self._array[block * BLOCK : last])
        sums = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])
        return self._before[block] + sums[first - block * BLOCK :]


def _inside(nodes: np.ndarray) -> np.ndarray:
    """Return which nodes are inside leaves."""
    return (nodes["child"] & INSIDE) != 0


def _by_block(places: np.ndarray) -> Iterator[np.ndarray]:
    """Yield ascending places in an array, those of one block at a time."""
    if len(places):
        yield from np.split(places, np.flatnonzero(np.diff(places // BLOCK)) + 1)
