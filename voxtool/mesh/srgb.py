"""sRGB and linear light, by tables of whole numbers: no power function, whose rounding differs.

A channel c of sRGB from 0 to 1 is c / 12.92 in linear light up to 0.04045, and else
((c + 0.055) / 1.055)^2.4 (IEC 61966-2-1).
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np

BITS = 24
ONE = 1 << BITS  # linear light of 1
LEVELS = 255  # of a channel of 8 bits


def _linear(channel: Fraction) -> int:
    """Return the linear light of a channel of sRGB, in 1/ONE, rounded down; exact."""
    if channel <= Fraction(4045, 100000):
        return int(channel / Fraction(1292, 100) * ONE)
    power = ((channel + Fraction(55, 1000)) / Fraction(1055, 1000)) ** 12  # x^2.4 = (x^12)^(1/5)
    scaled, low, high = power * ONE**5, 0, ONE + 1
    while high - low > 1:  # the greatest number whose fifth power is not above
        middle = (low + high) // 2
        low, high = (middle, high) if middle**5 <= scaled else (low, middle)
    return low


@cache
def linear_table() -> np.ndarray:
    """Return the linear light of each level of a channel of 8 bits, (256,) int64 in 1/ONE."""
    return np.array([_linear(Fraction(level, LEVELS)) for level in range(LEVELS + 1)], np.int64)


@cache
def level_bounds() -> np.ndarray:
    """Return the least linear light that each level but 0 stands for, (255,) int64 in 1/ONE: half
    way between two levels of sRGB."""
    halves = [_linear(Fraction(2 * level - 1, 2 * LEVELS)) for level in range(1, LEVELS + 1)]
    return np.array(halves, np.int64)


def to_linear(channels: np.ndarray) -> np.ndarray:
    """Return the linear light, float64, of channels of sRGB: uint8, or numbers from 0 to 1, which
    are interpolated between the levels of 8 bits."""
    table = linear_table() / ONE
    if channels.dtype == np.uint8:
        return table[channels]
    return np.interp(channels * LEVELS, np.arange(LEVELS + 1), table)


def to_levels(linear: np.ndarray) -> np.ndarray:
    """Return the nearest levels, uint8, of linear light in 1/ONE, int64."""
    return np.searchsorted(level_bounds(), linear, side="right").astype(np.uint8)
