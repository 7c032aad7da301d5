"""The invariants of a merged octree, checked on its subtrees alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import FileError
from voxtool.morton import morton_decode
from voxtool.svo.dag.merge import SUBTREE
from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS
from voxtool.svo.octree.links import FULL, REFINED
from voxtool.svo.octree.prune import ALL_VOXELS

if TYPE_CHECKING:
    from voxtool.svo.dag.merged import MergedOctree

CORNERS = morton_decode(np.arange(8))  # (8, 3): the place of each child in its parent


def check_tables(octree: MergedOctree) -> None:
    """Raise FileError if the sizes of the arrays do not fit the grid or each other, or a link leads
    beyond its table: called before anything follows a link."""
    starts = octree.starts.astype(np.int64)
    depth = (octree.grid.side // BRICK_SIDE).bit_length()
    if len(starts) != depth or starts[0] or (np.diff(starts) < 0).any():
        raise FileError(
            f"merged octree starts: {depth} numbers from 0 are expected, which do not descend"
        )
    if starts[-1] != len(octree.masks):
        raise FileError(
            f"merged octree starts: they end at {starts[-1]}, but there are {len(octree.masks)} "
            "subtrees"
        )
    if octree.root not in range(3) or starts[1] != (octree.root == REFINED):
        raise FileError("merged octree root: it is refined if the first level has one subtree")
    if (octree.masks & (octree.masks >> np.uint16(8)) & np.uint16(0xFF)).any():
        raise FileError("merged octree masks: a child has a link and is full")
    if octree.first_links[-1] != len(octree.links):
        raise FileError(
            f"merged octree links: {octree.first_links[-1]} are expected, but there are "
            f"{len(octree.links)}"
        )
    for d, below in enumerate(octree.sizes[1:]):
        _, links = octree.level(d)
        if (links >= below).any():
            raise FileError(
                f"merged octree links: level {depth - 1 - d} has a link beyond the {below} "
                "subtrees below it"
            )


def check_subtrees(octree: MergedOctree) -> None:
    """Raise FileError for the first invariant that does not hold of checked tables."""
    leaves = octree.leaves
    if (leaves[1:] <= leaves[:-1]).any() or ((leaves == 0) | (leaves == ALL_VOXELS)).any():
        raise FileError("merged octree bricks: they ascend, and none is empty or full")
    for d in range(octree.depth - 1):
        number = octree.depth - 1 - d
        if not _ascending(octree.words(d)):
            raise FileError(
                f"merged octree subtrees: level {number} is not in the order of its children, "
                "each once"
            )
        full = (octree.level(d)[0] >> np.uint16(8)).any() and number > 1
        if "solid" not in octree.mode and (full or octree.root == FULL):
            raise FileError("merged octree inside flag of a surface: it has none above the bricks")
    if not all(times.all() for times in octree.occurrences):
        raise FileError("merged octree subtrees: one occurs nowhere in the octree")
    if (_extent(octree) > octree.grid.shape).any():
        raise FileError("merged octree padding: voxels are set beyond the grid's shape")


def _ascending(rows: np.ndarray) -> bool:
    """Return True if each row is after the one before it in lexicographic order."""
    above, below = rows[:-1], rows[1:]
    first = (above != below).argmax(axis=1)[:, None]
    pairs = (np.take_along_axis(side, first, axis=1) for side in (above, below))
    return bool(np.less(*pairs).all())


def _extent(octree: MergedOctree) -> np.ndarray:
    """Return the (3,) int64 ends of the set voxels along each axis, 0 if there is none."""
    extents = np.zeros((len(octree.leaves), 3), np.int64)
    for a in range(3):
        for end in range(1, BRICK_SIDE + 1):
            bits = np.flatnonzero(BRICK_VOXELS[:, a] == end - 1)
            mask = np.bitwise_or.reduce(np.uint64(1) << bits.astype(np.uint64))
            extents[(octree.leaves & mask) != 0, a] = end
    for d in reversed(range(octree.depth - 1)):
        side = BRICK_SIDE << (octree.depth - 2 - d)
        words = octree.words(d)
        found = np.zeros((len(words), 3), np.int64)
        for c, corner in enumerate(CORNERS):
            child = np.zeros_like(found)
            linked = words[:, c] >= SUBTREE
            child[linked] = extents[words[linked, c] - SUBTREE]
            child[words[:, c] == FULL] = side
            np.maximum(found, np.where(child, child + side * corner, 0), out=found)
        extents = found
    if octree.root == REFINED:
        return extents[0]
    return np.full(3, octree.grid.side if octree.root == FULL else 0)
