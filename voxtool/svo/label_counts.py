"""How many voxels have each label."""

from __future__ import annotations

import numpy as np

from voxtool.svo.attribute_levels import BRICKS
from voxtool.svo.attributes import BITS
from voxtool.svo.octree import Octree


def label_counts(octree: Octree) -> np.ndarray:
    """Return the set voxels of each label of an octree that has labels, (names,) int64."""
    label, values = octree.attribute("label"), octree.values("label")
    most = len(label.names)
    found = np.zeros(most, np.int64)
    for first in range(0, len(octree.bricks), BRICKS):
        part = slice(first, first + BRICKS)
        held = values.of_bricks(part)[(octree.bricks[part, None] & BITS) != 0]
        found += np.bincount(held, minlength=most)
    above = [level for level in octree.levels() if level.number]
    sizes = [np.full(int(level.inside.sum()), level.side**3) for level in above]
    volumes = np.concatenate([np.empty(0, np.int64), *sizes])
    np.add.at(found, values.of_leaves(len(volumes)), volumes)
    return found
