"""Products and lengths of 3-vectors, the same bit for bit on every machine.

Each is written out as sums and products in a fixed order: a BLAS may add in another order, and may
fuse a product with a sum.
"""

from __future__ import annotations

import numpy as np


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
