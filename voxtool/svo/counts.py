"""Counts of set voxels: of the nodes of an octree, and of the cells in a node."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.svo.layout import BRICK_SIDE, INSIDE, LINK, VALID
from voxtool.svo.octree import Level, Octree


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
        self.most = 8**size
        # The level whose nodes are the cells: -1 and -2 for the eighths of bricks and for voxels.
        self.level = size - BRICK_SIDE.bit_length() + 1
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
        words = self.octree.child_words(self.octree.depth - 1 - level)[nodes]
        counts = np.zeros((len(nodes), 8 ** (level - self.level)), self.dtype)
        counts[(words & INSIDE) != 0] = self.most
        refined = np.flatnonzero(words & VALID)
        children = (words[refined] & LINK)[:, None] + np.arange(8)
        below = self.of_cells(level - 1, children.ravel())
        counts[refined] = below.reshape(len(refined), counts.shape[1])
        return counts
