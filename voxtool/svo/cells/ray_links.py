"""The data of an octree that rays need: the links that they follow, and where something is set.

A merged octree has each distinct subtree once: rays need no node's parent and no index of its
own, as they know where they are by the way that they came.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.morton import morton_box, morton_decode
from voxtool.svo.dag.merge import SUBTREE
from voxtool.svo.dag.merged import MergedOctree, states_in
from voxtool.svo.octree.layout import (
    BRICK,
    BRICK_BYTES,
    BRICK_SIDE,
    INSIDE,
    LINK,
    MAX_LINK,
    VALID,
    descend,
)
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS

WORD_BYTES = 4  # bytes of a node that is drawn


@dataclass(frozen=True)
class LinkedNodes:
    """The nodes of an octree, or those of its distinct subtrees, in groups of eight."""

    offsets: list[int]  # index of the first node of each level, root first, and of the first brick
    children: np.ndarray  # (n,) uint32 `child` words of the nodes above level 0
    bricks: np.ndarray  # (m,) BRICK


def drawn_bytes(octree: Octree | MergedOctree) -> int:
    """Return the bytes of what `linked_nodes` returns, with links and flags as Octree has them."""
    if isinstance(octree, Octree):
        return octree.nbytes
    *above, last, _ = octree.sizes
    return 8 * (WORD_BYTES * sum(above) + BRICK_BYTES * last)


def linked_nodes(octree: Octree | MergedOctree) -> LinkedNodes:
    """Return the links and bricks of an octree.

    Raises
    ------
    MemoryLimitError
        If the subtrees of a level exceed links of 30 bits.
    """
    if isinstance(octree, Octree):
        *offsets, _ = octree.offsets.tolist()
        return LinkedNodes(offsets, octree.nodes["child"][: offsets[-1]], octree.bricks)
    *above, last, _ = octree.sizes
    if 8 * (most := max([*above, last])) > MAX_LINK:
        raise MemoryLimitError(
            f"{most:,} distinct subtrees of a level exceed links of 30 bits: voxelize "
            "with a smaller dim"
        )
    root = VALID if octree.root == REFINED else INSIDE if octree.root == FULL else np.uint32(0)
    parts = [np.array([root], np.uint32)]
    for d in range(octree.depth - 2):
        words = octree.words(d).ravel()
        links = VALID | (words - SUBTREE) << np.uint32(3)
        parts.append(np.where(words >= SUBTREE, links, np.where(words == FULL, INSIDE, 0)))
    words = octree.words(octree.depth - 2).ravel()
    bricks = np.where(words == FULL, ALL_VOXELS, BRICK.type(EMPTY))
    bricks[words >= SUBTREE] = octree.leaves[words[words >= SUBTREE] - SUBTREE]
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    return LinkedNodes(offsets, np.concatenate(parts, dtype=np.uint32), bricks)


def coverages(octree: Octree | MergedOctree, level: int) -> np.ndarray:
    """Return the share of set voxels of each node of a level, (n,) float64. A merged octree has
    the nodes of its distinct subtrees."""
    linked = linked_nodes(octree)
    counts = np.bitwise_count(linked.bricks).astype(np.int64)
    for number in range(1, level + 1):
        d = octree.depth - 1 - number
        words = linked.children[linked.offsets[d] : linked.offsets[d + 1]]
        below, refined = counts.reshape(-1, 8).sum(axis=1), (words & VALID) != 0
        counts = np.where(words & INSIDE, np.int64(BRICK_SIDE << number) ** 3, 0)
        counts[refined] = below[(words[refined] & LINK) >> np.uint32(3)]
    return counts / float((BRICK_SIDE << level) ** 3)


def box_of(octree: Octree | MergedOctree) -> tuple[np.ndarray, np.ndarray]:
    """Return the low and the high corner, (3,) int64 in voxels, of the inside leaves and the bricks
    that hold a set voxel; one does."""
    if isinstance(octree, MergedOctree):
        lows = np.zeros((len(octree.leaves), 3), np.int64)
        return octree.box_of(lows, lows + BRICK_SIDE)
    low, high = np.array(octree.grid.shape), np.zeros(3, np.int64)
    for level in octree.levels():
        held = level.inside if level.number else octree.bricks != 0
        if held.any():
            first, last = morton_box(level.codes[held])
            low = np.minimum(low, first * level.side)
            high = np.maximum(high, (last + 1) * level.side)
    return low, high


def cover_of(octree: Octree | MergedOctree, number: int) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the low corners, (n, 3) int64 in voxels, and the side of cubes that hold everything
    set, level by level, root first: the inside leaves above a level, and its nodes that are inside
    or refined."""
    if isinstance(octree, Octree):
        for level in octree.levels(number):
            shown = level.inside | level.refined if level.number == number else level.inside
            yield level.cells[shown], level.side
        return
    codes, states = np.zeros(1, np.uint64), np.full(1, octree.root, np.uint8)
    depth = octree.depth - number  # levels
    for d, subtrees in enumerate(octree.instances(depth)):
        side = BRICK_SIDE << (octree.depth - 1 - d)
        shown = states != EMPTY if d == depth - 1 else states == FULL
        yield morton_decode(codes[shown]) * side, side
        codes = descend(codes[states == REFINED])
        states = states_in(octree.level(d)[0][subtrees]).ravel()
    if not number:
        yield morton_decode(codes) * BRICK_SIDE, BRICK_SIDE
