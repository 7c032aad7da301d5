"""Distances to triangles by plain oracles: the minimum over vertices, edges and planes."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np


def exact(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) distances in rational arithmetic, rounded once.

    points : (N, 3); triangles : (F, 3, 3); both taken as the numbers that they are.
    """
    corners = [[_rational(c) for c in triangle] for triangle in triangles]
    return np.array([_root(min(_squared(_rational(p), *t) for t in corners)) for p in points])


def brute(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) distances in numpy's long double; triangles without area must be thin beyond doubt."""
    p = np.asarray(points, np.longdouble)[:, None]
    a, b, c = np.moveaxis(np.asarray(triangles, np.longdouble), 1, 0)
    least = np.full((len(points), len(triangles)), np.inf, np.longdouble)
    normal = np.cross(b - a, c - a)
    nn = (normal * normal).sum(-1)
    inside = np.broadcast_to(nn > 0, least.shape)
    for u, v in ((a, b), (b, c), (c, a)):
        e, w = v - u, p - u
        ee = (e * e).sum(-1)
        t = np.clip((w * e).sum(-1) / np.where(ee > 0, ee, 1), 0, 1)[..., None]
        least = np.minimum(least, ((w - t * e) ** 2).sum(-1))
        inside = inside & ((np.cross(e, w) * normal).sum(-1) >= 0)
    plane = ((p - a) * normal).sum(-1) ** 2 / np.where(nn > 0, nn, 1)
    least = np.where(inside, np.minimum(least, plane), least)
    return np.sqrt(least.min(axis=1)).astype(np.float64)


def _rational(point: np.ndarray) -> list[Fraction]:
    return [Fraction(float(x)) for x in point]


def _dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def _minus(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    return [x - y for x, y in zip(a, b, strict=True)]


def _to_segment(p: list[Fraction], a: list[Fraction], b: list[Fraction]) -> Fraction:
    e, w = _minus(b, a), _minus(p, a)
    ee = _dot(e, e)
    t = min(max(_dot(w, e) / ee, Fraction(0)), Fraction(1)) if ee else Fraction(0)
    r = [wi - t * ei for wi, ei in zip(w, e, strict=True)]
    return _dot(r, r)


def _squared(p: list[Fraction], *corners: list[Fraction]) -> Fraction:
    a, b, c = corners
    least = min(_to_segment(p, a, b), _to_segment(p, b, c), _to_segment(p, c, a))
    e, f, w = _minus(b, a), _minus(c, a), _minus(p, a)
    ee, ef, ff, we, wf = _dot(e, e), _dot(e, f), _dot(f, f), _dot(w, e), _dot(w, f)
    area = ee * ff - ef * ef
    if area:
        u, v = (we * ff - wf * ef) / area, (wf * ee - we * ef) / area
        if u >= 0 and v >= 0 and u + v <= 1:
            r = [wi - u * ei - v * fi for wi, ei, fi in zip(w, e, f, strict=True)]
            least = min(least, _dot(r, r))
    return least


def _root(square: Fraction) -> float:
    scale = 1 << 1200
    scaled = math.isqrt(square.numerator * square.denominator * scale * scale)
    return float(Fraction(scaled, square.denominator * scale))
