"""The samples of a surface: a level of an octree's nodes, or its voxels, and the links to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS, INSIDE, LINK, NODE, VALID
from voxtool.svo.octree.octree import VOXEL, Octree

ISOVALUE_BITS = 16  # bits of a fraction of a voxel
FULL_VOXEL = 1 << 15  # the scalar of a voxel that is wholly inside, of fractions
WORD_LEVELS = 4  # from that of samples up to that of words, which are 16 samples a side
_BIT = np.uint64(1) << np.arange(BRICK_SIDE**3, dtype=np.uint64)
LOW_LAYER = [np.bitwise_or.reduce(_BIT[BRICK_VOXELS[:, a] == 0]) for a in range(3)]


@dataclass(frozen=True)
class Sampling:
    """A level of samples, and an isovalue."""

    level: int  # of the nodes that are samples, or VOXEL
    isovalue: int  # of a sample's scalar, in 2**-16: that of the request, rounded once
    fractions: bool = False  # whether scalars of voxels are how much of them is inside

    @classmethod
    def of(cls, level: int | str, isovalue: float, fractions: bool = False) -> Sampling:
        """Return the sampling of a level, or "voxel", and an isovalue in (0, 1)."""
        sampling = cls(VOXEL if isinstance(level, str) else level, 0, fractions)
        scale = sampling.full << ISOVALUE_BITS  # a power of two: the product is exact
        return replace(sampling, isovalue=min(max(round(isovalue * scale), 1), scale))

    @property
    def side(self) -> int:
        """Voxels along a side of a sample."""
        return 1 << (self.level - VOXEL)

    @property
    def full(self) -> int:
        """The scalar of a sample that is wholly inside: its voxels, or FULL_VOXEL."""
        return FULL_VOXEL if self.fractions else self.side**3

    @property
    def binary(self) -> bool:
        """True if samples are voxels that are set or not."""
        return self.level == VOXEL and not self.fractions

    @property
    def threshold(self) -> int:
        """The least scalar of a sample that is inside."""
        return -(-self.isovalue >> ISOVALUE_BITS)

    @property
    def options(self) -> dict[str, int | str]:
        """The -D options of the kernels."""
        if self.binary:
            return {"VOXELS": 1}
        if self.fractions:
            return {"FRACTIONS": 1, "SAMPLE": "ushort", "DIFFERENCE": "uint"}
        if self.level == 0:
            return {"SAMPLE": "uchar", "COVERAGE": "ulong", "DIFFERENCE": "uint"}
        return {"SAMPLE": "uint", "COVERAGE": "uint", "DIFFERENCE": "ulong"}


@dataclass(frozen=True)
class Tree:
    """The links of an octree from its root down to level 1.

    Roots are added above the octree's where words are larger than it, or where its voxels touch the
    low sides of its cube, because cubes begin one sample below them.
    """

    nodes: np.ndarray  # the octree's, root first
    offsets: list[int]  # the first node of each level in them, and their end
    bricks: int  # number of bricks
    shift: int  # voxels from the root's corner to the octree's, along each axis

    @property
    def top(self) -> int:
        """The root's level."""
        return len(self.offsets) - 1

    def first(self, level: int) -> int:
        """Return the place of a level's first node."""
        return self.offsets[self.top - level]

    def count(self, level: int) -> int:
        """Return the number of nodes of a level."""
        if not level:
            return self.bricks
        return self.offsets[self.top - level + 1] - self.offsets[self.top - level]


def tree_of(octree: Octree) -> Tree:
    """Return the octree's links."""
    offsets = octree.offsets[:-1].tolist()
    return Tree(octree.nodes[: offsets[-1]], offsets, len(octree.bricks), 0)


def grow_tree(octree: Octree, sampling: Sampling) -> Tree:
    """Return the octree's links, with roots added above its own where they are needed."""
    tree = tree_of(octree)
    if _touches_low_sides(tree, octree.bricks, sampling):
        tree = replace(_with_root(tree, 7), shift=octree.grid.side)
    while tree.top < sampling.level + WORD_LEVELS:
        tree = _with_root(tree, 0)
    return tree


def _with_root(tree: Tree, octant: int) -> Tree:
    """Return the tree with a root above its own, which becomes the child in an octant."""
    above = np.zeros(9, NODE)
    above["child"][0] = VALID
    above["child"][1 + octant] = tree.nodes["child"][0]
    nodes = np.concatenate([above, tree.nodes[1:]])
    offsets = [0, 1, *(offset + 8 for offset in tree.offsets[1:])]
    return replace(tree, nodes=nodes, offsets=offsets)


def _touches_low_sides(tree: Tree, bricks: np.ndarray, sampling: Sampling) -> bool:
    """Return True if a voxel is set, or above level 0 may be set, in the first samples along an
    axis."""
    nodes = np.zeros(1, np.uint32)
    sides = np.full(1, 7, np.uint8)  # the low sides at which a node lies: a bit for each axis
    octants = np.arange(8, dtype=np.uint32)
    high_sides = ~octants.astype(np.uint8)
    for level in range(tree.top, 0, -1):
        child = tree.nodes["child"][tree.first(level) + nodes]
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
