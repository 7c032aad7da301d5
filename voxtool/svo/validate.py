"""The invariants of an octree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import FileError
from voxtool.morton import morton_decode, spread_bits
from voxtool.svo.layout import BRICK_SIDE, LINK, VALID, voxels_within

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.svo.octree import Level, Octree

BITS_OF_X = spread_bits(np.array((1 << 21) - 1))  # in a Morton code


def check_offsets(grid: Grid, offsets: np.ndarray) -> None:
    """Raise FileError if the sizes of an octree's levels do not fit the grid or each other; called
    before memory is allocated for the nodes."""
    offsets = offsets.astype(np.int64)
    depth = (grid.side // BRICK_SIDE).bit_length()
    if len(offsets) != depth + 1:
        raise FileError(
            f"octree offsets: {len(offsets) - 1} levels, but a grid of dim {grid.dim} has {depth}"
        )
    sizes = np.diff(offsets)
    if offsets[0] != 0 or offsets[1] != 1 or (sizes < 0).any():
        raise FileError("octree offsets: they do not begin with 0 and 1 (the root) and ascend")
    if (sizes[1:] % 8).any():
        raise FileError("octree offsets: the size of a level below the root is not a multiple of 8")
    if (sizes[1:] > 8 * sizes[:-1]).any() or sizes.max() > int(LINK) + 1:
        raise FileError("octree offsets: a level has more nodes than the level above allows")


def check_sizes(octree: Octree) -> None:
    """Raise FileError if the sizes of the arrays do not fit the grid or each other."""
    check_offsets(octree.grid, octree.offsets)
    offsets = octree.offsets.astype(np.int64)
    if offsets[-1] != len(octree.nodes):
        raise FileError(
            f"octree offsets: they end at {offsets[-1]}, but there are {len(octree.nodes)} nodes"
        )
    if len(octree.bricks) != offsets[-1] - offsets[-2]:
        raise FileError(
            f"octree bricks: {len(octree.bricks)} for {offsets[-1] - offsets[-2]} level 0 nodes"
        )


def check_structure(octree: Octree) -> None:
    """Raise FileError for the first invariant of nodes and bricks that does not hold."""
    check_sizes(octree)
    _check_children(octree)
    levels = octree.levels()
    for level in levels:
        _check_level(octree, level)
    _check_padding(octree, levels)


def _check_children(octree: Octree) -> None:
    """Check that every refined node has eight nodes on the level below."""
    sizes, depth = np.diff(octree.offsets.astype(np.int64)), octree.depth
    for d in range(depth - 1):
        refined = np.count_nonzero(octree.child_words(d) & VALID)
        if 8 * refined != sizes[d + 1]:
            raise FileError(
                f"octree children: {refined} refined nodes on level {depth - 1 - d} do not "
                f"have the {sizes[d + 1]} nodes of the level below"
            )


def _check_level(octree: Octree, level: Level) -> None:
    """Check the links and flags of a level's nodes."""
    parent, child, refined = level.nodes["parent"], level.nodes["child"], level.refined
    both = "inside flag of a refined node (both coarse-inside and refined)"
    wrong = {both: refined & level.inside}
    if level.number == 0:
        owned = VALID | np.arange(len(child), dtype=np.uint32)
        wrong["brick link (one brick a node, in order)"] = child != owned
    else:
        links = child[refined] & LINK
        expected = 8 * np.arange(len(links), dtype=np.uint32)
        wrong["child link (Morton order: 8 nodes after the one before)"] = links != expected
        linked = (child & LINK) != 0
        wrong["leaf (link bits of a node without children are zero)"] = ~refined & linked
        if "solid" not in octree.mode:
            wrong["inside flag of a surface"] = level.inside
    if level.number == octree.depth - 1:
        wrong["parent link of the root (it has none)"] = parent != 0
    else:
        above = octree.child_words(octree.depth - 2 - level.number)
        owners = VALID | np.repeat(np.flatnonzero(above & VALID).astype(np.uint32), 8)
        wrong["parent link (the parent and its child agree)"] = parent != owners
    for what, bad in wrong.items():
        if bad.any():
            raise FileError(
                f"octree {what}: level {level.number}, node {int(np.argmax(bad))} is wrong"
            )


def _check_padding(octree: Octree, levels: list[Level]) -> None:
    """Check that no voxel is set between the grid's shape and the octree's cube."""
    if octree.grid.shape == (octree.grid.side,) * 3:
        return
    for level in levels:
        bad = np.zeros(len(level.codes), bool)
        ends = spread_bits(np.array(octree.grid.shape) // level.side)  # the first cells not within
        for axis, end in enumerate(ends):  # the bits of one axis compare as the coordinates do
            bad |= (level.codes >> np.uint64(axis)) & BITS_OF_X >= end
        if level.number:
            bad &= level.inside
        else:
            edge = np.flatnonzero(bad)
            allowed = voxels_within(morton_decode(level.codes[edge]), octree.grid.shape)
            bad[edge] = (octree.bricks[edge] & ~allowed) != 0
        if bad.any():
            raise FileError(
                f"octree padding: level {level.number}, node {int(np.argmax(bad))} has voxels "
                "set beyond the grid's shape"
            )
