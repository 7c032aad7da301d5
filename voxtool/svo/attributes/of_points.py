"""Attributes at single voxels."""

from __future__ import annotations

import numpy as np

from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.octree.attributes import BRICKS

BRICK_BITS = np.uint64(6)  # bits of a voxel's code, within its brick


def values_of_voxels(values: CellValues, codes: np.ndarray) -> np.ndarray:
    """Return the values of voxels by their Morton codes, (n, ...): of unset ones 0.

    Parameters
    ----------
    values : CellValues of size 0
    """
    own, bricks = values.levels[0].codes, codes >> BRICK_BITS
    at = np.searchsorted(own, bricks)
    in_bricks = np.append(own, ~bricks[:1])[at] == bricks
    found = values.around(bricks, 0)
    chosen = np.flatnonzero(in_bricks)
    bits = (codes & np.uint64(63)).astype(np.int64)
    for first in range(0, len(chosen), BRICKS):
        part = chosen[first : first + BRICKS]
        distinct, places = np.unique(at[part], return_inverse=True)
        found[part] = values.of_bricks(distinct)[places.ravel(), bits[part]]
    return found
