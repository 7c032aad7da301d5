"""The colours of the cells of a .vox: numbers of a palette, from 1 on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from voxtool.files.grids.quantize import MOST, packed, palette_of, unpacked
from voxtool.palette import palette
from voxtool.svo.images.attribute_image import AttributeImage, attributes_of
from voxtool.svo.images.image import VoxelImage

BLOCK = 32  # cells along a side of what is painted at once
GREY = (204, 204, 204, 255)  # of cells without a colour


@dataclass(frozen=True, eq=False)
class Paint:
    """A palette, and which of its colours cells have.

    Attributes
    ----------
    image : VoxelImage
        The cells.
    attribute : AttributeImage or None
        Their colours or labels; None if all are grey.
    colours : (P, 4) uint8
        The palette, of number 1 on.
    known : (N,) uint32
        The colours that cells have, packed and in ascending order.
    place : (N,) int64
        Where each known colour is in the palette.
    """

    image: VoxelImage
    attribute: AttributeImage | None
    colours: np.ndarray
    known: np.ndarray
    place: np.ndarray

    @classmethod
    def of(cls, image: VoxelImage) -> Self:
        """Return the paint of an image with at most one attribute."""
        none = np.empty(0, np.uint32)
        attribute = next(iter(attributes_of(image)), None)
        if attribute is None:
            return cls(image, None, np.array([GREY], np.uint8), none, none)
        if attribute.name == "label":
            count = min(max(len(attribute.attribute.names), 1), MOST)
            colours = np.column_stack([palette(count), np.full(count, 255)]).astype(np.uint8)
            return cls(image, attribute, colours, none, none)
        known, counts = none, np.empty(0, np.int64)
        for values in attribute.listed():
            some, times = np.unique(packed(values), return_counts=True)
            known, back = np.unique(np.concatenate([known, some]), return_inverse=True)
            both = np.zeros(len(known), np.int64)
            np.add.at(both, back, np.concatenate([counts, times]))
            counts = both
        colours, place = palette_of(unpacked(known), counts)
        return cls(image, attribute, colours, known, place)

    def rgba(self, count: int) -> bytes:
        """Return the palette as .vox stores it, given the number of its colours."""
        rows = np.empty((count, 4), np.uint8)
        rows[:] = GREY
        rows[: len(self.colours)] = self.colours
        return rows.tobytes()

    def numbers(self, values: np.ndarray) -> np.ndarray:
        """Return the numbers of the colours of values of the attribute."""
        assert self.attribute
        if self.attribute.name == "label":  # counted from 1; colours of many begin again
            return ((values.astype(np.int64) - 1) % MOST + 1).astype(np.uint8)
        at = np.minimum(np.searchsorted(self.known, packed(values)), len(self.known) - 1)
        return (self.place[at] + 1).astype(np.uint8)

    def blocks(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the low cell of each block that is neither empty nor in a cube, and the numbers of
        its colours, 0 for cells that are not set; in Morton order."""
        own = (
            piece
            for blocks in self.image.blocks(BLOCK)
            for piece in zip(blocks.corners, blocks.values, strict=True)
        )
        if not self.attribute:
            yield from ((corner, values.astype(np.uint8)) for corner, values in own)
            return
        painted = (values for blocks in self.attribute.blocks(BLOCK) for values in blocks.values)
        for (corner, held), values in zip(own, painted, strict=True):
            numbers = np.zeros(held.shape, np.uint8)
            numbers[held] = self.numbers(values[held])
            yield corner, numbers

    def cubes(self) -> Iterator[tuple[np.ndarray, int, np.ndarray]]:
        """Yield the low cells, the side and the numbers of cubes that are wholly set."""
        if not self.attribute:
            for cubes in self.image.cubes(BLOCK):
                yield cubes.corners, cubes.side, np.ones(len(cubes.corners), np.uint8)
            return
        found: list[Any] = self.attribute.cubes(BLOCK)
        for corners, side, values in found:
            yield corners, side, self.numbers(values)
