"""The cells of an octree as a tree of 2 x 2 x 2 children, depth by depth: see vtkhdf.py."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from voxtool.svo.attributes.of_cells import BRICKS as VALUED
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.cells.counts import BRICK_POWER, Counts, counts_of
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS

BRICKS = 1 << 18  # bricks that are unpacked at once, without attributes
EIGHTH = 255  # the mask of a full one


class Cells(NamedTuple):
    """Some cells of one depth, in the order of the file."""

    counts: np.ndarray  # (n,) voxels that are set
    most: int  # voxels of a cell
    refined: np.ndarray | None  # (n,) bool, whether they have children; None in the last depth
    values: list[np.ndarray]  # (n, ...) of each attribute


class TreeCells:
    """The cells of the tree of an octree, from the root down to those of 2**level voxels.

    Bricks and their eighths have children where only some of their voxels are set, or where the
    voxels' attributes differ.
    """

    def __init__(
        self, octree: OctreeContent, level: int, attributes: Sequence[AttributeImage] = ()
    ) -> None:
        self.octree, self.level, self.attributes = octree, level, attributes
        self.step = VALUED if attributes else BRICKS
        self._known: dict[int, list[CellValues]] = {}

    @cached_property
    def by_depth(self) -> list[int]:
        """The number of cells of each depth, from the root down."""
        nodes = np.diff(self.octree.offsets).astype(np.int64).tolist()
        if self.level >= BRICK_POWER:
            return nodes[: len(nodes) - (self.level - BRICK_POWER)]
        divided = sum(len(places) for places in self._divided())
        parts = 0
        if self.level == 0:
            parts = sum(int(self._eighths_divided(places).sum()) for places in self._divided())
        sizes = [*nodes, 8 * divided, *([8 * parts] if self.level == 0 else [])]
        return [n for n in sizes if n]

    def depths(self) -> Iterator[Cells]:
        """Yield the cells, a depth in one piece or more of 8 n cells."""
        octree, level = self.octree, self.level
        counts = Counts(octree, 0) if isinstance(octree, Octree) else counts_of(octree, level)
        last = max(level - BRICK_POWER, 0)
        of_nodes = [values.of_all_nodes() for values in self._values(level)]
        for nodes in counts.levels[:last:-1]:
            number = nodes.number
            found, most = counts.of_nodes[number], nodes.side**3
            held = [values[number] for values in of_nodes]
            yield Cells(found, most, nodes.refined, self._shown(held, found))
        if level >= BRICK_POWER:
            found = counts.of_nodes[last]
            held = [values[last] for values in of_nodes]
            yield Cells(found, counts.levels[last].side ** 3, None, self._shown(held, found))
            return
        deeper = len(self.by_depth) - octree.depth
        for places in self._pieces():
            found = np.bitwise_count(octree.bricks[places])
            held = [values[0][places] for values in of_nodes]
            refined = self._bricks_divided[places] if deeper else None
            yield Cells(found, 64, refined, self._shown(held, found))
        for places in self._divided() if deeper else ():
            eighths = octree.bricks[places].view(np.uint8)
            held = [one.of_bricks(places).reshape(-1, *one.row) for one in self._values(1)]
            found = np.bitwise_count(eighths)
            refined = self._eighths_divided(places) if deeper > 1 else None
            yield Cells(found, 8, refined, self._shown(held, found))
        for places in self._divided() if deeper > 1 else ():
            chosen = self._eighths_divided(places)
            found = np.unpackbits(octree.bricks[places].view(np.uint8)[chosen], bitorder="little")
            held = [
                one.of_bricks(places).reshape(-1, 8, *one.row)[chosen].reshape(-1, *one.row)
                for one in self._values(0)
            ]
            yield Cells(found, 1, None, self._shown(held, found))

    def _values(self, size: int) -> list[CellValues]:
        """Return the values of the attributes in cells of 2**size voxels a side."""
        if size not in self._known:
            self._known[size] = [CellValues(one.octree, one.name, size) for one in self.attributes]
        return self._known[size]

    def _shown(self, held: list[np.ndarray], counts: np.ndarray) -> list[np.ndarray]:
        """Return values as the file has them."""
        pairs = zip(self.attributes, held, strict=True)
        return [one.shown(values, counts != 0) for one, values in pairs]

    def _pieces(self) -> Iterator[slice]:
        for first in range(0, len(self.octree.bricks), self.step):
            yield slice(first, first + self.step)

    def _divided(self) -> Iterator[np.ndarray]:
        """Yield the indices of the bricks that have children."""
        for part in self._pieces():
            yield part.start + np.flatnonzero(self._bricks_divided[part])

    @cached_property
    def _bricks_divided(self) -> np.ndarray:
        """Flags of the bricks that have children, (m,) bool."""
        parts = [np.empty(0, bool)]
        for part in self._pieces():
            bricks = self.octree.bricks[part]
            parts.append((bricks != 0) & (bricks != ALL_VOXELS))
            for values in self._values(0):
                parts[-1] |= _differ(values.of_bricks(part)) & (bricks != 0)
        return np.concatenate(parts)

    def _eighths_divided(self, places: np.ndarray) -> np.ndarray:
        """Return whether each eighth of bricks has children, (8 n,) bool."""
        eighths = self.octree.bricks[places].view(np.uint8)
        found = (eighths != 0) & (eighths != EIGHTH)
        for values in self._values(0):
            each = values.of_bricks(places).reshape(-1, 8, *values.row)
            found |= _differ(each) & (eighths != 0)
        return found


def _differ(values: np.ndarray) -> np.ndarray:
    """Return for each row of (n, k, ...) values whether they differ."""
    found = values != values[:, :1]
    return found.reshape(len(found), -1).any(axis=1)
