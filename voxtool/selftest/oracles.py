"""Slow, plain oracles of voxels and distances, in Python integers and fractions.

Triangles are three points of three integers in 1/256 voxel, in any sequence, such as an array
`vertices[faces]`. Voxel (i, j, k) is the closed cube [i, i+1] x [j, j+1] x [k, k+1] in voxels.
Nothing here is rounded, and nothing is shared with the code under test: touching is decided by
clipping, and ties by numbers with an infinitesimal part.

Such a number is the tuple (value, a, b, c), which stands for value + a ex + b ey + c ez with
1 >> ex >> ey >> ez > 0: so tuples compare as the numbers do.
"""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    Cell = tuple[int, int, int]
    Point = Sequence[int]
    Polygon = list[Point]
    Slab = tuple[int, int]

UNIT = 256  # a voxel
HALF = UNIT // 2


def surface26(triangles: Iterable, shape: Sequence[int]) -> set[Cell]:
    """Return voxels whose closed cube touches a closed triangle, if only in one point."""
    slabs = [[(UNIT * i, UNIT * (i + 1)) for i in range(n)] for n in shape]
    return {cell for t in polygons(triangles) for cell in touched(t, slabs)}


def surface6(triangles: Iterable, shape: Sequence[int]) -> set[Cell]:
    """Return the 6-separating set of [Schwarz 2010], with the centres moved by (ex, ey, ez)."""
    found = set()
    for triangle in polygons(triangles):
        layers = [_overlapped(triangle, axis, shape[axis]) for axis in range(3)]
        passed = np.ones([len(some) for some in layers], bool)
        for d, *normal in _thin_forms(*triangle):
            largest = abs(d) + sum(map(abs, normal)) * UNIT * max(shape)
            kind = np.int64 if largest < 1 << 63 else object  # beyond, Python's integers
            x, y, z = np.ix_(*(np.array([UNIT * i + HALF for i in some], kind) for some in layers))
            a, b, c = normal
            value = d + a * x + b * y + c * z
            passed &= value >= 0 if (a, b, c) >= (0, 0, 0) else value > 0
        found |= {cell for cell, is_in in zip(product(*layers), passed.flat, strict=True) if is_in}
    return found


def solid(triangles: Iterable, shape: Sequence[int]) -> set[Cell]:
    """Return voxels from whose centre, moved by (ex, ey, ez), the ray towards -x crosses an odd
    number of triangles. A triangle that is edge-on to the ray is never crossed."""
    odd: set[Cell] = set()
    for j, k, x, _ in crossings(triangles, shape):
        odd ^= {(i, j, k) for i in range(shape[0]) if x < (UNIT * i + HALF, 1, 0, 0)}
    return odd


def crossings(triangles: Iterable, shape: Sequence[int]) -> Iterator[tuple]:
    """Yield the rows (j, k) that cross a triangle, the place along x, and 1 if the triangle is seen
    from its front from -x, or -1."""
    for triangle in polygons(triangles):
        (x0, y0, z0), (ax, ay, az), (bx, by, bz) = _edges(*triangle)
        det = ay * bz - az * by
        if det == 0:
            continue
        front, whole = (1 if det > 0 else -1), [abs(det), 0, 0, 0]
        for j, k in product(*(_spanned(triangle, a, shape[a]) for a in (1, 2))):
            y, z = UNIT * j + HALF - y0, UNIT * k + HALF - z0
            # |det| (y + ey, z + ez) = s a + t b, by Cramer's rule
            s = [front * v for v in (y * bz - z * by, 0, bz, -by)]
            t = [front * v for v in (z * ay - y * az, 0, -az, ay)]
            if min(s, t) < [0] * 4 or [u + v for u, v in zip(s, t, strict=True)] > whole:
                continue
            x = [Fraction(u * ax + v * bx, abs(det)) for u, v in zip(s, t, strict=True)]
            yield j, k, (x[0] + x0, *x[1:]), -front


def to_dense(voxels: set[Cell], shape: Sequence[int]) -> np.ndarray:
    """Return a set of voxels as a bool array indexed [x, y, z]."""
    dense = np.zeros(shape, bool)
    for cell in voxels:
        dense[cell] = True
    return dense


def distances(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (N,) float64: the distances of (N, 3) points to the nearest of (F, 3, 3) triangles,
    computed exactly and rounded once."""
    n = len(points)
    places, scale = whole(np.concatenate([points, np.reshape(triangles, (-1, 3))]))
    corners = [places[i : i + 3] for i in range(n, len(places), 3)]
    return np.array(
        [_root(min(_squared(p, *t) for t in corners) / scale**2) for p in places[:n]], np.float64
    )


def whole(points: np.ndarray) -> tuple[list[list[int]], int]:
    """Return the points times the least power of two that makes all their coordinates whole, and
    it."""
    ratios = [[float(x).as_integer_ratio() for x in point] for point in points]
    scale = max((over for point in ratios for _, over in point), default=1)
    return [[x * (scale // over) for x, over in point] for point in ratios], scale


def winding_numbers(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (N,) float64: the winding numbers of (F, 3, 3) triangles about (N, 3) points: their
    solid angles over 4 pi [Oosterom 1983]."""
    angles = np.zeros(len(points))
    for triangle in triangles:
        a, b, c = triangle[:, None] - points
        x, y, z = (np.sqrt((v * v).sum(axis=1)) for v in (a, b, c))
        volume = (a * np.cross(b, c)).sum(axis=1)
        rest = x * y * z + (a * b).sum(axis=1) * z + (b * c).sum(axis=1) * x
        angles += 2 * np.arctan2(volume, rest + (c * a).sum(axis=1) * y)
    return angles / (4 * np.pi)


def polygons(triangles: Iterable) -> Iterator[Polygon]:
    """Yield the triangles as lists of points of Python integers."""
    for triangle in triangles:
        yield [tuple(int(v) for v in point) for point in triangle]


def touched(polygon: Polygon, slabs: Sequence[Sequence[Slab]]) -> Iterator[tuple]:
    """Return cells of a product of closed slabs that a convex polygon of whole numbers touches,
    which may be a segment or a point."""
    return _touched([(*point, 1) for point in polygon], slabs, 0)


def _touched(polygon: Polygon, slabs: Sequence[Sequence[Slab]], axis: int) -> Iterator[tuple]:
    """Clip a polygon to each slab of one axis, then the rest to those of the next. Its points are
    homogeneous: (x, y, z, w) with w > 0 stands for (x / w, y / w, z / w)."""
    low, high = min(p[axis] // p[3] for p in polygon), max(-(-p[axis] // p[3]) for p in polygon)
    for index, (start, end) in enumerate(slabs[axis]):
        if end < low or high < start:
            continue
        part = _clip(_clip(polygon, axis, 1, start), axis, -1, end)
        if not part:
            continue
        if axis == 2:
            yield (index,)
        else:
            for rest in _touched(part, slabs, axis + 1):
                yield (index, *rest)


def _clip(polygon: Polygon, axis: int, sign: int, bound: int) -> Polygon:
    """Sutherland and Hodgman: the part of a convex polygon with sign * (p[axis] - bound) >= 0."""
    kept = []
    sides = [sign * (p[axis] - bound * p[3]) for p in polygon]
    for i, (p, d) in enumerate(zip(polygon, sides, strict=True)):
        q, e = polygon[i - 1], sides[i - 1]
        if d * e < 0:
            kept.append(tuple(abs(e) * u + abs(d) * v for u, v in zip(p, q, strict=True)))
        if d >= 0:
            kept.append(p)
    return kept


def _edges(v0: Point, v1: Point, v2: Point) -> tuple[Point, Point, Point]:
    """Return the first vertex and the edges from it to the others."""
    return (
        v0,
        tuple(q - p for p, q in zip(v0, v1, strict=True)),
        tuple(q - p for p, q in zip(v0, v2, strict=True)),
    )


def _thin_forms(v0: Point, v1: Point, v2: Point) -> list[tuple[int, ...]]:
    """Return linear forms (d, a, b, c) such that the thin test passes at a centre where none of d +
    a x + b y + c z is negative: the plane's two sides and three edges in each projection."""
    _, a, b = _edges(v0, v1, v2)
    n = [a[u] * b[v] - a[v] * b[u] for u, v in ((1, 2), (2, 0), (0, 1))]
    across = sum(u * v for u, v in zip(n, v0, strict=True))
    reach = HALF * max(map(abs, n))
    forms = [(reach - across, *n), (reach + across, *(-u for u in n))]
    for flat, u, v in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        sign = -1 if n[flat] < 0 else 1
        for p, q in ((v0, v1), (v1, v2), (v2, v0)):
            m = [0, 0, 0]  # the inward normal of the edge
            m[u], m[v] = sign * (p[v] - q[v]), sign * (q[u] - p[u])
            reach = HALF * max(map(abs, m))
            forms.append((reach - m[u] * p[u] - m[v] * p[v], *m))
    return forms


def _overlapped(polygon: Polygon, axis: int, count: int) -> list[int]:
    """Return layers of voxels that meet the polygon's bounds when they move by an infinitesimal."""
    low, high = (f(p[axis] for p in polygon) for f in (min, max))
    moved = [(i, (UNIT * i, 1), (UNIT * (i + 1), 1)) for i in range(count)]
    return [i for i, start, end in moved if start <= (high, 0) and end >= (low, 0)]


def _spanned(polygon: Polygon, axis: int, count: int) -> list[int]:
    """Return layers of voxels whose centres lie within the polygon's bounds or on them."""
    low, high = (f(p[axis] for p in polygon) for f in (min, max))
    return [i for i in range(count) if low <= UNIT * i + HALF <= high]


def _dot(a: Point, b: Point) -> int:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _minus(a: Point, b: Point) -> list[int]:
    return [x - y for x, y in zip(a, b, strict=True)]


def _to_segment(p: Point, a: Point, b: Point) -> Fraction:
    e, w = _minus(b, a), _minus(p, a)
    ee, we = _dot(e, e), _dot(w, e)
    if 0 < we < ee:
        return Fraction(_dot(w, w) * ee - we * we, ee)
    r = w if we <= 0 else _minus(p, b)
    return Fraction(_dot(r, r))


def _squared(p: Point, a: Point, b: Point, c: Point) -> Fraction:
    """Return the square of the distance of a point from a triangle of whole numbers."""
    e, f, w = _minus(b, a), _minus(c, a), _minus(p, a)
    ee, ef, ff, we, wf = _dot(e, e), _dot(e, f), _dot(f, f), _dot(w, e), _dot(w, f)
    area = ee * ff - ef * ef  # the square of that of a parallelogram
    u, v = we * ff - wf * ef, wf * ee - we * ef
    if area and u >= 0 and v >= 0 and u + v <= area:
        return Fraction(_dot(w, w) * area - u * we - v * wf, area)
    return min(_to_segment(p, a, b), _to_segment(p, b, c), _to_segment(p, c, a))


def _root(square: Fraction) -> float:
    scale = 1 << 1200
    scaled = math.isqrt(square.numerator * square.denominator * scale * scale)
    return float(Fraction(scaled, square.denominator * scale))


def filled(triangles: Iterable, cell: Sequence[int], unit: int = UNIT) -> Fraction:
    """Return the integral of the winding number over a voxel: how much of it lies inside a closed
    mesh, whose vertices are in 1/unit voxel.

    The mesh is the signed sum of the tetrahedra between a point and its triangles. Each is clipped
    to the voxel as a set of tetrahedra."""
    total = Fraction(0)
    for triangle in polygons(triangles):
        corners = [[Fraction(v, unit) - c for v, c in zip(p, cell, strict=True)] for p in triangle]
        parts = [[[Fraction(0)] * 3, *corners]]
        volume = _six_volumes(parts[0])
        for axis, side, bound in product(range(3), (1, -1), (0, 1)):
            if (side > 0) == (bound == 0):
                parts = [own for part in parts for own in _tetrahedra(part, axis, side, bound)]
        sign = (volume > 0) - (volume < 0)
        total += sign * sum(abs(_six_volumes(part)) for part in parts)
    return total / 6


def filled_face(
    triangles: Iterable, cell: Sequence[int], axis: int, turned: bool = False, unit: int = UNIT
) -> Fraction:
    """Return the integral of the winding number over the face between a voxel and the one before it
    along an axis: the signed area of all that lies before it. A triangle in its plane counts if it
    ends the inside; `turned`: the mesh is inside out. Vertices are in 1/unit voxel."""
    total = Fraction(0)
    p, q = (axis + 1) % 3, (axis + 2) % 3
    for triangle in polygons(triangles):
        part = [[Fraction(v, unit) - c for v, c in zip(p, cell, strict=True)] for p in triangle]
        flat = all(corner[axis] == 0 for corner in part)
        for along, side, bound in ((axis, -1, 0), (p, 1, 0), (p, -1, 1), (q, 1, 0), (q, -1, 1)):
            part = _half(part, along, side, bound)
        area = Fraction(0)
        for one, other in zip(part, part[1:] + part[:1], strict=True):
            area += one[q] * other[p] - one[p] * other[q]
        if not flat or (area > 0 if turned else area < 0):
            total += area / 2
    return total


def _half(polygon: list[list[Fraction]], axis: int, side: int, bound: int) -> list[list[Fraction]]:
    """Return the part of a convex polygon with side * (coordinate - bound) >= 0."""
    found = []
    for one, other in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = (side * (corner[axis] - bound) for corner in (one, other))
        found += [one] * (a >= 0)
        if a * b < 0:
            found.append([u + a / (a - b) * (v - u) for u, v in zip(one, other, strict=True)])
    return found


def _six_volumes(tetrahedron: list[list[Fraction]]) -> Fraction:
    a, b, c = (
        [p - q for p, q in zip(corner, tetrahedron[0], strict=True)] for corner in tetrahedron[1:]
    )
    return sum(
        (a[i] * (b[j] * c[k] - b[k] * c[j]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))),
        Fraction(0),
    )


def _tetrahedra(
    corners: list[list[Fraction]], axis: int, side: int, bound: int
) -> list[list[list[Fraction]]]:
    """Return tetrahedra that fill the part of one with side * (coordinate - bound) >= 0."""
    within = [p for p in corners if side * (p[axis] - bound) >= 0]
    beyond = [p for p in corners if side * (p[axis] - bound) < 0]
    if not beyond:
        return [corners]

    def between(p: list[Fraction], q: list[Fraction]) -> list[Fraction]:
        t = (bound - p[axis]) / (q[axis] - p[axis])
        return [u + t * (v - u) for u, v in zip(p, q, strict=True)]

    if len(within) < 2:
        return [[p, *(between(p, q) for q in beyond)] for p in within]
    if len(within) == 2:  # a prism between the triangles of the two corners
        one, other = ([p, *(between(p, q) for q in beyond)] for p in within)
    else:  # a prism between the three corners and the three points below them
        one, other = within, [between(p, beyond[0]) for p in within]
    return [[*one, other[2]], [one[0], one[1], *other[1:]], [one[0], *other]]
