"""The voxels in which points lie, decided exactly.

A voxel is half-open: the planes between voxels lie at origin + i pitch, in real numbers, and a
point on a plane is in the voxel above it. A quotient in float64 tells all points but those that are
very near to a plane; the side of these follows from sums of twice the precision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.vector import difference, product

if TYPE_CHECKING:
    from voxtool.grid import Grid

NEAR = 2.0**-30  # voxels; a quotient below 2**17 is off by less than 2**-34


def in_voxels(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Return (N, 3) float64 points in voxels from the grid's corner, rounded twice."""
    with np.errstate(over="ignore"):
        return (points - np.array(grid.origin)) / np.array(grid.pitch)


def voxels_around(grid: Grid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which of (N, 3) points lie in the grid, (N,) bool, and the voxels of those, (n, 3)
    int64."""
    places, shape = in_voxels(grid, points), np.array(grid.shape)
    close = np.all((places > -1) & (places < shape + 1), axis=1)
    places, points = places[close], points[close]
    planes = np.rint(places)
    voxels = np.floor(places)
    rows, axes = np.nonzero(np.abs(places - planes) < NEAR)
    near = planes[rows, axes]
    origin, pitch = (np.array(part)[axes] for part in (grid.origin, grid.pitch))
    voxels[rows, axes] = near - _below(points[rows, axes], origin, pitch, near)
    held = np.all((voxels >= 0) & (voxels < shape), axis=1)
    within = np.zeros(len(close), bool)
    within[np.flatnonzero(close)[held]] = True
    return within, voxels[held].astype(np.int64)


def _below(
    points: np.ndarray, origin: np.ndarray, pitch: np.ndarray, planes: np.ndarray
) -> np.ndarray:
    """Return whether coordinates near planes, numbered from the origin, are less than theirs."""
    (high, low), (plane, rest) = difference(points, origin), product(planes, pitch)
    left, last = difference(low, rest)
    # high - plane is exact, as the two are close
    total, lost = difference(high - plane, -left)
    return total + (last + lost) < 0
