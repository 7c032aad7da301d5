"""The invariants of an octree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import FileError
from voxtool.morton import morton_decode, spread_bits
from voxtool.svo.octree.layout import BRICK_SIDE, INSIDE, LINK, VALID, voxels_within

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.svo.octree.content import OctreeContent, Span

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


def check_sizes(octree: OctreeContent) -> None:
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


def check_structure(octree: OctreeContent) -> None:
    """Raise FileError for an invariant of nodes and bricks that does not hold."""
    check_sizes(octree)
    _check_children(octree)
    grid = octree.grid
    padded = grid.shape != (grid.side,) * 3
    for span in octree.walk():
        _check_links(octree, span)
        if padded:
            _check_padding(octree, span)


def _check_children(octree: OctreeContent) -> None:
    """Check that every refined node has eight nodes on the level below."""
    sizes, depth = np.diff(octree.offsets.astype(np.int64)), octree.depth
    for d in range(depth - 1):
        refined = sum(np.count_nonzero(block["child"] & VALID) for block in octree.blocks(d))
        if 8 * refined != sizes[d + 1]:
            raise FileError(
                f"octree children: {refined} refined nodes on level {depth - 1 - d} do not "
                f"have the {sizes[d + 1]} nodes of the level below"
            )


def _check_links(octree: OctreeContent, span: Span) -> None:
    """Check the links and flags of some nodes."""
    parent, child = span.nodes["parent"], span.nodes["child"]
    refined, inside = (child & VALID) != 0, (child & INSIDE) != 0
    wrong = {"inside flag of a refined node (both coarse-inside and refined)": refined & inside}
    if span.number == 0:
        owned = VALID | np.arange(span.start, span.start + len(child), dtype=np.uint32)
        wrong["brick link (one brick a node, in order)"] = child != owned
    else:
        children = span.first_child + 8 * (np.cumsum(refined, dtype=np.uint32) - refined)
        wrong["child link (Morton order: 8 nodes after the one before)"] = refined & (
            (child & LINK) != children
        )
        linked = (child & LINK) != 0
        wrong["leaf (link bits of a node without children are zero)"] = ~refined & linked
        if "solid" not in octree.mode:
            wrong["inside flag of a surface"] = inside
    if span.number == octree.depth - 1:
        wrong["parent link of the root (it has none)"] = parent != 0
    else:
        owners = VALID | np.repeat(span.parents, 8)
        wrong["parent link (the parent and its child agree)"] = parent != owners
    for what, bad in wrong.items():
        _refuse(what, bad, "is wrong", span)


def _check_padding(octree: OctreeContent, span: Span) -> None:
    """Check that no voxel is set between the grid's shape and the octree's cube."""
    shape = octree.grid.shape
    bad = np.zeros(len(span.codes), bool)
    ends = spread_bits(np.array(shape) // (BRICK_SIDE << span.number))  # first cells not within
    for axis, end in enumerate(ends):  # the bits of one axis compare as the coordinates do
        bad |= (span.codes >> np.uint64(axis)) & BITS_OF_X >= end
    if span.number:
        bad &= (span.nodes["child"] & INSIDE) != 0
    else:
        edge = np.flatnonzero(bad)
        allowed = voxels_within(morton_decode(span.codes[edge]), shape)
        bricks = octree.bricks[span.start : span.start + len(bad)]
        bad[edge] = (bricks[edge] & ~allowed) != 0
    _refuse("padding", bad, "has voxels set beyond the grid's shape", span)


def _refuse(what: str, bad: np.ndarray, why: str, span: Span) -> None:
    """Raise FileError if a node of a span is bad."""
    if bad.any():
        node = span.start + int(np.argmax(bad))
        raise FileError(f"octree {what}: level {span.number}, node {node} {why}")
