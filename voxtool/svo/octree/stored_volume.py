"""The sum of the fractions of an octree."""

from __future__ import annotations

from typing import Any

import numpy as np

from voxtool.svo.octree.exact_sums import exact_sum

WHOLE = 1 << 31  # float32 fractions are whole numbers of 1 / WHOLE


def stored_volume(octree: Any) -> float:
    """Return the sum of the fractions of an octree, in voxels: the exact number, rounded once.

    Parameters
    ----------
    octree : one with attributes, or a BlockOctree once it has been written.
    """
    fraction = octree.attribute("fraction")
    dtype = fraction.leaves.dtype
    unit = 1 if dtype.kind == "f" else int(np.iinfo(dtype).max)
    total, rest = fraction.total, octree.count - len(fraction.values)
    if len(fraction.leaves):
        start = 0
        for count, size in octree.leaf_sizes:
            total += exact_sum(fraction.leaves[start : start + count]) * size
            rest -= count * size
            start += count
    return float((total + rest * exact_sum(fraction.blank[None])) / unit)
