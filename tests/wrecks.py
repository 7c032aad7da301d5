"""Models made bad on purpose: closed shapes, and what is done to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from helpers import meshes

Mesh = tuple[np.ndarray, np.ndarray]
Fault = Callable[[np.random.Generator, np.ndarray, np.ndarray], Mesh]

# Closed shapes by name, with their shells and genus.
SHAPES: dict[str, tuple[Mesh, int, int]] = {
    "sphere": (meshes.icosphere(3), 1, 0),
    "torus": (meshes.torus(major=1.0, minor=0.4), 1, 1),
    "box": (meshes.box((-1.0, -0.7, -0.5), (1.0, 0.7, 0.5)), 1, 0),
    "two": (meshes.join(meshes.icosphere(2), meshes.icosphere(2, (3.0, 0.3, 0.2), 0.7)), 2, 0),
}


def some(rng: np.random.Generator, count: int, share: float) -> np.ndarray:
    """A random choice of a share of the faces, one at least."""
    return rng.permutation(count)[: max(int(share * count), 1)]


def holes(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Random faces removed."""
    return v, np.delete(f, some(rng, len(f), 0.03), axis=0)


def flipped(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Random faces wound the other way."""
    f = f.copy()
    chosen = some(rng, len(f), 0.2)
    f[chosen] = f[chosen][:, ::-1]
    return v, f


def doubled(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Random faces repeated, half of them wound the other way."""
    again = f[some(rng, len(f), 0.3)]
    again[::2] = again[::2, ::-1]
    return v, np.concatenate([f, again])


def overlapped(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """A second copy, moved a little."""
    return meshes.join((v, f), (v + rng.uniform(0.02, 0.06, 3), f))


def noisy(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Vertices moved at random, so that faces pass through each other."""
    return v + rng.normal(0, 0.01, v.shape), f


def apart(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Each face a part of its own, moved a little: cracks everywhere."""
    soup = v[f] + rng.normal(0, 0.003, (len(f), 1, 3))
    return soup.reshape(-1, 3), np.arange(3 * len(f)).reshape(-1, 3)


def sheets(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Fins without thickness, which begin inside the shape."""
    low, high = v.min(axis=0), v.max(axis=0)
    fins = low + (high - low) * rng.uniform(0.3, 0.7, (2, 3, 3))
    return meshes.join((v, f), (fins.reshape(-1, 3), np.arange(6).reshape(2, 3)))


def t_junctions(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Faces cut in two, and not their neighbours: vertices end within the edges of others."""
    chosen = some(rng, len(f), 0.2)
    a, b, c = f[chosen].T
    middle = len(v) + np.arange(len(chosen))
    halves = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    kept = np.delete(f, chosen, axis=0)
    return np.concatenate([v, (v[a] + v[b]) / 2]), np.concatenate([kept, halves])


def unwelded(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """No two faces share a vertex, and the faces are in random order."""
    f = rng.permutation(f)
    return v[f].reshape(-1, 3), np.arange(f.size).reshape(-1, 3)


def degenerate(rng: np.random.Generator, v: np.ndarray, f: np.ndarray) -> Mesh:
    """Faces that are segments and points."""
    more = f[some(rng, len(f), 0.2)]
    more[:, 2] = more[:, 1]
    more[::3] = more[::3, :1]
    return v, np.concatenate([f, more])


FAULTS: dict[str, Fault] = {
    fault.__name__: fault
    for fault in (
        holes, flipped, doubled, overlapped, noisy, apart, sheets, t_junctions, unwelded,
        degenerate,
    )
}  # fmt: skip


def wreck(fault: str, shape: str, seed: int = 0) -> Mesh:
    """A shape with a fault."""
    vertices, faces = SHAPES[shape][0]
    return FAULTS[fault](np.random.default_rng([seed, len(fault), len(shape)]), vertices, faces)


# ---- models of open parts


def sheet(corner: Sequence, u: Sequence, v: Sequence, n: int = 4) -> Mesh:
    """A parallelogram of n by n cells."""
    i, j = (a.ravel()[:, None] / n for a in np.indices((n + 1, n + 1)))
    k = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    one, other = np.stack([k, k + n + 1, k + n + 2], 1), np.stack([k, k + n + 2, k + 1], 1)
    return np.asarray(corner) + i * np.array(u) + j * np.array(v), np.concatenate([one, other])


def wheel(centre: Sequence, n: int = 24) -> Mesh:
    """A cylinder about the y axis without its ends."""
    turn = 2 * np.pi * np.arange(n) / n
    rim = np.asarray(centre) + np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.stack([i, j, j + n], 1), np.stack([i, j + n, i + n], 1)])
    return np.concatenate([rim, rim + np.array((0, 0.5, 0))]), sides


def car() -> Mesh:
    """Boxes without a face, a sheet, and wheels."""
    body = meshes.open_box((0, 0, 1), (12, 5, 3), 4)
    cabin = meshes.open_box((3, 1, 3), (9, 4, 5), 4)
    hood = sheet((0.0, 0.0, 3.3), (3, 0, 0.3), (0, 5, 0))
    wheels = [wheel((x, y, 1.0)) for x in (2.5, 9.5) for y in (-0.5, 5.0)]
    return meshes.join(body, cabin, hood, *wheels)
