"""Bounds of the errors of leaves: a byte each, on a logarithmic scale.

A code means no leaf, no bound (the leaf has a sign discontinuity, or its error may exceed a side),
or 2**((code - 254) / 8) sides.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from voxtool.arrays import read_only

NO_LEAF, JUMP = 0, 255
BOUND_STEPS = 8  # codes for a factor of two: rounding up adds at most 9.1 %


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


def bound_codes(bounds: np.ndarray) -> np.ndarray:
    """Return the code of each bound in sides: the least that is not below it; JUMP above 1."""
    return np.clip(np.searchsorted(bound_values()[:JUMP], bounds), 1, JUMP).astype(np.uint8)


def half_diagonals(levels: np.ndarray) -> np.ndarray:
    """Return half of the diagonal of a cell of each level, (N,) float64, in sides."""
    return np.ldexp(math.sqrt(3) / 2, -levels)
