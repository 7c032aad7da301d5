"""Random stiff volumes: boxes of layers, whose pictures are known in rational arithmetic.

The scalar depends on z alone and is linear between planes across z, however the planes across x and
y cut the box into tetrahedra. So a ray is cut at planes and at control points by fractions, and its
pieces are integrated in float64; no cell is looked at. Planes are multiples of 1/64 beside those of
thin layers, and scalars of planes multiples of 1/64, so that their rounding to float32 is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from voxtool.camera import Camera
from voxtool.choices import METHODS
from voxtool.pictures.rendering import render
from voxtool.selftest import reference, shapes
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.camera import Rays
    from voxtool.opencl import Device

SIZE = 7, 5  # pixels of a picture
GRID = 64
NEAREST = 0.02  # of a component of a ray's direction: others run along planes


Piece = tuple[float, np.ndarray, np.ndarray]  # length, and colour and extinction at its ends


@dataclass(frozen=True, eq=False)
class StiffScene:
    """A box of layers: its planes across each axis, the scalar of each plane across z, and a view
    of it."""

    planes: tuple[np.ndarray, np.ndarray, np.ndarray]
    scalars: np.ndarray
    transfer: TransferFunction
    rays: Rays

    def mesh(self) -> UnstructuredMesh:
        """Return the box as tetrahedra, six between planes that follow each other."""
        points, cells = shapes.tetrahedra(*self.planes)
        scalars = self.scalars[np.searchsorted(self.planes[2], points[:, 2])]
        return UnstructuredMesh(points, [("tetra", cells)], scalars, "s")

    def picture(self) -> np.ndarray:
        """Return the picture, (H, W, 4) float64, premultiplied; NaN where a ray is within NEAREST
        of a plane's directions, or enters or leaves the box within a thin layer."""
        rays, (width, height) = self.rays, self.rays.size
        found, lit, pieces = np.zeros((height, width, 4)), [], []
        for row, column in np.ndindex(height, width):
            aside = (column + 0.5 - width / 2) * rays.right + (row + 0.5 - height / 2) * rays.down
            way = rays.direction + aside if rays.perspective else rays.direction
            origin = rays.origin if rays.perspective else rays.origin + aside
            if np.abs(way).min() < NEAREST:
                found[row, column] = np.nan
                continue
            own = self.pieces(origin, way)
            if own is None:
                found[row, column] = np.nan
            elif own:
                lit.append((row, column))
                pieces.append(own)
        for (row, column), light in zip(lit, composited(pieces), strict=True):
            found[row, column] = light
        return found

    def pieces(self, origin: np.ndarray, way: np.ndarray) -> list[Piece] | None:
        """Return the pieces of a ray, in the order of depth; None if the first or the last is in a
        thin layer, as rounding the planes to float32 shows at its end."""
        start, step = ([Fraction(v) for v in vector.tolist()] for vector in (origin, way))
        begin, end = Fraction(0) if self.rays.perspective else None, None
        for o, d, planes in zip(start, step, self.planes, strict=True):
            ends = sorted((Fraction(float(planes[i])) - o) / d for i in (0, -1))
            begin = ends[0] if begin is None else max(begin, ends[0])
            end = ends[1] if end is None else min(end, ends[1])
        if begin is None or end is None or begin >= end:
            return []
        levels = [Fraction(v) for v in self.planes[2].tolist()]
        crossed = [(z - start[2]) / step[2] for z in levels]
        times = [begin, *sorted(t for t in crossed if begin < t < end), end]
        for a, b in (times[:2], times[-2:]):
            layer = self._layer(levels, start[2] + (a + b) / 2 * step[2])
            if levels[layer + 1] - levels[layer] < Fraction(1, GRID):
                return None
        speed = Fraction(float(np.sqrt((way * way).sum())))
        return [
            (float(length * speed), front, back)
            for span in pairwise(times)
            for length, front, back in self._pieces(levels, start, step, *span)
        ]

    def _pieces(self, levels: list[Fraction], start: list, step: list, a: Fraction, b: Fraction):
        """Return what lies between control points on a ray from a to b, within one layer: length,
        and colour and extinction at both ends."""
        layer = self._layer(levels, start[2] + (a + b) / 2 * step[2])
        low, high = (Fraction(float(s)) for s in self.scalars[layer : layer + 2])
        slope = (high - low) / (levels[layer + 1] - levels[layer])
        ends = [low + slope * (start[2] + t * step[2] - levels[layer]) for t in (a, b)]
        points = [Fraction(float(s)) for s in self.transfer.scalars]
        inner = sorted(
            (p for p in set(points) if min(ends) < p < max(ends)), reverse=ends[0] > ends[1]
        )
        found = []
        for s, t in pairwise([ends[0], *inner, ends[1]]):
            whole = ends[1] - ends[0]
            length = (b - a) * (abs(t - s) / abs(whole) if whole else 1)
            found.append((length, *self._values(points, s, t)))
        return found

    @staticmethod
    def _layer(levels: list[Fraction], z: Fraction) -> int:
        return sum(level <= z for level in levels) - 1

    def _values(self, points: list[Fraction], s: Fraction, t: Fraction) -> list[np.ndarray]:
        """Return colour and extinction at s and t, of the interval between control points that
        holds both."""
        nodes = np.column_stack([self.transfer.colours, self.transfer.extinctions])
        interval = sum(p <= min(s, t) for p in points)
        before, after = max(interval - 1, 0), min(interval, len(points) - 1)
        width = points[after] - points[before]
        shares = [float((v - points[before]) / width) if width else 0.0 for v in (s, t)]
        return [nodes[before] + min(max(w, 0), 1) * (nodes[after] - nodes[before]) for w in shares]


def composited(rays: list[list[Piece]]) -> np.ndarray:
    """Return the premultiplied RGBA of rays of pieces, (n, 4) float64, each front to back."""
    lengths = np.array([length for ray in rays for length, _, _ in ray])
    front, back = (np.array([piece[i] for ray in rays for piece in ray]) for i in (1, 2))
    if not rays:
        return np.zeros((0, 4))
    a, b = front[:, 3] * lengths, back[:, 3] * lengths
    near, far = reference.weights(a, b)
    light = near[:, None] * front[:, :3] + far[:, None] * back[:, :3]
    found, at = np.empty((len(rays), 4)), 0
    for i, ray in enumerate(rays):
        own, at = slice(at, at + len(ray)), at + len(ray)
        depth = np.cumsum((a[own] + b[own]) / 2)
        through = np.exp(-np.concatenate([[0.0], depth[:-1]]))
        found[i, :3] = (through[:, None] * light[own]).sum(axis=0)
        found[i, 3] = -math.expm1(-float(depth[-1]))
    return found


# --- scenes --------------------------------------------------------------------------------------


def thick(random: np.random.Generator, most: int = 3) -> np.ndarray:
    """Return planes from 0 to 1 at multiples of 1 / GRID."""
    inner = random.choice(np.arange(4, GRID - 4), int(random.integers(0, most + 1)), replace=False)
    return np.concatenate([[0.0], np.sort(inner) / GRID, [1.0]])


def view(random: np.random.Generator, eye: np.ndarray | None = None) -> Rays:
    """Return rays into the box, from far away or from an eye."""
    way = random.choice([-1.0, 1.0], 3) * random.uniform(0.2, 1, 3)
    target = random.uniform(0.3, 0.7, 3)
    fov = float(random.choice([4.0, 30.0]))
    if eye is None:
        eye = target - random.uniform(3, 6) * way
        fov = None if random.random() < 0.5 else fov
    else:
        target, fov = eye + way, 60.0
    up = tuple(random.normal(size=3))
    return Camera(tuple(eye), tuple(target), up, fov, 0.3).rays(*SIZE)


def colours(random: np.random.Generator, count: int) -> np.ndarray:
    return random.random((count, 3))


def layers(random: np.random.Generator) -> StiffScene:
    """Return one to three layers, 1e-12 to 1e-2 thick, of an optical depth of 1 or so each."""
    z, count = thick(random, 0), int(random.integers(1, 4))
    at = np.sort(random.choice(np.arange(4, GRID - 4), count, replace=False)) / GRID
    thin = 10.0 ** random.uniform(-12, -2)
    z = np.sort(np.concatenate([z, at, at + thin]))
    scalars = np.zeros(len(z))
    scalars[1:-1:2] = 0.0
    step = np.cumsum(np.ones(count)) / count
    scalars[2:-1:2] = step
    scalars[3:-1:2] = step[:-1]
    scalars[-1] = 1.0
    # each layer has its range of scalars, between which the transfer function is transparent
    points, extinctions = [], []
    for i in range(count):
        low, high = i / count, (i + 1) / count
        points += [low + (high - low) * w for w in (0.25, 0.5, 0.75)]
        extinctions += [0.0, float(random.uniform(1, 4)) / thin, 0.0]
    transfer = TransferFunction(np.array(points), colours(random, 3 * count), np.array(extinctions))
    return StiffScene((thick(random), thick(random), z), scalars, transfer, view(random))


def spikes(random: np.random.Generator) -> StiffScene:
    """Return one to three spikes of a transfer function, 1e-15 to 1e-2 of the range wide."""
    z = thick(random, 2)
    scalars = np.linspace(0, 1, len(z)) if random.random() < 0.5 else np.linspace(1, 0, len(z))
    scalars = np.rint(scalars * GRID) / GRID
    points, extinctions = [], []
    for at in np.sort(random.choice(np.arange(4, GRID - 4, 4), int(random.integers(1, 4)), False)):
        wide, base = 10.0 ** random.uniform(-15, -2), (at + 0.5) / GRID
        points += [base, base + wide, base + 2 * wide]
        extinctions += [0.0, float(random.uniform(0.2, 2)) / wide, 0.0]
    transfer = TransferFunction(
        np.array(points), colours(random, len(points)), np.array(extinctions)
    )
    return StiffScene((thick(random), thick(random), z), scalars, transfer, view(random))


def extreme(random: np.random.Generator) -> StiffScene:
    """Return extinctions of 1e2 to 1e13."""
    z = thick(random, 2)
    scalars = np.rint(np.linspace(0, 1, len(z)) * GRID) / GRID
    points = np.sort(random.choice(np.arange(1, GRID), 4, replace=False)) / GRID
    extinctions = 10.0 ** random.uniform(2, 13) * random.choice([0.0, 1e-6, 1e-3, 0.3, 1.0], 4)
    transfer = TransferFunction(points, colours(random, 4), extinctions)
    return StiffScene((thick(random), thick(random), z), scalars, transfer, view(random))


def eyes(random: np.random.Generator) -> StiffScene:
    """Return an eye in one, two or three planes of faces, which looks along an axis or anywhere."""
    planes = thick(random), thick(random), thick(random)
    eye = random.uniform(0.1, 0.9, 3)
    for axis in random.choice(3, int(random.integers(1, 4)), replace=False):
        eye[axis] = random.choice(planes[axis])
    rays = view(random, eye)
    if random.random() < 0.7:
        way = np.eye(3)[random.integers(3)] * random.choice([-1.0, 1.0])
        up = tuple(random.normal(size=3))
        rays = Camera(tuple(eye), tuple(eye + way), up, 60.0).rays(*SIZE)
    scalars = np.rint(np.linspace(0, 1, len(planes[2])) * GRID) / GRID
    extinctions = random.choice([1.0, 100.0]) * random.uniform(0.5, 3, 2)
    transfer = TransferFunction(np.array([0.0, 1.0]), colours(random, 2), extinctions)
    return StiffScene(planes, scalars, transfer, rays)


def needles(random: np.random.Generator) -> StiffScene:
    """Return cells 1e-7 to 1e-3 thick across two axes."""
    planes = []
    for _ in range(2):
        at = random.choice(np.arange(8, GRID - 8)) / GRID
        planes.append(np.sort([0.0, at, at + 10.0 ** random.uniform(-7, -3), 1.0]))
    z = thick(random, 2)
    scalars = np.rint(np.linspace(0, 1, len(z)) * GRID) / GRID
    extinctions = 10.0 ** random.uniform(2, 4) * random.uniform(1, 3, 3)
    transfer = TransferFunction(np.array([0.0, 0.5, 1.0]), colours(random, 3), extinctions)
    return StiffScene((*planes, z), scalars, transfer, view(random))  # pyright: ignore


KINDS: dict[str, Callable[[np.random.Generator], StiffScene]] = {
    "layers": layers, "spikes": spikes, "extreme": extreme, "eyes": eyes, "needles": needles,
}  # fmt: skip

BOUNDS = dict.fromkeys(KINDS, 1e-6) | {"eyes": 2e-5}  # of a colour; eyes: partly in float32


def scene_error(device: Device, scene: StiffScene) -> float:
    """Return the largest error of a colour by both methods."""
    volume, expected = build_tet(scene.mesh(), device=device), scene.picture()
    known = ~np.isnan(expected).any(axis=2)
    error = 0.0
    for method in METHODS:
        found = render(volume, scene.rays, transfer=scene.transfer, method=method, device=device)
        error = max(error, float(np.abs(found - expected)[known].max(initial=0)))
    return error


def error_of(device: Device, kind: str, seeds: range) -> float:
    """Return the largest error of random scenes of a kind."""
    scenes = (KINDS[kind](np.random.default_rng([seed, len(kind)])) for seed in seeds)
    return max(scene_error(device, scene) for scene in scenes)
