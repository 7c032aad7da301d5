"""The sum of the fractions of an octree."""

from __future__ import annotations

import numpy as np

from voxtool.svo.octree import Octree

WHOLE = 1 << 31  # float32 fractions are whole numbers of 1 / WHOLE


def stored_volume(octree: Octree) -> float:
    """Return the sum of the fractions of an octree, in voxels: the exact number, rounded once."""
    fraction = octree.attribute("fraction")
    is_float = fraction.values.dtype.kind == "f"
    unit = WHOLE if is_float else int(np.iinfo(fraction.values.dtype).max)

    def whole(values: np.ndarray) -> np.ndarray:
        return (values.astype(np.float64) * (WHOLE if is_float else 1)).astype(np.int64)

    total, rest = int(whole(fraction.values).sum()), octree.count - len(fraction.values)
    if len(fraction.leaves):
        above = [level for level in octree.levels() if level.number]
        sizes = np.repeat(
            [level.side**3 for level in above], [int(level.inside.sum()) for level in above]
        )
        total, rest = total + int((whole(fraction.leaves) * sizes).sum()), rest - int(sizes.sum())
    return (total + rest * int(whole(fraction.blank))) / unit
