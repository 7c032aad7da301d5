"""An attribute of the cells of an image: what exports of it are written from.

Where the image's own value is 0, the attribute is 0. Labels count from 1, so that 0 is no label:
label i of the octree is i + 1, and the name of number 0 is "".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import Any, ClassVar

import numpy as np

from voxtool.morton import morton_decode
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.cells.counts import BRICK_POWER
from voxtool.svo.images.blocks import keys_of, places_in
from voxtool.svo.images.image import CHUNK, EVERY, LAYERS, UNIFORM, VoxelImage
from voxtool.svo.images.slabs import THICK, Blocks, Filled, Order, slabs_of
from voxtool.svo.octree.attributes import Attribute

POWER = THICK.bit_length() - 1
TALLY_BYTES = 100  # bytes of a brick, of sums and values


@dataclass(frozen=True, eq=False)
class AttributeImage:
    """The values of an attribute in the cells of an image.

    Attributes
    ----------
    image : VoxelImage
        The cells; its octree has the attribute.
    name : str
        The attribute.
    """

    smaller: ClassVar[str] = VoxelImage.smaller

    image: VoxelImage
    name: str

    @property
    def octree(self) -> Any:
        """The voxels, an octree with attributes."""
        return self.image.octree

    @property
    def attribute(self) -> Attribute:
        """The attribute of the voxels."""
        return self.octree.attribute(self.name)

    # ---- where it lies, and how large it is

    @property
    def level(self) -> int:
        """A cell has 2**level voxels a side."""
        return self.image.level

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells along each axis."""
        return self.image.shape

    @property
    def origin(self) -> tuple[float, float, float]:
        """World coordinates of the low corner."""
        return self.image.origin

    @property
    def pitch(self) -> tuple[float, float, float]:
        """World size of a cell."""
        return self.image.pitch

    @property
    def units(self) -> str:
        """Name of the world unit, or ""."""
        return self.image.units

    @property
    def quantity(self) -> str:
        """Name of what the values are."""
        return self.name

    @property
    def dtype(self) -> np.dtype:
        """Type of the values: the smallest unsigned one that holds them for labels."""
        attribute = self.attribute
        if self.name == "label":
            return np.dtype(np.min_scalar_type(max(len(attribute.names), 1)))
        return attribute.values.dtype

    @property
    def row(self) -> tuple[int, ...]:
        """Shape of a cell's value: () or (channels,)."""
        return self.attribute.values.shape[1:]

    @property
    def channels(self) -> int:
        """Numbers of a cell."""
        return prod(self.row)

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each label, from 0 on; none for other attributes."""
        return ("", *self.attribute.names) if self.name == "label" else ()

    @property
    def cell_bytes(self) -> int:
        """Bytes of a cell's value."""
        return self.channels * self.dtype.itemsize

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.image.cells

    @property
    def mixed(self) -> int:
        """Number of numbers in the blocks of 4 x 4 x 4 cells that are no leaves."""
        return self.image.mixed * self.channels

    @property
    def nbytes(self) -> int:
        """Bytes of all values, as a dense array."""
        return self.cells * self.cell_bytes

    @property
    def layer_bytes(self) -> int:
        """A bound of the memory of some layers of values."""
        a, b = sorted(self.shape)[1:]
        return LAYERS * a * b * self.cell_bytes if self.image.dense else 0

    @property
    def own_bytes(self) -> int:
        """A bound of the memory of the octree's values, of layers of them and of those of nodes; 0
        for an image in parts, where it counts with the octree's."""
        if self.image.in_parts:
            return 0
        values, level = self.attribute.nbytes, self.level
        if self.image.tree:
            values, level = 2 * values, max(level, BRICK_POWER)
        return values + tally_bytes(level, len(self.octree.bricks)) + self.layer_bytes

    @property
    def host_bytes(self) -> int:
        """A bound of the memory of what is held at once, with that of the image."""
        return self.image.host_bytes + self.own_bytes

    @property
    def progress(self) -> Any:
        """See VoxelImage."""
        return self.image.progress

    def digest(self) -> str:
        """Return the digest of the octree, also if only a part of it is here."""
        return self.image.digest()

    # ---- values

    @cached_property
    def _values(self) -> CellValues:
        whole: Any = self.image.whole
        about = whole.attribute(self.name) if whole else None
        return CellValues(self.octree, self.name, self.level, about)

    def shown(self, values: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
        """Return values as they are written, 0 where a cell is not held."""
        if self.name == "label":
            values = (values.astype(np.int64) + 1).astype(self.dtype)
        if held is None:
            return values
        return np.where(
            held.reshape(held.shape + (1,) * len(self.row)), values, values.dtype.type(0)
        )

    def _block_values(
        self, codes: np.ndarray, nodes: np.ndarray, power: int
    ) -> tuple[Blocks, np.ndarray]:
        """Return blocks of the image, and the values of their cells."""
        own, side = self.image.unpacked(codes, nodes, power), 1 << power
        cells = self._values
        level = min(cells.level + power, len(cells.levels) - 1)
        found = np.zeros((len(nodes), side**3, *self.row), cells.dtype)
        uniform = nodes == UNIFORM
        inner = cells.of_cells(level, nodes[~uniform])
        found[~uniform, : inner.shape[1]] = inner  # of the whole grid, if a block holds it
        found[uniform] = cells.around(codes[uniform], level)[:, None]
        return own, self.shown(found[:, places_in(side)], own.values != 0)

    def _of_cubes(self, codes: np.ndarray, width: int) -> np.ndarray:
        """Return the values of cubes of this side in cells that are wholly set."""
        number = self._values.level + width.bit_length() - 1
        return self.shown(self._values.around(codes, number))

    def _row(self, axis: int, start: int) -> tuple[Blocks, Blocks, list[Filled]]:
        """Return the blocks of four layers of the image, with its values and with these, and the
        cubes."""
        blocks, cubes = self.image.within(axis, start)
        own, values = self._block_values(*blocks, POWER)
        filled = [
            Filled(morton_decode(codes) * width, width, self._of_cubes(codes, width))
            for codes, width in cubes
        ]
        return own, Blocks(own.corners, values), filled

    def slabs(self, order: Order = EVERY) -> Iterator[np.ndarray]:
        """Yield the values transposed to the axes `order`, with their channels last, in pieces of
        at most four layers.

        Raises
        ------
        MemoryLimitError
            If the layers do not fit in memory.
        """
        for part in self.parts(order[0]):
            image, kind = part.image, (part.dtype, part.row)
            row = part._row
            yield from slabs_of(
                image.low,
                image.shape,
                order,
                kind,
                lambda *at, row=row: row(*at)[1:],
                image.progress,
            )

    def parts(self, axis: int = 0, least: int = THICK) -> Iterator[AttributeImage]:
        """Yield the attribute of each part of the image; other attributes are not read."""
        for part in replace(self.image, attributes=(self.name,)).parts(axis, least):
            yield replace(self, image=part)

    def listed(self) -> Iterator[np.ndarray]:
        """Yield the values of the cells that `image.listed()` yields, in the same pieces."""
        for part in self.parts():
            yield from part._listed()

    def _listed(self) -> Iterator[np.ndarray]:
        image = self.image
        low, high = image.low[0], image.low[0] + image.shape[0]
        for start in range(low - low % THICK, high, THICK):
            own, blocks, cubes = self._row(0, start)
            block, *local = held = np.nonzero(own.values)
            keys = [keys_of(own.corners[block].T + np.stack(local))]
            values = [blocks.values[held]]
            for corners, side, each in cubes:
                inside = np.indices((THICK, side, side)).reshape(3, -1).T
                corners[:, 0] = start
                keys.append(keys_of((corners[:, None] + inside).reshape(-1, 3).T))
                values.append(np.repeat(each, len(inside), axis=0))
            yield np.concatenate(values)[np.argsort(np.concatenate(keys))]

    def blocks(self, side: int) -> Iterator[Blocks]:
        """Yield the blocks of side**3 cells that hold something and are not in `cubes(side)`, some
        at a time, in Morton order."""
        power = side.bit_length() - 1
        codes, nodes = self.image.block_codes(side)
        step = max(CHUNK >> (3 * power), 1)
        for start in range(0, len(codes), step):
            chosen = slice(start, start + step)
            own, values = self._block_values(codes[chosen], nodes[chosen], power)
            held = own.values.any(axis=(1, 2, 3))
            yield Blocks(own.corners[held], values[held])

    def cubes(self, side: int) -> list[Filled]:
        """Return the cubes of `side` or more cells that are wholly set, coarse ones first."""
        return [
            Filled(morton_decode(codes) * width, width, self._of_cubes(codes, width))
            for codes, width in self.image.cube_codes(side)
        ]


def tally_bytes(level: int, bricks: int) -> int:
    """Return a bound of the memory that cells of a level need for the values of nodes, given the
    number of bricks."""
    return TALLY_BYTES * bricks if level >= BRICK_POWER else 0


def listed_with(
    image: VoxelImage, names: Sequence[str]
) -> Iterator[tuple[np.ndarray, np.ndarray, list[np.ndarray]]]:
    """Yield the pieces of `image.listed()`, each with the values of attributes of its cells."""
    for part in image.parts():
        more = [AttributeImage(part, name).listed() for name in names]
        for (cells, values), *others in zip(part.listed(), *more, strict=True):
            cells[:, 0] += part.low[0] - image.low[0]
            yield cells, values, others


def attributes_of(image: Any) -> list[AttributeImage]:
    """Return the attributes that are written with an image."""
    return [AttributeImage(image, name) for name in getattr(image, "attributes", ())]
