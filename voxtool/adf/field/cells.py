"""Cells of an octree: keys and identifiers [ADF, sections 3.3 and 3.4], and codes of error bounds.

Levels are counted from the root, which has level 0. (Octrees of voxels count the other way, from
their finest level.) The error bound of a leaf is a byte on a logarithmic scale: no leaf, no bound
(the leaf has a sign discontinuity, or its error may exceed a side), or 2**((code - 254) / 8) sides.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from voxtool.arrays import read_only
from voxtool.errors import VoxtoolError
from voxtool.morton import morton_decode, morton_encode

MAX_LEVEL = 20  # of a cell with children: the three coordinates of its key fit 63 bits
MAX_LEVEL_32 = 10  # of cells whose identifiers fit 32 bits
MAX_KEY = (2 << MAX_LEVEL) - 1  # along an axis
NO_LEAF, JUMP = 0, 255
BOUND_STEPS = 8  # codes for a factor of two: rounding up adds at most 9.1 %


def key_of(level: int | np.ndarray, ijk: np.ndarray) -> np.ndarray:
    """Return the keys of (n, 3) cells of one or (n,) levels: 2**level + ijk, (n, 3) int64."""
    ijk = np.asarray(ijk, np.int64)
    return ijk + (1 << np.broadcast_to(np.asarray(level, np.int64), len(ijk)))[:, None]


def identifier_type(level: int) -> np.dtype:
    """Return the type of the identifiers of an octree with stored cells down to a level."""
    return np.dtype(np.uint32 if level <= MAX_LEVEL_32 else np.uint64)


def cell_identifier(level: int, ijk: np.ndarray) -> np.ndarray:
    """Return the (n,) identifiers of (n, 3) cells of a level: Morton codes after a leading one, of
    3 level + 1 bits; uint32 up to level 10, otherwise uint64. No identifier is 0."""
    ijk = np.asarray(ijk)
    if not 0 <= level <= MAX_LEVEL:
        raise VoxtoolError(f"no cell has level {level}: levels are 0 to {MAX_LEVEL}")
    wrong = np.flatnonzero(((ijk < 0) | (ijk >> level > 0)).any(axis=1))
    if len(wrong):
        raise VoxtoolError(f"level {level} has no cell {shown(ijk[wrong[0]])}")
    codes = morton_encode(ijk) | np.uint64(1 << 3 * level)
    return codes.astype(identifier_type(level))


def identifiers_in(cells: np.ndarray) -> np.ndarray:
    """Return the identifier in each slot of (..., 2 or 3) uint32 texels: uint32, or uint64 where it
    has a high word; 0 where the slot is free."""
    if cells.shape[-1] == 2:
        return np.ascontiguousarray(cells[..., 0])
    low, high = cells[..., 0].astype(np.uint64), cells[..., 1].astype(np.uint64)
    return high << np.uint64(32) | low


def cell_of(identifiers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n,) int64 levels and (n, 3) int64 cells of (n,) identifiers other than 0."""
    codes = np.asarray(identifiers, np.uint64)
    leading = np.uint64(1) << np.arange(0, 3 * MAX_LEVEL + 1, 3, dtype=np.uint64)
    levels = np.searchsorted(leading, codes, side="right") - 1
    return levels, morton_decode(codes ^ leading[levels])


def shown(key: np.ndarray) -> str:
    """Return a key or cell as text for messages."""
    return f"({', '.join(map(str, key.tolist()))})"


@functools.cache
def bound_values() -> np.ndarray:
    """Return the bound of each code, (256,) float64, in sides: 0 for NO_LEAF, infinity for JUMP,
    and otherwise 2**((code - 254) / 8), computed with square roots only."""
    eighth = math.sqrt(math.sqrt(math.sqrt(2.0)))
    steps = [1.0]
    for _ in range(BOUND_STEPS - 1):
        steps.append(steps[-1] * eighth)
    values = np.zeros(256)
    for code in range(1, JUMP):
        exponent, step = divmod(code - (JUMP - 1), BOUND_STEPS)
        values[code] = math.ldexp(steps[step], exponent)
    values[JUMP] = np.inf
    return read_only(values)


def half_diagonals(levels: np.ndarray) -> np.ndarray:
    """Return half of the diagonal of a cell of each level, (N,) float64, in sides."""
    return np.ldexp(math.sqrt(3) / 2, -levels)
