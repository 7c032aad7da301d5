"""Layers of cells, put together from blocks and cubes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from voxtool.memory import check_memory

THICK = 4  # layers of a slab, of blocks of as many cells a side
Order = tuple[int, int, int]


class Blocks(NamedTuple):
    """Blocks of cells of one side, in ascending order of their Morton codes."""

    corners: np.ndarray  # (n, 3) int64: the low cells, counted from the grid's corner
    values: np.ndarray  # (n, side, side, side) of the image's dtype, indexed [block, x, y, z]


class Filled(NamedTuple):
    """Cubes of one side, each of one value."""

    corners: np.ndarray  # (n, 3) int64: the low cells, counted from the grid's corner
    side: int  # in cells
    values: Any  # (n, ...), or one value of all


def slabs_of(
    low: Sequence[int],
    shape: Sequence[int],
    order: Order,
    kind: tuple[np.dtype, tuple[int, ...]],
    row: Callable[[int, int], tuple[Blocks, list[Filled]]],
    progress: Callable[[float], None],
) -> Iterator[np.ndarray]:
    """Yield the values of a box of cells transposed to the axes `order`, in pieces of at most four
    layers.

    Parameters
    ----------
    low, shape : (3,) int
        The box.
    kind : dtype, and the shape of a cell's value
    row : callable
        Returns the blocks of four cells a side and the larger cubes of four layers, given an axis
        and the first of these layers.

    Raises
    ------
    MemoryLimitError
        If the layers do not fit in memory.
    """
    dtype, each = kind
    low, shape = ([size[axis] for axis in order] for size in (low, shape))
    first = [n - n % THICK for n in low]
    sides = [-(-(n + m) // THICK) - f // THICK for n, m, f in zip(low, shape, first, strict=True)]
    size = 2 * THICK**3 * sides[1] * sides[2] * dtype.itemsize * int(np.prod(each))
    check_memory(size, f"{THICK} layers of {shape[1]} x {shape[2]} cells")
    rest = tuple(range(5, 5 + len(each)))
    for start in range(first[0], low[0] + shape[0], THICK):
        slab = np.zeros((THICK, sides[1], THICK, sides[2], THICK, *each), dtype)
        tiles = slab.transpose(1, 3, 0, 2, 4, *rest)
        blocks, cubes = row(order[0], start)
        j, k = ((blocks.corners[:, order[n]] - first[n]) // THICK for n in (1, 2))
        local = (0, *(axis + 1 for axis in order), *(axis - 1 for axis in rest))
        tiles[j, k] = blocks.values.transpose(local)
        for corners, side, values in cubes:
            steps = np.arange(side // THICK)
            j, k = ((corners[:, order[n]] - first[n]) // THICK for n in (1, 2))
            if np.ndim(values):
                values = values.reshape(len(j), 1, 1, 1, 1, 1, *each)
            tiles[j[:, None, None] + steps[:, None], k[:, None, None] + steps] = values
        slab = slab.reshape(THICK, THICK * sides[1], THICK * sides[2], *each)
        layers = slice(max(low[0] - start, 0), low[0] + shape[0] - start)
        j, k = (slice(low[n] - first[n], low[n] - first[n] + shape[n]) for n in (1, 2))
        progress(min((start + THICK - low[0]) / shape[0], 1.0))
        yield slab[layers, j, k]
