"""Attributes of voxels as grids of OpenVDB and NanoVDB, beside that of the voxels.

All values are float32: a file with a grid of whole numbers is refused by OpenVDB's module for
Python as distributions build it, and Blender draws floats alone. Labels count from 1; fractions are
from 0 to 1; colours are in linear light, without opacity. The active cells are those of the grid of
the voxels; cubes of one value are tiles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.files.grids.vdb_encode import (
    CELLS,
    FLOAT,
    LEAF_SIDE,
    MASK_BYTES,
    Inside,
    Leaves,
    keys_of,
    packed,
    tiles_with,
)
from voxtool.mesh.srgb import LEVELS, to_linear
from voxtool.svo.images.attribute_image import AttributeImage

TYPES = {(): "Tree_float_5_4_3", (3,): "Tree_vec3s_5_4_3"}  # by the shape of a value
MOST = 1 << 24  # whole numbers that float32 holds


def shown(name: str, values: np.ndarray) -> np.ndarray:
    """Return values of an attribute as a grid holds them."""
    if name == "colour":
        levels = to_linear(np.arange(LEVELS + 1, dtype=np.uint8)).astype(FLOAT)
        return levels[values[..., :3]]
    if name == "fraction" and values.dtype.kind == "u":
        values = values / np.iinfo(values.dtype).max
    return values.astype(FLOAT)


@dataclass(frozen=True)
class AttributeGrid:
    """A grid of an attribute.

    Attributes
    ----------
    name : str
        The attribute.
    leaves : Leaves
        With the values of the active cells.
    tiles : dict of (n,) int64
        The places of the tiles by the name of the node.
    inside : Inside
        The values of the tiles.
    """

    name: str
    leaves: Leaves
    tiles: dict[str, np.ndarray]
    inside: Inside

    @property
    def type(self) -> str:
        """The name of the tree's type in OpenVDB."""
        return TYPES[self.background.shape]

    @property
    def background(self) -> np.ndarray:
        """The value of what is not set."""
        return np.zeros(self.inside.value["leaf"].shape[1:], FLOAT)

    @classmethod
    def of(cls, image: AttributeImage, voxels: Leaves, pack: bool = True) -> AttributeGrid:
        """Return the grid of an attribute, given the leaves of the grid of the voxels; without
        `pack`, the values of leaves are the bytes of the active cells."""
        if len(image.names) > MOST:
            raise VoxtoolError(f"{len(image.names):,} labels: a float32 holds {MOST:,}")
        row = shown(image.name, np.zeros((1, *image.row), image.dtype)).shape[1:]
        cubes = [(c, side, shown(image.name, v)) for c, side, v in image.cubes(LEAF_SIDE)]
        keys, masks, values = [np.empty(0, np.int64)], [np.empty((0, MASK_BYTES), np.uint8)], []
        for blocks in image.blocks(LEAF_SIDE):
            places = keys_of(blocks.corners)
            rows = shown(image.name, blocks.values).reshape(len(places), CELLS, *row)
            at = np.searchsorted(voxels.keys, places)
            partly = np.append(voxels.keys, -1)[at] == places  # the others are wholly set
            alike = (rows == rows[:, :1]).reshape(len(rows), -1).all(axis=1) & ~partly
            cubes.append((blocks.corners[alike], LEAF_SIDE, rows[alike, 0]))
            bits = np.full((len(rows), MASK_BYTES), 255, np.uint8)
            bits[partly] = voxels.masks[at[partly]]
            active = np.unpackbits(bits, axis=1, bitorder="little") != 0
            data = [rows[i][active[i]].tobytes() for i in np.flatnonzero(~alike)]
            keys.append(places[~alike])
            masks.append(bits[~alike])
            values += (bytes(1) + packed(part) for part in data) if pack else data
        leaves = Leaves.ordered(np.concatenate(keys), np.concatenate(masks), values)
        tiles, inside = tiles_with(cubes, row)
        inside = {name: each.astype(FLOAT) for name, each in inside.items()}
        return cls(image.name, leaves, tiles, Inside(inside, True))
