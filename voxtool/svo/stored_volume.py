"""The sum of the fractions of an octree."""

from __future__ import annotations

from typing import Any

import numpy as np

from voxtool.svo.exact_sums import exact_sum

WHOLE = 1 << 31  # float32 fractions are whole numbers of 1 / WHOLE


def stored_volume(octree: Any) -> float:
    """Return the sum of the fractions of an octree, in voxels: the exact number, rounded once.

    Parameters
    ----------
    octree : Octree, or BlockOctree once it has been written.
    """
    fraction = octree.attribute("fraction")
    dtype = fraction.leaves.dtype
    unit = 1 if dtype.kind == "f" else int(np.iinfo(dtype).max)
    total, rest = fraction.total, octree.count - len(fraction.values)
    if len(fraction.leaves):
        start = 0
        for level in octree.levels()[:-1]:
            stop = start + int(level.inside.sum())
            total += exact_sum(fraction.leaves[start:stop]) * level.side**3
            rest -= (stop - start) * level.side**3
            start = stop
    return float((total + rest * exact_sum(fraction.blank[None])) / unit)
