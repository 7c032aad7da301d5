"""Distances to triangles by plain oracles: the minimum over vertices, edges and planes."""

from __future__ import annotations

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.selftest.oracles import distances as exact

__all__ = ["around", "brute", "exact"]


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


def around(mesh: Mesh, rng: np.random.Generator, n: int, spread: float = 0.1) -> np.ndarray:
    """n points on faces, edges and vertices, and as many around them."""
    corners = mesh.vertices[mesh.faces[rng.integers(0, len(mesh.faces), n)]]
    weights = rng.uniform(size=(n, 3)) * rng.integers(0, 2, (n, 3))
    weights[weights.sum(axis=1) == 0, 0] = 1
    weights /= weights.sum(axis=1, keepdims=True)
    on = (weights[:, :, None] * corners).sum(axis=1)
    size = np.ptp(mesh.bounds, axis=0).max()
    return np.concatenate([on, on + spread * size * rng.normal(size=(n, 3))])
