"""Images of octrees that are larger than the memory that they may take, part by part.

A part is a box of the grid. Only the nodes of the octree that reach it are read (cells.py), and its
image is that of any octree. Parts follow one another along the slowest axis of what is written, so
that the output is that of the whole image; a part that does not fit after all is halved.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.memory import available_memory
from voxtool.svo.attributes.of_parts import AttributeParts
from voxtool.svo.cells.subtrees import Cells
from voxtool.svo.images.attribute_image import attributes_of, tally_bytes
from voxtool.svo.images.image import EVERY, NODES, VoxelImage
from voxtool.svo.images.image import NODE_BYTES as LIST_BYTES
from voxtool.svo.images.slabs import THICK, Order
from voxtool.svo.octree.octree import Octree, in_memory

SHARE = 8  # bytes of memory for a byte of the nodes of a part: its bricks, lists and counts


@dataclass(frozen=True, eq=False)
class ImageInParts(VoxelImage):
    """The image of an octree that is not in memory.

    Attributes
    ----------
    limit : int
        Bytes that it may take.
    """

    in_parts: ClassVar[bool] = True

    limit: int = 0

    @property
    def layer_bytes(self) -> int:
        """A bound of the memory of some layers of cells and of their attributes."""
        return super().layer_bytes + sum(one.layer_bytes for one in attributes_of(self))

    @property
    def host_bytes(self) -> int:
        """Bytes of what is held at once, if the parts fit."""
        return max(self.limit, self.layer_bytes)

    @property
    def mixed(self) -> int:
        """A bound of the same number: the blocks that have nodes, and those at sides of the box."""
        sizes = np.diff(self.octree.offsets.astype(np.int64))[::-1].tolist()
        a, b, c = (n // THICK + 2 for n in self.shape)
        return THICK**3 * (sizes[min(self.level, len(sizes) - 1)] + 2 * (a * b + b * c + c * a))

    @cached_property
    def count(self) -> int:
        """Number of cells whose value is not zero."""
        if self.level == 0 and self.shape == self.octree.grid.shape:
            return self.cells - self.octree.count if self.invert else self.octree.count
        return sum(part.count for part in self._plain.parts())

    def part(self, low: tuple[int, int, int], shape: tuple[int, int, int]) -> VoxelImage:
        """Return the image of a box: its low cell, counted from the grid's corner, and its cells
        along each axis. MemoryLimitError if it takes more than it may."""
        octree, begin = self.octree, self.side * np.array(low)
        cut = self._cut(begin, begin + self.side * np.array(shape))
        cut = replace(cut, grid=octree.grid, units=octree.units, transform=octree.transform)
        return VoxelImage(cut, **self._shared | {"low": low, "shape": shape, "whole": octree})

    def _cut(self, begin: np.ndarray, end: np.ndarray) -> Octree:
        """Return the octree of a box of voxels, with the attributes of the image."""
        most = max(self.limit - self.layer_bytes, 0)
        if not self.attributes:
            return self._root.cut(np.zeros(3, np.int64), 1, begin, end, most // SHARE)
        cut = self._root.cut_of_whole(begin, end, most // SHARE)
        tallies = len(self._values) * tally_bytes(self.level, len(cut.octree.bricks))
        values = sum(one.nbytes(cut) for one in self._values)
        if SHARE * cut.octree.nbytes + tallies + values > most:
            raise MemoryLimitError(f"a part of an octree takes more than {human(most)}")
        return replace(cut.octree, attributes=tuple(one.of(cut) for one in self._values))

    def parts(self, axis: int = 0, least: int = THICK) -> Iterator[VoxelImage]:
        if self.level >= NODES and not self.attributes:
            yield VoxelImage(self.octree, **self._shared)
            return
        low, shape = list(self.low), list(self.shape)
        first, end = low[axis], low[axis] + shape[axis]
        start, thick = first, self._thickness(axis, least)
        while start < end:
            stop = min((start // thick + 1) * thick, end)
            low[axis], shape[axis] = start, stop - start
            try:
                part = self.part((low[0], low[1], low[2]), (shape[0], shape[1], shape[2]))
            except MemoryLimitError as error:
                if thick == least:
                    raise MemoryLimitError(
                        f"{least} layers of cells do not fit in {human(self.limit)}: choose "
                        f"{self.smaller} (see --max-memory)"
                    ) from error
                thick //= 2
                continue
            done, share = (start - first) / (end - first), (stop - start) / (end - first)
            yield replace(part, progress=lambda own, a=done, b=share: self.progress(a + b * own))
            start = stop

    def slabs(self, order: Order = EVERY) -> Iterator[np.ndarray]:
        for part in self._plain.parts(order[0]):
            yield from part.slabs(order)

    def listed(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for part in self._plain.parts():
            for cells, values in part.listed():
                cells[:, 0] += part.low[0] - self.low[0]
                yield cells, values

    @property
    def _shared(self) -> dict[str, Any]:
        """The fields of the image that a part takes over."""
        names = (item.name for item in fields(VoxelImage) if item.name != "octree")
        return {name: getattr(self, name) for name in names}

    @property
    def _plain(self) -> ImageInParts:
        """The image without attributes."""
        return replace(self, attributes=())

    @cached_property
    def _values(self) -> list[AttributeParts]:
        """Its attributes."""
        octree: Any = self.octree
        return [AttributeParts(octree, name) for name in self.attributes]

    @cached_property
    def _root(self) -> Cells:
        """The octree as one cell."""
        return Cells(self.octree, self.octree.grid.side)

    def _thickness(self, axis: int, least: int) -> int:
        """Return the cells along an axis of a part that fits, if nodes are where they are on
        average; a power of two."""
        thick, octree = least, self.octree
        needed = SHARE * octree.nbytes
        for one in attributes_of(self):
            needed += one.attribute.nbytes + tally_bytes(self.level, len(octree.bricks))
        most = max(self.limit - self.layer_bytes, 0) / (2 * needed + SHARE)
        while 2 * thick <= most * self.all_cells[axis] and thick < self.shape[axis]:
            thick *= 2
        return thick


def bytes_of(image: VoxelImage) -> int:
    """Return a bound of the memory of an image whose octree is in memory."""
    more = sum(one.own_bytes for one in attributes_of(image))
    return LIST_BYTES * int(image.octree.offsets[-1]) + image.layer_bytes + more


def fitting_image(
    image: VoxelImage, max_memory: int | None = None, windows: bool = True
) -> VoxelImage:
    """Return an image that takes no more than `max_memory` bytes, by default half of what is free,
    if that is possible: one of the octree in memory, of its upper nodes alone, of what lies in its
    box, or one in parts. Without `windows` the octree is in memory."""
    octree, limit = image.octree, available_memory() // 2 if max_memory is None else max_memory
    if isinstance(octree, Octree):
        return image
    read = octree.nbytes + sum(one.attribute.nbytes for one in attributes_of(image))
    if not windows or (bytes_of(image) <= limit and 2 * read <= available_memory()):
        return replace(image, octree=in_memory(octree, max_memory, image.attributes))
    upper = image.level >= NODES and not image.attributes  # nodes alone make the image
    if upper and image.host_bytes <= limit:
        return image
    shared = {item.name: getattr(image, item.name) for item in fields(VoxelImage)}
    parts = ImageInParts(**shared, limit=limit)
    if image.shape != image.all_cells:
        with suppress(MemoryLimitError):
            return parts.part(image.low, image.shape)
    return image if upper else parts  # a plan refuses upper nodes that do not fit
