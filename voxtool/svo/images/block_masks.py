"""Bit masks of the blocks of 8 x 8 x 8 cells of an image, with z running fastest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from voxtool.svo.images.image import UNIFORM, VoxelImage
from voxtool.svo.octree.layout import LINK, voxels_within
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS

SIDE, POWER = 8, 3
CHUNK = 1 << 15  # blocks at once: their masks stay in the cache
OCTANTS = np.indices((2, 2, 2)).reshape(3, -1).T[:, ::-1]  # the bricks of a block, in Morton order
# Pairs of bits of a voxel's place in a brick that are swapped in turn, so that a Morton code
# (z1 y1 x1 z0 y0 x0, the lowest bit last) becomes x1 x0 y1 y0 z1 z0.
SWAPS = ((0, 2), (1, 5), (2, 5), (3, 4), (4, 5))


class Masks(NamedTuple):
    """Masks of blocks, in Morton order."""

    corners: np.ndarray  # (n, 3) int64: the low cells, counted from the grid's corner
    bits: np.ndarray  # (n, 64) uint8: bit z of byte 8 x + y is cell (x, y, z)
    values: np.ndarray | None = None  # (n, 512), where those that are set differ


def block_masks(image: VoxelImage) -> Iterator[Masks]:
    """Yield the masks of the cells that are not zero, of the blocks of `image.blocks(8)`."""
    if image.level or image.shape != image.octree.grid.shape:
        for blocks in image.blocks(SIDE):
            cells = blocks.values.reshape(-1, SIDE**3)
            bits = np.packbits(cells != 0, axis=1, bitorder="little")
            differ = image.level > 0 and image.dtype != bool
            yield Masks(blocks.corners, bits, cells if differ else None)
        return
    corners, nodes = image.block_nodes(SIDE)
    octree = image.octree
    assert isinstance(octree, Octree)
    links = octree.child_words(octree.depth - 1 - (POWER - 2)) & LINK
    for first in range(0, len(nodes), CHUNK):
        chosen = slice(first, first + CHUNK)
        mixed = nodes[chosen] != UNIFORM
        bricks = np.full((len(mixed), 8), 0 if image.invert else ALL_VOXELS, np.uint64)
        bricks[mixed] = octree.bricks[links[nodes[chosen][mixed], None] + np.arange(8)]
        if image.invert:
            cells = (corners[chosen, None] // 4 + OCTANTS).reshape(-1, 3)
            within = voxels_within(cells, octree.grid.shape).reshape(-1, 8)
            bricks = ~bricks & within
        held = bricks.any(axis=1)
        image.progress(min((first + CHUNK) / len(nodes), 1.0))
        yield Masks(corners[chosen][held], _of_bricks(bricks[held]))


def _of_bricks(bricks: np.ndarray) -> np.ndarray:
    """Return the (n, 64) masks of (n, 8) bricks, both in Morton order."""
    words = bricks.copy()
    for low, high in SWAPS:
        _swap(words, low, high)
    # Byte 2 x + (y >> 1) of a brick holds four bits along z for an even y, then for an odd one.
    parts = words.astype("<u8", copy=False).view(np.uint8).reshape(-1, 2, 2, 2, 4, 2)
    near, far = parts[:, 0], parts[:, 1]  # by z; then by y, by x, x, y >> 1
    found = np.empty((len(bricks), 2, 4, 2, 2, 2), np.uint8)  # by x, x, y, y >> 1, y & 1
    columns = found.transpose(0, 3, 1, 2, 4, 5)
    columns[..., 0] = (near & 15) | (far << 4)
    columns[..., 1] = (near >> 4) | (far & 240)
    return found.reshape(-1, 64)


def _swap(words: np.ndarray, low: int, high: int) -> None:
    """Exchange two bits of the places of all bits, in place."""
    places = np.arange(64)
    moved = places[(places >> low & 1 == 1) & (places >> high & 1 == 0)]
    shift = np.uint64((1 << high) - (1 << low))
    mask = np.uint64(sum(1 << int(place) for place in moved))
    changed = (words ^ (words >> shift)) & mask
    words ^= changed ^ (changed << shift)
