"""The samples of an octree, and the links that lead to them.

A sample is a node of one level, its scalar the number of its voxels that are set; or a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil

import numpy as np

from voxtool.svo.layout import BRICK_SIDE, BRICK_VOXELS, INSIDE, LINK, VALID
from voxtool.svo.octree import VOXEL, Octree

MAX_LEVEL = 8  # up to which 32 bits count a node's voxels
ISOVALUE_BITS = 16  # of a fraction of a voxel
_BIT = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
LOW_LAYER = [np.bitwise_or.reduce(_BIT[BRICK_VOXELS[:, a] == 0]) for a in range(3)]


@dataclass(frozen=True)
class Sampling:
    """A level of samples, and an isovalue."""

    level: int  # of the nodes that are samples, or VOXEL
    isovalue: int  # of a sample's voxels, in 2**-16: that of the request, rounded once

    @classmethod
    def of(cls, level: int | str, isovalue: float) -> Sampling:
        """Return the sampling of a level, or "voxel", and an isovalue in (0, 1)."""
        sampling = cls(VOXEL if isinstance(level, str) else level, 0)
        scale = sampling.full << ISOVALUE_BITS
        return replace(sampling, isovalue=min(max(round(Fraction(isovalue) * scale), 1), scale))

    @property
    def side(self) -> int:
        """Voxels along a side of a sample."""
        return 1 << (self.level - VOXEL)

    @property
    def full(self) -> int:
        """Voxels of a sample."""
        return self.side**3

    @property
    def threshold(self) -> int:
        """The least number of set voxels of a sample that is inside."""
        return ceil(Fraction(self.isovalue, 1 << ISOVALUE_BITS))

    @property
    def options(self) -> dict[str, int | str]:
        """The -D options of the kernels."""
        if self.level == VOXEL:
            return {"VOXELS": 1}
        if self.level == 0:
            return {"SAMPLE": "uchar", "COVERAGE": "ulong"}
        return {"SAMPLE": "uint", "COVERAGE": "uint"}


@dataclass(frozen=True)
class Tree:
    """The links of an octree from its root down to level 1.

    Roots are added above the octree's where tiles are larger than it, or where its voxels touch the
    low sides of its cube, because cubes begin one sample below them.
    """

    children: np.ndarray  # the nodes' `child` words, root first
    offsets: np.ndarray  # the first node of each level in them, and their end
    bricks: int  # number of bricks
    shift: int  # voxels from the root's corner to the octree's, along each axis

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.offsets) - 1

    def first(self, level: int) -> int:
        """Return the first node of a level in `children`."""
        return int(self.offsets[self.top - level])

    def nodes(self, level: int) -> int:
        """Return the number of nodes of a level."""
        return int(np.diff(self.offsets)[self.top - level]) if level else self.bricks


def grow_tree(octree: Octree, sampling: Sampling) -> Tree:
    """Return the octree's links, with roots added above its own where they are needed."""
    offsets = octree.offsets[:-1].astype(np.int64)
    children = np.ascontiguousarray(octree.nodes["child"][: offsets[-1]])
    tree = Tree(children, offsets, len(octree.bricks), 0)
    if _touches_low_sides(tree, octree.bricks, sampling):
        tree = replace(_with_root(tree, 7), shift=octree.grid.side)
    while tree.top < sampling.level + 2:
        tree = _with_root(tree, 0)
    return tree


def _with_root(tree: Tree, octant: int) -> Tree:
    """Return the tree with a root above its own, which becomes the child in an octant."""
    siblings = np.zeros(8, np.uint32)
    siblings[octant] = tree.children[0]
    children = np.concatenate([np.array([VALID], np.uint32), siblings, tree.children[1:]])
    return replace(tree, children=children, offsets=np.append([0, 1], tree.offsets[1:] + 8))


def _touches_low_sides(tree: Tree, bricks: np.ndarray, sampling: Sampling) -> bool:
    """Return True if a voxel is set, or above level 0 may be set, in the first samples along an
    axis."""
    nodes = np.zeros(1, np.uint32)
    sides = np.full(1, 7, np.uint8)  # the low sides at which a node lies: a bit for each axis
    octants = np.arange(8, dtype=np.uint32)
    high_sides = ~octants.astype(np.uint8)
    for level in range(tree.top, 0, -1):
        child = tree.children[tree.first(level) + nodes]
        refined = np.flatnonzero(child & VALID)
        if (child & INSIDE).any() or (level == sampling.level and len(refined)):
            return True
        below = sides[refined, None] & high_sides
        parent, octant = np.nonzero(below)
        sides = below[parent, octant]
        nodes = (child[refined] & LINK)[parent] + octants[octant]
    if sampling.level != VOXEL:
        return bool(bricks[nodes].any())
    return any((bricks[nodes[sides >> a & 1 == 1]] & LOW_LAYER[a]).any() for a in range(3))
