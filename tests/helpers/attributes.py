"""Octrees with attributes, made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import BITS, Attribute
from voxtool.svo.octree.octree import Octree

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
    fraction = rng.random(some).astype("f4")
    area = (3 * rng.random(some)).astype("f4")
    shares = np.random.default_rng(3).random((some, 6)).astype("f4")
    return replace(
        octree,
        attributes=(
            Attribute("label", *label, names=("head", "größe", "a b")),
            Attribute("colour", *colour, default=(0, 0, 0, 0)),
            Attribute("normal", normal, none, masks, (0.0, 0.0, 0.0)),
            Attribute("area", area, none[:, 0], masks),
            Attribute("fraction", fraction, none[:, 0], masks, 1.0),
            Attribute("faces", shares, shares[:0], masks, (1.0,) * 6),
        ),
    )


def value_array(octree: Octree, name: str) -> np.ndarray:
    """The value of each voxel, (nx, ny, nz, ...) int64; -1 where none is set."""
    values = octree.values(name)
    row = values.attribute.values.shape[1:]
    found = np.full((*[-(-n // 4) * 4 for n in octree.grid.shape], *row), -1, np.int64)
    leaves = iter(np.asarray(values.attribute.leaves))
    for level in octree.levels():
        if level.number:
            side = level.side
            for x, y, z in level.cells[level.inside]:
                found[x : x + side, y : y + side, z : z + side] = next(leaves)
        else:
            at = 4 * morton_decode(level.codes)[:, None] + morton_decode(np.arange(64))
            set_ = octree.bricks[:, None] & BITS != 0
            found[tuple(at[set_].T)] = values.of_bricks(slice(None))[set_]
    assert next(leaves, None) is None
    nx, ny, nz = octree.grid.shape
    return found[:nx, :ny, :nz]


def label_array(octree: Octree) -> np.ndarray:
    """The label of each voxel, (nx, ny, nz) int64; -1 where none is set."""
    return value_array(octree, "label")


def labelled(labels: np.ndarray, names: tuple[str, ...]) -> Octree:
    """An octree of bricks with the label of each voxel of an array; -1 where none is set."""
    octree = replace(Octree.from_dense(labels >= 0, mode="surface26"), mode="solid")
    padded = np.pad(labels, [(0, -n % 4) for n in labels.shape])
    kept = np.flatnonzero(octree.bricks)
    at = octree.levels()[-1].cells[kept][:, None] + morton_decode(np.arange(64))
    held = (octree.bricks[kept, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)) == 1
    values = padded[tuple(at[held].T)].astype(np.uint8)
    none = np.empty(0, np.uint8)
    return replace(octree, attributes=(Attribute("label", values, none, names=names),))
