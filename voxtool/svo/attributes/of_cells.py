"""Attributes of the cells of an octree: cubes of 2**N voxels a side, of all voxels in each.

A cell of level 0 is a voxel, and has its value. Above, a cell has

- as label that of most of its set voxels, of equally many the lowest;
- as colour the mean of its coloured voxels in linear light, and as opacity the mean of theirs:
  those that have a value of their own; the default if none has. The mean of their light, rounded
  down to 2**-24, becomes the nearest level of sRGB; opacities are rounded to the nearest, halves
  up;
- as normal the sum of the normals of its voxels, as a unit vector, or 0 0 0;
- as fraction the mean over all its voxels, of which unset ones have 0: whole numbers are rounded to
  the nearest, halves up;
- as share of a face the mean over the faces of voxels that lie in it, in the same way.

Sums are of integers, so no order shows: normals and fractions of float32 are counted in units of
2**-24, as light is; in octrees of more than 8192 voxels a side (normals 4096) in those that 64 bits
leave room for. A cell without a set voxel has 0.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from voxtool.svo.attributes.sums import CHILDREN, tally_of
from voxtool.svo.cells.counts import BRICK_POWER
from voxtool.svo.octree.attributes import BITS, BRICKS, Attribute
from voxtool.svo.octree.layout import BRICK_SIDE, INSIDE, LINK, VALID
from voxtool.svo.octree.octree import Level, Octree


class CellValues:
    """The values of an attribute of an octree's cells.

    Parameters
    ----------
    octree : Octree
        The voxels.
    name : str
        The attribute.
    size : int
        A cell has 2**size voxels a side.
    whole : Attribute, optional
        For a part of an octree, the attribute of all of it, by which units of sums are chosen.
    """

    def __init__(
        self, octree: Octree, name: str, size: int, whole: Attribute | None = None
    ) -> None:
        self.octree, self.attribute = octree, octree.attribute(name)
        self.levels: list[Level] = octree.levels()[::-1]
        self.size, self.level = size, size - BRICK_POWER
        self.row = self.attribute.values.shape[1:]  # () or (channels,)
        self.dtype = self.attribute.values.dtype
        self._voxels = octree.values(name)
        self._tally: Any = tally_of(whole or self.attribute, octree.grid.side)

    @cached_property
    def _leaves(self) -> list[np.ndarray]:
        """The values of the inside leaves of each level, from the bricks' level up."""
        counts = [int(level.inside.sum()) if level.number else 0 for level in self.levels]
        values = self._voxels.of_leaves(sum(counts))
        ends = np.cumsum(counts[::-1])  # the root's come first
        return np.split(values, ends[:-1])[::-1]

    @property
    def _leaves_are_own(self) -> bool:
        """True if inside leaves have values of their own, not the default."""
        return len(self.attribute.leaves) > 0 or self.attribute.masks is None

    def of_bricks(self, places: Any) -> np.ndarray:
        """Return the values of the cells in bricks, (n, 8**k, ...) in Morton order, k = 2 - size,
        given the bricks' indices."""
        values = self._voxels.of_bricks(places)
        if not self.size:
            return values
        each = CHILDREN**self.size
        tally = self._of_voxels(values.reshape(-1, each, *self.row), places, each)
        found = self._tally.values(tally, len(values) * BRICK_SIDE**3 // each, each)
        return found.reshape(len(values), -1, *self.row)

    def _of_voxels(self, values: np.ndarray, places: Any, each: int) -> Any:
        """Return the tally of groups of `each` voxels of bricks."""
        bricks = self.octree.bricks[places]
        held = self.attribute.held(self.octree.bricks)[places]
        flags = [((one[:, None] & BITS) != 0).reshape(-1, each) for one in (bricks, held)]
        return self._tally.of_voxels(values, *flags)

    def tallies(self, number: int) -> Any:
        """Return the tally of the nodes of a level."""
        level = self.levels[number]
        if not number:
            steps = range(0, len(level.nodes), BRICKS)
            parts = [slice(first, first + BRICKS) for first in steps]
            found = [
                self._of_voxels(self._voxels.of_bricks(part), part, BRICK_SIDE**3) for part in parts
            ]
            return self._tally.joined(found, steps)
        return self._above(number, self.tallies(number - 1))

    def _above(self, number: int, below: Any) -> Any:
        """Return the tally of the nodes of a level, given that of the level below."""
        level = self.levels[number]
        refined, inside = np.flatnonzero(level.refined), np.flatnonzero(level.inside)
        volume = level.side**3
        leaves = self._tally.of_leaves(self._leaves[number], volume, self._leaves_are_own)
        return self._tally.above(len(level.nodes), refined, below, inside, leaves)

    def of_nodes(self, number: int) -> np.ndarray:
        """Return the values of all nodes of a level, (n, ...)."""
        level = self.levels[number]
        return self._tally.values(self.tallies(number), len(level.nodes), level.side**3)

    def of_all_nodes(self) -> list[np.ndarray]:
        """Return the values of the nodes of each level, from the bricks up."""
        tally, found = self.tallies(0), []
        for level in self.levels:
            if level.number:
                tally = self._above(level.number, tally)
            found.append(self._tally.values(tally, len(level.nodes), level.side**3))
        return found

    @cached_property
    def _of_cells(self) -> np.ndarray:
        return self.of_nodes(self.level)

    def of_cells(self, level: int, nodes: np.ndarray) -> np.ndarray:
        """Return the values of the cells in nodes of a level, given by their indices, (n, 8**k,
        ...) in Morton order; k is the number of levels between."""
        if level == self.level:
            return self._of_cells[nodes][:, None]
        if level == 0:
            return self.of_bricks(nodes)
        words = self.levels[level].nodes["child"][nodes]
        found = np.zeros((len(nodes), CHILDREN ** (level - self.level), *self.row), self.dtype)
        inside = np.flatnonzero(words & INSIDE)
        found[inside] = self._leaves[level][self._ranks[level][nodes[inside]]][:, None]
        refined = np.flatnonzero(words & VALID)
        children = (words[refined] & LINK)[:, None] + np.arange(CHILDREN)
        below = self.of_cells(level - 1, children.ravel())
        found[refined] = below.reshape(len(refined), *found.shape[1:])
        return found

    @cached_property
    def _ranks(self) -> list[np.ndarray]:
        """The number of inside leaves before each node, by level."""
        return [np.cumsum(level.inside) - level.inside for level in self.levels]

    def around(self, codes: np.ndarray, number: int) -> np.ndarray:
        """Return the values of the inside leaves around nodes of a level that lie in leaves, given
        their Morton codes, (n, ...)."""
        found = np.zeros((len(codes), *self.row), self.dtype)
        for level, values in zip(self.levels[number:], self._leaves[number:], strict=True):
            inside = level.codes[level.inside]
            if not (level.number and len(inside)):
                continue
            above = codes >> np.uint64(3 * (level.number - number))
            at = np.minimum(np.searchsorted(inside, above), len(inside) - 1)
            here = inside[at] == above
            found[here] = values[at[here]]
        return found
