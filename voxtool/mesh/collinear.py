"""Triangles without area, exactly."""

from __future__ import annotations

import numpy as np

from voxtool.vector import cross_component, difference, product

PLANES = ((0, 1), (1, 2), (2, 0))  # a triangle has no area if its projection on each has none
TINY = 2.0**-900  # products above it have no digits that underflow


def collinear(triangles: np.ndarray) -> np.ndarray:
    """Return which (F, 3, 3) triangles have zero area, (F,) bool, exactly: by float64 with an error
    bound, then by twice the precision, and by integers if neither decides."""
    with np.errstate(over="ignore", invalid="ignore"):
        p, q = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
        sure = np.zeros(len(triangles), bool)
        for i, j in PLANES:
            left, right = p[:, i] * q[:, j], p[:, j] * q[:, i]
            sure |= np.abs(left - right) > 2**-50 * (np.abs(left) + np.abs(right)) + 2.0**-1000
        flat = ~sure
        left = np.flatnonzero(flat)
        flat[left], known = _collinear_twofold(triangles[left])
    for face in left[~known]:
        ratios = [v.as_integer_ratio() for v in triangles[face].ravel().tolist()]
        unit = max(below for _, below in ratios)  # a power of two
        x = [above * (unit // below) for above, below in ratios]
        p, q = ([x[k + i] - x[i] for i in range(3)] for k in (3, 6))
        flat[face] = all(p[i] * q[j] == p[j] * q[i] for i, j in PLANES)
    return flat


def _collinear_twofold(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which (n, 3, 3) triangles have zero area, and for which that is known, (n,) bool each.

    Products are known exactly where they are 0 or above 2^-900. A triangle has no area if its edges
    are exact differences, whose products are equal; it has one if they differ by more than an error
    bound.
    """
    a, b, c = triangles.transpose(1, 2, 0)
    p, q = difference(b, a), difference(c, a)
    exact = ((p[1] == 0) & (q[1] == 0)).all(axis=0)
    flat = np.ones(len(triangles), bool)
    apart = ~flat
    for i, j in PLANES:
        left, right = product(p[0][i], q[0][j]), product(p[0][j], q[0][i])
        size = np.abs(left[0]) + np.abs(right[0])
        normal = ((np.abs(left[0]) > TINY) | (p[0][i] == 0) | (q[0][j] == 0)) & (
            (np.abs(right[0]) > TINY) | (p[0][j] == 0) | (q[0][i] == 0)
        )
        exact &= normal & (size < np.inf)
        flat &= (left[0] == right[0]) & (left[1] == right[1])
        between = np.abs(sum(cross_component(p, q, i, j)))
        apart |= normal & (between > 2.0**-90 * size) & (size < np.inf)
    return flat & exact & ~apart, exact | apart
