"""Packing of a field in 3-D textures, as a GPU takes them [ADF, sections 3.1 and 3.2].

Blocks lie side by side along x, y and z, as near to a cube as they go: so they fit the limit of a
device if any arrangement does, and the texels of a block are near each other in memory. A cell has
a pointer to its block: the place of the block along x, y and z, POINTER_BITS bits each. The first
texel of the voxels of block p is 3 p, and that of its bounds 2 p. The cells and the hash are
cubes whose sides are at most about those of the voxels, so they fit, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.field.cells import identifiers_in
from voxtool.arrays import Blocks, blocks_of
from voxtool.errors import FileError

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField

VERTICES, CHILDREN = 3, 2  # of a block along an axis: texels of its voxels and of its bounds
POINTER_BITS = 10  # bits of a place along an axis


def arrangement(n: int) -> tuple[int, int, int]:
    """Return the number of places along x, y and z for n blocks: nearly a cube, with room for n."""
    x = 1
    while x**3 < n:
        x += 1
    z = -(-n // (x * x))
    return x, -(-n // (x * z)), z


def most_blocks(max_texture: int) -> int:
    """Return the number of blocks that fit a texture of `max_texture` texels along each axis."""
    return (max_texture // VERTICES) ** 3


def pointers_to(n: int) -> np.ndarray:
    """Return the pointers to n blocks, (n,) uint32: x in the lowest bits, then y, then z."""
    x, y, _ = arrangement(n)
    place = np.arange(n, dtype=np.uint32)
    return place % x | place // x % y << POINTER_BITS | place // (x * y) << 2 * POINTER_BITS


def pack_blocks(blocks: np.ndarray) -> np.ndarray:
    """Return blocks as a texture, [z, y, x], whose places without a block are 0.

    blocks : (n, s, s, s), [block, z, y, x]
    """
    return np.concatenate(list(layers_of(blocks).blocks))


def layers_of(blocks: np.ndarray) -> Blocks:
    """Return the same texture in layers of blocks, for blocks that are not in memory."""
    side = blocks.shape[-1]
    x, y, z = arrangement(len(blocks))

    def layers() -> Iterator[np.ndarray]:
        for some in blocks_of(blocks, x * y):
            places = np.zeros((x * y, side, side, side), blocks.dtype)
            places[: len(some)] = some
            apart = places.reshape(y, x, side, side, side).transpose(2, 0, 3, 1, 4)
            yield apart.reshape(side, y * side, x * side)

    return Blocks(z * side, blocks.dtype, layers(), (y * side, x * side))


def unpack_blocks(texture: np.ndarray, side: int) -> np.ndarray:
    """Return the blocks at all places of a texture, (places, side, side, side)."""
    z, y, x = (length // side for length in texture.shape)
    apart = texture.reshape(z, side, y, side, x, side).transpose(0, 2, 4, 1, 3, 5)
    return apart.reshape(-1, side, side, side)


def pack_cells(cells: np.ndarray) -> np.ndarray:
    """Return (m, m, m, 2 or 3) texels of cells with pointers instead of numbers of blocks."""
    taken, packed = identifiers_in(cells) != 0, cells.copy()
    packed[taken, -1] = pointers_to(int(np.count_nonzero(taken)))[cells[taken, -1]]
    return packed


def shapes(field: DistanceField) -> dict[str, list[int]]:
    """Return the texels along x, y and z of each texture, and its channels."""
    places = arrangement(len(field.voxels))
    found = {
        "voxels": [*(VERTICES * side for side in places), 1],
        "cells": [*field.cells.shape],
        "hash": [*field.hash.offsets.shape],
    }
    if field.bounds is not None:
        found["bounds"] = [*(CHILDREN * side for side in places), 1]
    return found


def unpack(
    voxels: np.ndarray, cells: np.ndarray, bounds: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the voxels, cells and bounds of a DistanceField from textures, packed in any order.

    Raises
    ------
    FileError
        If a pointer leads to no place, or two to the same.
    """
    if not voxels.size or any(length % VERTICES for length in voxels.shape):
        raise FileError(f"dataset voxels has shape {voxels.shape}: blocks of 3 x 3 x 3 fill it")
    sides = np.array(voxels.shape[::-1]) // VERTICES
    identifiers, pointers = identifiers_in(cells).ravel(), cells[..., -1].ravel()
    taken = np.flatnonzero(identifiers)
    if np.count_nonzero(pointers) > np.count_nonzero(pointers[taken]):
        raise FileError("field cells: a free slot has a pointer")
    order = taken[np.argsort(identifiers[taken], kind="stable")]
    shifts = POINTER_BITS * np.arange(3, dtype=np.uint32)
    axes = (pointers[order, None] >> shifts).astype(np.int64)
    axes[:, :2] &= (1 << POINTER_BITS) - 1
    if (axes >= sides).any():
        raise FileError("field cells: a pointer leads beyond the voxels")
    places = axes[:, 0] + sides[0] * (axes[:, 1] + sides[1] * axes[:, 2])
    if np.bincount(places, minlength=math.prod(sides.tolist())).max(initial=0) > 1:
        raise FileError("field cells: two pointers lead to one block")
    numbered = cells.copy()
    numbered.reshape(-1, cells.shape[-1])[order, -1] = np.arange(len(order))
    return (
        unpack_blocks(voxels, VERTICES)[places],
        numbered,
        None if bounds is None else unpack_blocks(bounds, CHILDREN)[places],
    )
