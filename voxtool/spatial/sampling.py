"""Quasi-random samples of a mesh's surface, by area, and of a cube: the same every time.

The area, summed along the faces, is cut into equal strata. The middle of each stratum names a face,
and there the sample is the next point of the low-discrepancy sequence R2 [Roberts 2018]. So a face
has its share of the samples to within one; faces without area have none. A cube is sampled by R3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MeshError, count_of
from voxtool.spatial.bvh import Frame
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.mesh.mesh import Mesh

SAMPLES_AT_ONCE = 1 << 18  # in memory
PLASTIC = 1.324717957244746  # the real root of x^3 = x + 1: the base of R2
GOLDEN_3 = 1.2207440846057596  # and of x^4 = x + 1: the base of R3


def sample_cube(count: int) -> np.ndarray:
    """Return the first points of R3 in the unit cube, (count, 3) float64."""
    i = np.arange(count, dtype=np.float64)
    steps = [1 / GOLDEN_3, 1 / (GOLDEN_3 * GOLDEN_3), 1 / (GOLDEN_3 * GOLDEN_3 * GOLDEN_3)]
    return np.stack([(0.5 + i * step) % 1.0 for step in steps], axis=1)


def sample_triangles(a: np.ndarray, b: np.ndarray, c: np.ndarray, i: np.ndarray) -> np.ndarray:
    """Return the point of R2 number i, (n,), in each triangle of corners a, b, c, (n, 3) each."""
    u, v = (0.5 + i / PLASTIC) % 1.0, (0.5 + i / (PLASTIC * PLASTIC)) % 1.0
    beyond = u + v > 1.0  # the other half of the parallelogram
    u, v = np.where(beyond, 1.0 - u, u)[:, None], np.where(beyond, 1.0 - v, v)[:, None]
    return a + u * (b - a) + v * (c - a)


class SurfaceSampler:
    """Samples of a mesh's surface, by area."""

    def __init__(self, mesh: Mesh, name: str) -> None:
        """Sum the area; raises MeshError where there is none."""
        self.mesh = mesh
        a, b, c = (Frame.of(mesh).local(mesh.vertices[mesh.faces[:, i]]) for i in range(3))
        self.area = np.cumsum(length(cross(b - a, c - a)))  # adds one by one, in order
        if not self.area[-1] > 0:
            raise MeshError(
                f"{mesh.name or name}: no area: each of its {count_of(len(mesh.faces), 'face')} is "
                "a segment or a point: give a mesh whose faces have an area"
            )

    def samples(self, count: int, block: int = SAMPLES_AT_ONCE) -> Iterator[np.ndarray]:
        """Yield `count` samples, in blocks of (n, 3) float64, at most `block` at a time."""
        last = int(np.searchsorted(self.area, self.area[-1]))  # with an area
        for start in range(0, count, block):
            i = np.arange(start, min(start + block, count), dtype=np.float64)
            along = (i + 0.5) / count * self.area[-1]
            faces = np.minimum(np.searchsorted(self.area, along, side="right"), last)
            a, b, c = (self.mesh.vertices[self.mesh.faces[faces, corner]] for corner in range(3))
            yield sample_triangles(a, b, c, i)
