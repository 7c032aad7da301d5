"""Products and lengths of 3-vectors, the same bit for bit on every machine.

Each is written out as sums and products in a fixed order: a BLAS may add in another order, and may
fuse a product with a sum. Numbers of twice the precision are sums of two float64.
"""

from __future__ import annotations

import numpy as np

SPLIT = 134217729.0  # 2**27 + 1: halves the digits of a float64 [Dekker 1971]
Twofold = tuple[np.ndarray, np.ndarray]  # a number as the sum of a float64 and a much smaller one


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the (...) dot products of (..., 3) vectors."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the (..., 3) cross products of (..., 3) vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def length(v: np.ndarray) -> np.ndarray:
    """Return the (...) Euclidean lengths of (..., 3) vectors."""
    return np.sqrt(dot(v, v))


def unit(v: np.ndarray) -> np.ndarray:
    """Return the (..., 3) directions of (..., 3) vectors of any finite size but 0.

    Vectors are divided by their largest component first, so that no square overflows.
    """
    scaled = v / np.abs(v).max(axis=-1, keepdims=True)
    return scaled / length(scaled)[..., None]


def triple(v: np.ndarray) -> tuple[float, float, float]:
    """Return a (3,) vector as three Python floats."""
    x, y, z = v.tolist()
    return x, y, z


# --- twice the precision -------------------------------------------------------------------------


def difference(a: np.ndarray, b: np.ndarray) -> Twofold:
    """Return a - b exactly [Knuth 1998]."""
    high = a - b
    part = high - a
    return high, (a - (high - part)) - (b + part)


def product(a: np.ndarray, b: np.ndarray) -> Twofold:
    """Return a b exactly, unless its last digits underflow [Dekker 1971]."""
    high = a * b
    a_high, b_high = SPLIT * a, SPLIT * b
    a_high, b_high = a_high - (a_high - a), b_high - (b_high - b)
    a_low, b_low = a - a_high, b - b_high
    return high, a_low * b_low - (((high - a_high * b_high) - a_low * b_high) - a_high * b_low)


def cross_component(u: Twofold, v: Twofold, i: int, j: int) -> Twofold:
    """Return u_i v_j - u_j v_i, to about 2^-100 of the products."""
    (uh, ul), (vh, vl) = u, v
    one, other = product(uh[i], vh[j]), product(uh[j], vh[i])
    high, low = difference(one[0], other[0])
    low = low + ((one[1] - other[1]) + ((uh[i] * vl[j] + ul[i] * vh[j])
                                        - (uh[j] * vl[i] + ul[j] * vh[i])))  # fmt: skip
    return high, low


def triple_product(u: Twofold, v: Twofold, w: Twofold) -> np.ndarray:
    """Return u . (v x w) of (3, ...) vectors, to about 2^-100 of its terms."""
    total = low = np.zeros_like(u[0][0])
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        other, rest = cross_component(v, w, j, k)
        high, part = product(u[0][i], other)
        low = low + (part + (u[0][i] * rest + u[1][i] * other))
        total, lost = difference(total, -high)
        low = low + lost
    return total + low
