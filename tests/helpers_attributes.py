"""Octrees with attributes, made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.svo.attributes import Attribute
from voxtool.svo.octree import Octree

BLOCK = np.s_[8:24, 8:24, 0:16]  # of which leaves above the bricks are made


def scattered() -> Octree:
    """An octree of bricks that are partly set, of full ones and of inside leaves."""
    rng = np.random.default_rng(1)
    dense = rng.random((40, 33, 20)) < 0.4
    dense[BLOCK] = True
    return Octree.from_dense(dense)


def sizes(octree: Octree) -> tuple[int, int]:
    """The set voxels in bricks, and the inside leaves."""
    leaves = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
    return int(np.bitwise_count(octree.bricks).sum()), leaves


def attributed() -> Octree:
    """The same, with an attribute of each kind; fractions are of some voxels alone."""
    octree, rng = scattered(), np.random.default_rng(2)
    voxels, leaves = sizes(octree)
    masks = octree.bricks & rng.integers(0, 1 << 63, len(octree.bricks), dtype=np.uint64)
    some = int(np.bitwise_count(masks).sum())
    label = [rng.integers(0, 3, n).astype(np.uint16) for n in (voxels, leaves)]
    colour = [rng.integers(0, 256, (n, 4)).astype(np.uint8) for n in (voxels, leaves)]
    normal = rng.uniform(-1, 1, (some, 3)).astype(np.float32)
    none = np.empty((0, 3), np.float32)
    return replace(
        octree,
        attributes=(
            Attribute("label", *label, names=("head", "größe", "a b")),
            Attribute("colour", *colour, default=(0, 0, 0, 0)),
            Attribute("normal", normal, none, masks, (0.0, 0.0, 0.0)),
            Attribute("fraction", rng.random(some).astype("f4"), none[:, 0], masks, 1.0),
        ),
    )
