"""Octrees for pictures of a level, of which only the upper nodes fit in memory.

A picture of a level needs of its nodes how much of each is set. So each of them gets as many set
voxels as it has, but the first ones in Morton order: nodes of equal counts are then one subtree of
a merged octree, whatever their number is.
"""

from __future__ import annotations

import numpy as np

from voxtool.memory import available_memory
from voxtool.svo.cells.counts import NodeCounts
from voxtool.svo.dag.merge import CHILDREN, SUBTREE, Subtrees
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.content import OctreeContent, StoredOctree
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE
from voxtool.svo.octree.links import EMPTY, FULL
from voxtool.svo.octree.octree import Octree, in_memory, level_number

NODE_BYTES = 64  # bytes of states, codes, counts and words, a node


def fitting_octree(
    octree: StoredOctree, level: int | str, max_memory: int | None
) -> tuple[Octree | MergedOctree, int | str]:
    """Return an octree of which a picture of a level shows what it shows of `octree`, and the
    level: the octree in memory if it fits, without its attributes if only they do not, or else the
    upper nodes, down to those of the finest level from `level` up that fit; the octree in memory,
    too, if no level does.

    Raises
    ------
    MemoryLimitError
        If that is larger than memory.
    """
    limit = available_memory() // 2 if max_memory is None else max_memory
    if octree.nbytes + sum(one.nbytes for one in octree.attributes) > limit:
        octree = octree.only(())
    if octree.nbytes <= limit:
        return in_memory(octree), level
    wanted = level_number(octree, level, octree.depth - 1)
    for number in range(min(max(wanted, 1), octree.depth - 2), octree.depth - 1):
        if NODE_BYTES * int(octree.offsets[octree.depth - number]) <= limit:
            return coarsened(octree, number), max(number, wanted)
    return in_memory(octree), level


def coarsened(octree: OctreeContent, number: int) -> MergedOctree:
    """Return an octree with the same coverage of each node from level `number` up. This is above 0
    and below the root's, since a picture of a node may show the coverage of its children."""
    counts = NodeCounts(octree, number + BRICK_SIDE.bit_length() - 1)
    of_level = counts.of_nodes[number]
    words, needed = _words_of(of_level, BRICK_SIDE << number)
    rows = []  # by level from level 1 up
    for below in range(number, 0, -1):
        side = BRICK_SIDE << below
        rows.insert(0, _first_of(needed, side))
        needed = _partial(needed % np.int64(side // 2) ** 3)
    for level in counts.levels[number + 1 :]:
        rows.append(words.reshape(-1, CHILDREN))
        words = np.where(level.inside, FULL, EMPTY).astype(np.uint32)
        words[level.refined] = SUBTREE + np.arange(len(rows[-1]), dtype=np.uint32)
    masks = (BRICK.type(1) << needed.astype(BRICK)) - BRICK.type(1)
    described = octree.plan, octree.source_sha256, octree.units, octree.transform
    subtrees = Subtrees(rows, masks, int(words[0]))
    return MergedOctree.of_subtrees(subtrees, octree.grid, octree.mode, octree.fill, *described)


def _partial(counts: np.ndarray) -> np.ndarray:
    """Return the distinct counts of nodes that are neither empty nor full, ascending."""
    return np.unique(counts[counts > 0])


def _words_of(counts: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the words of nodes of `side` voxels with these counts, and the counts of the subtrees
    that they name."""
    most = np.int64(side) ** 3
    needed = _partial(counts[counts < most])
    words = SUBTREE + np.searchsorted(needed, counts).astype(np.uint32)
    words[counts == 0], words[counts == most] = EMPTY, FULL
    return words, needed


def _first_of(counts: np.ndarray, side: int) -> np.ndarray:
    """Return the words of the children of nodes of `side` voxels, whose first voxels are set, as
    many as `counts` says of each, (n, 8) uint32."""
    volume = np.int64(side // 2) ** 3
    full, rest = counts // volume, counts % volume
    rows = np.where(np.arange(CHILDREN) < full[:, None], FULL, EMPTY).astype(np.uint32)
    some = np.flatnonzero(rest)
    rows[some, full[some]] = SUBTREE + np.searchsorted(_partial(rest), rest[some])
    return rows
