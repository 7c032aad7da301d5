"""Lists of the blocks and cubes of an image: in Morton order, and sorted along an axis."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, Self

import numpy as np

from voxtool.morton import gather_bits, morton_encode


class Leaves(NamedTuple):
    """The blocks and the cubes of an image, in Morton order."""

    codes: np.ndarray  # (n,) uint64 of blocks
    nodes: np.ndarray  # (n,) int64 indices of their nodes, or UNIFORM
    cubes: list[tuple[np.ndarray, int]]  # codes and side in cells, coarse ones first


class Sorted(NamedTuple):
    """Nodes of one width, sorted along an axis."""

    by_place: np.ndarray
    places: np.ndarray
    width: int

    @classmethod
    def along(cls, axis: int, codes: np.ndarray, width: int) -> Self:
        places = gather_bits(codes >> np.uint64(axis)).astype(np.int64) * width
        by_place = np.argsort(places, kind="stable")
        return cls(by_place, places[by_place], width)

    def at(self, start: int) -> np.ndarray:
        """Return the indices of the nodes that contain the cell `start`."""
        place = start - start % self.width
        return self.by_place[slice(*np.searchsorted(self.places, [place, place + 1]).tolist())]


@cache
def places_in(side: int) -> np.ndarray:
    """Return the Morton code of each cell of a block, (side, side, side)."""
    return morton_encode(np.indices((side,) * 3).reshape(3, -1).T).reshape((side,) * 3)


def keys_of(cells: np.ndarray) -> np.ndarray:
    """Return (3, N) cells as int64 keys of 21 bits for x, y and z, in lexicographic order."""
    x, y, z = cells
    return (x << 42) | (y << 21) | z
