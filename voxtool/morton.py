"""Morton codes ([voCCeL], eq. 2.2): the interleaved bits of a cell's coordinates, x lowest."""

from __future__ import annotations

import numpy as np

AXIS = np.uint64(0x1249249249249249)  # the bits of x
AT_ONCE = 1 << 15  # codes that are decoded at once, in memory that fits caches


def spread_bits(values: np.ndarray) -> np.ndarray:
    """Return (N,) integers below 2**21 as uint64, with bit i moved to bit 3i."""
    v = np.asarray(values, np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        v = (v | (v << np.uint64(shift))) & np.uint64(mask)
    return v


def gather_bits(codes: np.ndarray) -> np.ndarray:
    """Return the inverse of spread_bits: (N,) uint64, with bit 3i moved to bit i."""
    v = np.asarray(codes, np.uint64) & AXIS
    for shift, mask in (
        (2, 0x10C30C30C30C30C3),
        (4, 0x100F00F00F00F00F),
        (8, 0x1F0000FF0000FF),
        (16, 0x1F00000000FFFF),
        (32, 0x1FFFFF),
    ):
        v |= v >> np.uint64(shift)
        v &= np.uint64(mask)
    return v


def distinct(codes: np.ndarray) -> np.ndarray:
    """Return the distinct ones of (N,) whole numbers, ascending.

    np.unique hashes them first, which takes 50 times as long where most of them differ.
    """
    ascending = np.sort(codes)
    return ascending[np.diff(ascending, prepend=~ascending[:1]) != 0]


def among(ascending: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return which of (n,) whole numbers are among (m,) ascending ones of their type, (n,) bool."""
    if not len(ascending):
        return np.zeros(len(values), bool)
    places = np.searchsorted(ascending, values)
    return ascending[np.minimum(places, len(ascending) - 1)] == values


def morton_step(
    codes: np.ndarray, axis: int, step: int, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Morton codes of the cells a step away along an axis in a cube of `side` cells, a
    power of two, (n,) uint64, and which of them lie in the cube, (n,) bool.

    The bits of the other axes are set before an addition, so that it carries across them.
    """
    mask = spread_bits(np.array(side - 1)) << np.uint64(axis)
    by = spread_bits(np.array(abs(step))) << np.uint64(axis)
    own, others = codes & mask, codes & ~mask
    moved = (((own | ~mask) + by) if step >= 0 else own - by) & mask
    within = (moved >= own if step >= 0 else moved <= own) & (abs(step) < side)
    return moved | others, within


def morton_encode(points: np.ndarray) -> np.ndarray:
    """Return the (N,) uint64 Morton codes of (N, 3) cells."""
    x, y, z = (spread_bits(points[:, a]) << np.uint64(a) for a in range(3))
    return x | y | z


def morton_box(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest coordinates of the cells of (N,) Morton codes, at least
    one, (3,) int64 each. The spread bits of an axis have the order of its coordinates, so that only
    six are gathered."""
    ends = []
    for axis in range(3):
        own = codes & (AXIS << np.uint64(axis))
        ends.append(np.array([own.min(), own.max()]) >> np.uint64(axis))
    low, high = gather_bits(np.array(ends)).astype(np.int64).T
    return low, high


def morton_decode(codes: np.ndarray) -> np.ndarray:
    """Return the (N, 3) int64 cells of (N,) Morton codes."""
    codes = np.asarray(codes, np.uint64)
    cells = np.empty((len(codes), 3), np.int64)
    for begin in range(0, len(codes), AT_ONCE):
        some = codes[begin : begin + AT_ONCE]
        for axis in range(3):
            cells[begin : begin + AT_ONCE, axis] = gather_bits(some >> np.uint64(axis))
    return cells
