"""Counts of set voxels in the nodes of an octree, and in the cells of a node."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.svo.dag.merged import MergedOctree, states_in
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK_SIDE, INSIDE, LINK, NODE, VALID, descend
from voxtool.svo.octree.links import FULL, REFINED, states_of
from voxtool.svo.octree.octree import Level, Octree

BRICK_POWER = BRICK_SIDE.bit_length() - 1
NO_STATES = np.empty(0, np.uint8)


def check_isovalue(isovalue: float | None) -> None:
    """Raise VoxtoolError unless this is None or a share, above 0 and at most 1."""
    if isovalue is not None and not 0 < isovalue <= 1:
        raise VoxtoolError(
            f"isovalue {isovalue!r}: choose a share of set voxels, above 0 and at most 1"
        )


class Counts:
    """The counts of an octree's cells: cubes of 2**size voxels a side, aligned to the grid.

    Attributes
    ----------
    levels : list of Level
        The octree's levels, from the bricks up.
    most : int
        Voxels of a cell.
    """

    def __init__(self, octree: Octree, size: int) -> None:
        self.octree = octree
        self.levels: list[Level] = octree.levels()[::-1]
        self._of(size)

    def _of(self, size: int) -> None:
        self.most = 8**size
        # The level whose nodes are the cells: -1 and -2 for the eighths of bricks and for voxels.
        self.level = size - BRICK_POWER
        self.dtype = np.min_scalar_type(self.most)

    @cached_property
    def of_nodes(self) -> list[np.ndarray]:
        """The set voxels of each node, (n,) int64 by level from the bricks up."""
        found = [np.bitwise_count(self.octree.bricks).astype(np.int64)]
        for level in self.levels[1:]:
            counts = np.where(level.inside, np.int64(level.side) ** 3, 0)
            counts[level.refined] = found[-1].reshape(-1, 8).sum(axis=1)
            found.append(counts)
        return found

    def of_cells(self, level: int, nodes: np.ndarray) -> np.ndarray:
        """Return the set voxels of the cells in nodes of a level, given by their indices: (n, 8**k)
        of the smallest unsigned type, in Morton order; k is the number of levels between."""
        if level == self.level:
            return self.of_nodes[level][nodes, None].astype(self.dtype)
        if level == 0:
            parts = np.ascontiguousarray(self.octree.bricks[nodes]).view(np.uint8).reshape(-1, 8)
            if self.level == -1:
                return np.bitwise_count(parts)
            return np.unpackbits(parts, axis=1, bitorder="little")
        words = self.levels[level].nodes["child"][nodes]
        counts = np.zeros((len(nodes), 8 ** (level - self.level)), self.dtype)
        counts[(words & INSIDE) != 0] = self.most
        refined = np.flatnonzero(words & VALID)
        children = (words[refined] & LINK)[:, None] + np.arange(8)
        below = self.of_cells(level - 1, children.ravel())
        counts[refined] = below.reshape(len(refined), counts.shape[1])
        return counts


def counts_of(octree: OctreeContent, size: int) -> Counts:
    """Return the counts of an octree's cells. The octree need not be in memory if they are nodes
    above the bricks."""
    return Counts(octree, size) if isinstance(octree, Octree) else NodeCounts(octree, size)


class NodeCounts(Counts):
    """Counts of set voxels in cells that are nodes above the bricks. The octree need not be in
    memory: only the levels from the cells up are, and those below have no nodes here."""

    def __init__(self, octree: OctreeContent, size: int) -> None:
        self._of(size)
        states = _states_down_to(octree, self.level)
        codes, none = np.zeros(1, np.uint64), np.empty(0, NODE)
        self.levels = [Level(n, BRICK_SIDE << n, none, codes[:0]) for n in range(octree.depth)]
        for number, own in zip(range(octree.depth - 1, -1, -1), states, strict=False):
            self.levels[number] = Level(number, BRICK_SIDE << number, _nodes_of(own), codes)
            codes = descend(codes[own == REFINED])
        counts = np.where(states[-1] == FULL, np.int64(BRICK_SIDE << self.level) ** 3, 0)
        counts[states[-1] == REFINED] = _counts_of_refined(octree, self.levels[self.level])
        found = [np.empty(0, np.int64)] * self.level + [counts]
        for level in self.levels[self.level + 1 :]:
            counts = np.where(level.inside, np.int64(level.side) ** 3, 0)
            counts[level.refined] = found[-1].reshape(-1, 8).sum(axis=1)
            found.append(counts)
        self.of_nodes = found


def _states_down_to(octree: OctreeContent, number: int) -> list[np.ndarray]:
    """Return the states of the nodes of each level, from the root down to level `number`."""
    depth = octree.depth - number
    if isinstance(octree, MergedOctree):
        return octree.states(octree.instances(depth))
    return [
        np.concatenate([states_of(part["child"]) for part in octree.blocks(d)] or [NO_STATES])
        for d in range(depth)
    ]


def _nodes_of(states: np.ndarray) -> np.ndarray:
    """Return the nodes of a level with these states, without links to their parents."""
    nodes, refined = np.zeros(len(states), NODE), states == REFINED
    nodes["child"][states == FULL] = INSIDE
    nodes["child"][refined] = VALID | 8 * np.arange(np.count_nonzero(refined), dtype=np.uint32)
    return nodes


def _counts_of_refined(octree: OctreeContent, level: Level) -> np.ndarray:
    """Return the set voxels of the refined nodes of a level, (n,) int64."""
    if isinstance(octree, MergedOctree):
        d = octree.depth - 1 - level.number
        return _counts_of_subtrees(octree, d)[octree.instances(d + 1)[d]]
    codes = level.codes[level.refined]
    counts = np.zeros(len(codes), np.int64)
    for span in octree.walk():
        if span.number >= level.number:
            continue
        if span.number:
            inside = (span.nodes["child"] & INSIDE) != 0
            voxels = np.where(inside, np.int64(BRICK_SIDE << span.number) ** 3, 0)
        else:
            bricks = octree.bricks[span.start : span.start + len(span.nodes)]
            voxels = np.bitwise_count(bricks).astype(np.int64)
        above = np.searchsorted(codes, span.codes >> np.uint64(3 * (level.number - span.number)))
        first = np.flatnonzero(np.diff(above, prepend=-1))  # a span is in ascending order
        counts[above[first]] += np.add.reduceat(voxels, first)
    return counts


def _counts_of_subtrees(octree: MergedOctree, d: int) -> np.ndarray:
    """Return the set voxels of the distinct subtrees of a level, (n,) int64."""
    below = np.bitwise_count(octree.leaves).astype(np.int64)
    for above in range(octree.depth - 2, d - 1, -1):
        masks, links = octree.level(above)
        full = np.count_nonzero(states_in(masks) == FULL, axis=1)
        ends = np.cumsum(np.bitwise_count(masks & np.uint16(0xFF)), dtype=np.int64)
        sums = np.concatenate([[0], np.cumsum(below[links])])[np.concatenate([[0], ends])]
        side = np.int64(BRICK_SIDE << (octree.depth - 2 - above))
        below = np.diff(sums) + full * side**3
    return below
