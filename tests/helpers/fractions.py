"""Fractions and shares of faces as dense arrays, and in rational arithmetic, for tests."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.octree.octree import Octree


def shares_of(octree: Octree, name: str) -> np.ndarray:
    """Return "fraction" or "faces" of all voxels, (nx, ny, nz) or (nx, ny, nz, 6) float64;
    of whole numbers, as shares."""
    values = octree.attribute(name).values
    most = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
    row = values.shape[1:]
    found = np.zeros((*octree.grid.shape, *row))
    found[octree.to_dense()] = 1
    own = octree.values(name).of_bricks(slice(None)) / most
    for cell, shares in zip(octree.levels()[-1].cells, own, strict=True):
        for place, share in zip(cell + BRICK_VOXELS, shares, strict=True):
            if (place < octree.grid.shape).all():
                found[tuple(place)] = share
    return found


def share_by(fill: str, total: Fraction) -> Fraction:
    """Return the share of a voxel or of a face that is inside by a fill rule, given the integral of
    the winding number over it."""
    if fill == "parity":
        rest = total % 2
        return min(rest, 2 - rest)
    return min(max(abs(total) if fill == "nonzero" else total, Fraction(0)), Fraction(1))
