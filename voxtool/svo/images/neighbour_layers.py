"""Layers of the cells of an image, one after the other along x, each with its two neighbours.

A layer is a list of keys. A key is the place of a cell in rows along z, with one place more at both
ends of a row, and one row more at both sides. So the neighbours of a cell in its layer have the
keys before and after it, and those a row before and after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from typing import NamedTuple, Self

import numpy as np

from voxtool.svo.images.image import VoxelImage

TABLE = 1 << 24  # places of a plane, up to which a table finds keys
SPARSE = 256  # times as many places as keys make a search faster than a table


class Rows(NamedTuple):
    """The rows of a layer.

    width : keys from one row to the next; size : the number that all keys are below.
    """

    width: int
    size: int

    @classmethod
    def of(cls, image: VoxelImage) -> Self:
        """Return those of the layers of an image."""
        width = image.shape[2] + 2
        return cls(width, width * (image.shape[1] + 2))

    @property
    def bytes(self) -> int:
        """The most that a table of keys has."""
        return 4 * min(TABLE, self.size)


class Places:
    """Ascending keys of places in a plane, which can be found.

    Parameters
    ----------
    keys : (n,) int
    size : int
        The number that all keys are below.
    values : (n,), optional
        What is there.
    """

    def __init__(self, keys: np.ndarray, size: int, values: np.ndarray | None = None) -> None:
        self.keys, self.values = keys, values
        self._table = None
        if len(keys) and size <= min(TABLE, SPARSE * len(keys)):
            self._table = np.full(size, -1, np.int32)
            self._table[keys] = np.arange(len(keys), dtype=np.int32)

    @classmethod
    def united(cls, parts: list[np.ndarray], size: int) -> Places:
        """Return the places of the keys of several lists."""
        dtype = parts[0].dtype
        if size > min(TABLE, SPARSE * sum(map(len, parts))):
            return cls(np.unique(np.concatenate(parts)), size)
        held = np.zeros(size, bool)
        for keys in parts:
            held[keys] = True
        return cls(np.flatnonzero(held).astype(dtype), size)

    def __len__(self) -> int:
        return len(self.keys)

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Return where keys are in the list, (m,) int; -1 if one is not."""
        if self._table is not None:
            return self._table[keys]
        if not len(self.keys):
            return np.full(len(keys), -1)
        found = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[found] == keys, found, -1)


def layers_of(
    image: VoxelImage, listed: Iterable[tuple[np.ndarray, np.ndarray]] | None = None
) -> Iterator[tuple[int, Places, Places, Places]]:
    """Yield layers with x from -1 to the number of layers: x, the cells that are not zero in the
    layer below it, in it and above it. It is left out if none of the three has cells.

    `listed` has the cells of `image.coordinates()` with values, in pieces.
    """
    none = Places(np.empty(0, np.int64), 0)
    held: dict[int, Places] = {}
    done, last = -2, -4  # the layer that was yielded last, and the last one with cells
    pieces = listed or ((cells, None) for cells in image.coordinates())
    for x, cells in chain(_layers(image, pieces), [(None, none)]):
        if x is not None:
            held[x] = cells
        end = last + 2 if x is None else x  # what is before it has known neighbours
        for at in (last, last + 1, end - 1):
            if done < at < end:
                below, own, above = (held.get(n, none) for n in (at - 1, at, at + 1))
                yield at, below, own, above
                done = at
        last = end
        held = {n: places for n, places in held.items() if n >= last - 1}


def _layers(
    image: VoxelImage, pieces: Iterable[tuple[np.ndarray, np.ndarray | None]]
) -> Iterator[tuple[int, Places]]:
    """Yield each layer that has cells: its x and the keys of its cells."""
    width, size = Rows.of(image)
    dtype = np.int32 if size < 1 << 31 else np.int64
    for cells, each in pieces:
        x = cells[:, 0]
        keys = (cells[:, 1].astype(dtype) + 1) * width + cells[:, 2] + 1
        starts = np.flatnonzero(np.diff(x, prepend=-1))
        for start, end in pairwise([*starts.tolist(), len(x)]):
            part = None if each is None else each[start:end]
            yield int(x[start]), Places(keys[start:end].astype(dtype), size, part)
