"""Exact sums of numbers, which do not depend on an order or on blocks."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

FINEST = 172  # every float32 is a whole number of 2**-172: its significand as 24 bits


def whole_sum(values: np.ndarray) -> int:
    """Return the sum of up to 2**31 whole numbers, of 64 bits or fewer with a sign."""
    wide = values.astype(np.int64, copy=False)
    return (int((wide >> 32).sum()) << 32) + int((wide & 0xFFFFFFFF).sum())


def exact_sum(values: np.ndarray) -> Fraction:
    """Return the sum of finite float32 or whole numbers."""
    if values.dtype.kind != "f":
        return Fraction(whole_sum(values))
    significands, exponents = np.frexp(values)
    whole = (significands * np.float32(1 << 24)).astype(np.int64)
    total = 0
    for exponent in np.unique(exponents).tolist():
        total += int(whole[exponents == exponent].sum()) << (exponent - 24 + FINEST)
    return Fraction(total, 1 << FINEST)
