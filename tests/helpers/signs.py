"""Inside or outside by plain oracles: crossings in whole numbers, and solid angles in numpy."""

from __future__ import annotations

import numpy as np

from voxtool.selftest.oracles import whole

# a way to infinity that meets no edge of meshes of small whole numbers
AWAY = [10007 * 100000007, 100000007, 10007]
AT_ONCE = 1 << 12  # pairs of points and triangles that fit caches


def winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) the sum of all solid angles, by 4 pi."""
    points = np.asarray(points, np.float64)
    count = min(1 + len(points) * len(triangles) // AT_ONCE, max(len(points), 1))
    parts = np.array_split(points, count)
    return np.concatenate([_winding(part, triangles) for part in parts])


def _winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (triangles[:, i] - points[:, None] for i in range(3))
    x, y, z = (np.sqrt((v * v).sum(axis=-1)) for v in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=-1)
    rest = x * y * z + (a * b).sum(axis=-1) * z + (b * c).sum(axis=-1) * x
    angles = np.arctan2(volume, rest + (c * a).sum(axis=-1) * y)
    return np.where(volume != 0, angles, 0.0).sum(axis=-1) / (2 * np.pi)


def inside(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) bool: an odd number of triangles lies in the direction AWAY, in whole numbers."""
    n = len(points)
    places, _ = whole(np.concatenate([points, np.reshape(triangles, (-1, 3))]))
    corners = [places[i : i + 3] for i in range(n, len(places), 3)]
    return np.array([_odd(p, corners) for p in places[:n]])


def _determinant(a, b, c) -> int:
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def _odd(p, triangles) -> bool:
    crossings = 0
    for triangle in triangles:
        a, b, c = ([x - y for x, y in zip(corner, p, strict=True)] for corner in triangle)
        sides = [_determinant(AWAY, *ends) for ends in ((a, b), (b, c), (c, a))]
        if all(s > 0 for s in sides) or all(s < 0 for s in sides):
            crossings += _determinant(a, b, c) * sum(sides) > 0
        else:  # missed clearly, or by an edge that is seen as a point
            assert not any(s == 0 for s in sides) or _flat(a, b, c) or min(sides) < 0 < max(sides)
    return crossings % 2 == 1


def _flat(a, b, c) -> bool:
    u, v = ([x - y for x, y in zip(corner, a, strict=True)] for corner in (b, c))
    return all(u[i] * v[j] == u[j] * v[i] for i, j in ((0, 1), (1, 2), (2, 0)))
