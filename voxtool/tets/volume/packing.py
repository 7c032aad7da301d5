"""Packing of a volume in 2-D textures, as a GPU takes them [TetVol, section 4.1].

The items of a texture, cells, vertices or blocks of cells, fill rows. A row has the least power of
two of texels whose square holds them all. So item i is texel (i mod width, i div width), found by a
mask and a shift, and a texture fits a device's limit if it does with any power of two as its width.
A texture has four channels at most: items of more numbers have two layers.
"""

from __future__ import annotations

import numpy as np


def width_for(count: int) -> int:
    """Return the number of texels in a row of a texture of `count` items."""
    return 1 << (-(-max(count - 1, 0).bit_length() // 2))


def rows_for(count: int) -> int:
    """Return the number of rows of a texture of `count` items."""
    return -(-count // width_for(count))


def pack_rows(items: np.ndarray) -> np.ndarray:
    """Return (..., n, channels) items as (..., rows, width, channels); texels without one are 0."""
    *layers, count, channels = items.shape
    rows, width = rows_for(count), width_for(count)
    packed = np.zeros((*layers, rows * width, channels), items.dtype)
    packed[..., :count, :] = items
    return packed.reshape(*layers, rows, width, channels)


def unpack_rows(texture: np.ndarray, count: int) -> np.ndarray:
    """Return the first `count` items of a (..., rows, width, channels) texture."""
    *layers, rows, width, channels = texture.shape
    items = texture.reshape(*layers, rows * width, channels)[..., :count, :]
    return np.ascontiguousarray(items)


def pack_layers(items: np.ndarray) -> np.ndarray:
    """Return (n, c) items as (layers, rows, width, c / layers): one layer for up to four channels,
    and two for up to eight."""
    layers = layers_for(items.shape[1])
    return pack_rows(np.moveaxis(items.reshape(len(items), layers, -1), 1, 0))


def unpack_layers(texture: np.ndarray, count: int) -> np.ndarray:
    """Return the first `count` items of a (layers, rows, width, c / layers) texture, (count, c)."""
    return np.moveaxis(unpack_rows(texture, count), 0, 1).reshape(count, -1)


def layers_for(channels: int) -> int:
    """Return the number of layers of a texture whose items have `channels` numbers."""
    return -(-channels // 4)
