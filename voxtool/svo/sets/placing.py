"""Octrees of one lattice, placed in a grid that holds them all.

Grids are of one lattice if their pitch is the same and their origins are whole numbers of voxels
apart. An octree whose origin is that of the common grid keeps its nodes. Otherwise each node of the
placed octree is made of up to eight nodes of the given one, and each brick of up to eight bricks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.errors import GridError
from voxtool.grid import Grid
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, BRICK_VOXELS, INSIDE, LINK, VALID
from voxtool.svo.octree.links import states_of
from voxtool.svo.octree.octree import Octree

EMPTY, FULL = -1, -2  # in place of a node: a uniform block of voxels
OCTANTS = morton_decode(np.arange(8))  # (8, 3): the place of each child
ROUNDINGS = 4.0  # of float64, by which the origins of one lattice may differ
SAME = (
    2.0**-32
)  # voxel, by which they may, too: near 0, of grids on the lattice of one farther away


@dataclass(frozen=True)
class Placed:
    """The nodes of an octree that is part of a larger one."""

    words: list[np.ndarray]  # uint32 `child` words by level, root first, without level 0
    bricks: np.ndarray  # (M,) uint64


def common_grid(grids: Sequence[Grid]) -> tuple[Grid, np.ndarray]:
    """Return the smallest grid that holds all grids, and their low corners in it.

    Returns
    -------
    Grid
    (n, 3) int64
        Voxels, none is negative.

    Raises
    ------
    GridError
        If the grids are not of one lattice, or the common one has too many voxels.
    """
    first = grids[0]
    origins, pitch = np.array([grid.origin for grid in grids]), np.array(first.pitch)
    steps = np.rint((origins - origins[0]) / pitch)
    # each origin is a sum of a product, both rounded
    largest = np.maximum(np.abs(origins), np.abs(origins[0])) + np.abs(steps * pitch)
    most = ROUNDINGS * np.spacing(largest) + SAME * pitch
    apart = np.abs(origins - (origins[0] + steps * pitch)) > most
    for number, (grid, wrong) in enumerate(zip(grids, apart, strict=True), 1):
        if grid.pitch != first.pitch:
            raise GridError(
                f"octrees 1 and {number} have voxels of {_triple(first.pitch)} and "
                f"{_triple(grid.pitch)}: voxelize one again with --lattice, naming the other"
            )
        if wrong.any():
            raise GridError(
                f"octrees 1 and {number} have origins {_triple(first.origin)} and "
                f"{_triple(grid.origin)}, which are not whole numbers of voxels apart: voxelize "
                "one again with --lattice, naming the other"
            )
    lows = steps.astype(np.int64)
    lows -= lows.min(axis=0)
    shape = (lows + [grid.shape for grid in grids]).max(axis=0)
    origin = origins[np.argmin(lows, axis=0), range(3)]
    return Grid(tuple(shape), tuple(origin), first.pitch), lows


def _triple(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def place(octree: Octree, grid: Grid, low: np.ndarray) -> Placed:
    """Return the nodes of an octree in that of a grid, where its low corner is voxel `low`, which
    may lie before the grid; what lies beyond the grid's cube is left out."""
    depth = (grid.side // BRICK_SIDE).bit_length()
    placed = _deepened(octree, depth)
    placed = _moved(placed, low) if low.any() else placed
    while len(placed.words) >= depth:
        placed = _first_octant(placed)
    return placed


def placed_octree(octree: Octree, grid: Grid, low: np.ndarray) -> Octree:
    """Return that octree, pruned."""
    placed = place(octree, grid, low)
    levels = [states_of(words) for words in placed.words]
    return Octree.of_states(grid, "solid", "none", levels, placed.bricks).pruned()


def _deepened(octree: Octree, depth: int) -> Placed:
    """Return an octree below roots of more voxels; it is their first child."""
    words = [octree.child_words(d) for d in range(octree.depth - 1)]
    for _ in range(depth - octree.depth):
        eight = np.zeros(8, np.uint32)
        eight[:1] = words[0]
        words = [np.array([VALID]), eight, *words[1:]]
    return Placed(words, octree.bricks)


def _first_octant(placed: Placed) -> Placed:
    """Return the first of the eight nodes below the root, and what lies below it."""
    root, *below = placed.words
    if not root[0] & VALID:
        return Placed([root, *(words[:0] for words in below[1:])], placed.bricks[:0])
    words, size = [], 1
    for level in below:
        words.append(level[:size])
        size = 8 * int(np.count_nonzero(words[-1] & VALID))
    return Placed(words, placed.bricks[:size])


def _moved(placed: Placed, low: np.ndarray) -> Placed:
    """Return an octree with its voxels moved by `low` along each axis.

    Along each axis, a node covers parts of the given octree's nodes q and q + 1 cells away, or only
    of the first: nodes[i, o] is the one at corner o of node i. So do the nodes of the level below.
    """
    words: list[np.ndarray] = []
    side = BRICK_SIDE << len(placed.words)
    q = -low // side
    at_root = (OCTANTS * (low % side > 0) + q == 0).all(axis=1)
    nodes = np.where(at_root, 0, EMPTY)[None].astype(np.int32)
    for given in placed.words:
        firsts = first_children(given, nodes)
        uniform = (firsts == firsts[:, :1]).all(axis=1) & (firsts[:, 0] < 0)
        level = np.where(firsts[:, 0] == FULL, INSIDE, np.uint32(0))
        kept = np.flatnonzero(~uniform)
        level[kept] = VALID | np.arange(0, 8 * len(kept), 8, dtype=np.uint32)
        words.append(level)
        side //= 2
        below = -low // side
        cells = OCTANTS[:, None] + OCTANTS * (low % side > 0) + (below - 2 * q)  # [child, corner]
        corners, octants = ((part << np.arange(3)).sum(axis=2) for part in (cells >> 1, cells & 1))
        firsts = firsts[kept[:, None, None], corners]
        firsts += np.where(firsts < 0, np.int32(0), octants.astype(np.int32))
        nodes = firsts.reshape(-1, 8)
        q = below
    masks = masks_of(placed.bricks, nodes)
    for axis, start in enumerate((-low % BRICK_SIDE).tolist()):
        one, other = masks[:, ::2], masks[:, 1::2]
        masks = _moved_masks(one, other, axis, start) if start else one
    return Placed(words, np.ascontiguousarray(masks[:, 0]))


def _moved_masks(one: np.ndarray, other: np.ndarray, axis: int, start: int) -> np.ndarray:
    """Return the masks of the four layers from `start` on, of two bricks side by side."""
    layer = BRICK.type(np.sum(1 << np.flatnonzero(BRICK_VOXELS[:, axis] == 0), dtype=np.uint64))
    shifts = morton_encode(np.eye(3, dtype=int)[axis] * np.arange(BRICK_SIDE)[:, None]).astype(int)
    wanted: dict[tuple[int, int], np.uint64] = {}  # the layers of one brick that move as far
    for to, shift in enumerate(shifts.tolist()):
        beyond, layer_of = divmod(start + to, BRICK_SIDE)
        key = beyond, shift - int(shifts[layer_of])
        wanted[key] = wanted.get(key, BRICK.type(0)) | layer << BRICK.type(shift)
    moved = np.zeros(one.shape, BRICK)
    for (beyond, by), layers in wanted.items():
        source, far = other if beyond else one, BRICK.type(abs(by))
        moved |= (source << far if by > 0 else source >> far) & layers
    return moved


def first_children(words: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the first child of each node, from the `child` words of its level, or EMPTY or FULL
    for a leaf; a node may be EMPTY or FULL itself."""
    child = np.append(words, [INSIDE, np.uint32(0)])[nodes]  # FULL is -2, EMPTY -1
    leaf = np.where(child & INSIDE, np.int32(FULL), np.int32(EMPTY))
    return np.where(child & VALID, (child & LINK).astype(np.int32), leaf)


def masks_of(bricks: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the masks of level 0 nodes, which may be EMPTY or FULL."""
    return np.append(bricks, [~BRICK.type(0), BRICK.type(0)])[nodes]
