"""The number of voxels of each label."""

from __future__ import annotations

import numpy as np

from voxtool.svo.octree.attributes import BITS, BRICKS
from voxtool.svo.octree.content import AttributedContent


def label_counts(octree: AttributedContent) -> tuple[np.ndarray, np.ndarray]:
    """Return the set voxels of each label of an octree that has labels, (names,) int64, and their
    volumes in voxels, (names,) float64: with fractions the sums of these."""
    label, values = octree.attribute("label"), octree.values("label")
    shares = [octree.values(one.name) for one in octree.attributes if one.name == "fraction"]
    most = len(label.names)
    found, volumes = np.zeros(most, np.int64), np.zeros(most)
    for first in range(0, len(octree.bricks), BRICKS):
        part = slice(first, first + BRICKS)
        set_ = (octree.bricks[part][:, None] & BITS) != 0
        held = values.of_bricks(part)[set_]
        found += np.bincount(held, minlength=most)
        for own in shares:
            volumes += np.bincount(held, own.of_bricks(part)[set_], most)
    sizes = [np.full(count, size, np.int64) for count, size in octree.leaf_sizes]
    cubes = np.concatenate([np.empty(0, np.int64), *sizes])
    np.add.at(found, values.of_leaves(len(cubes)), cubes)
    for own in shares:
        np.add.at(volumes, values.of_leaves(len(cubes)), cubes * own.of_leaves(len(cubes)))
        dtype = own.attribute.values.dtype
        return found, volumes if dtype.kind == "f" else volumes / np.iinfo(dtype).max
    return found, found.astype(float)
