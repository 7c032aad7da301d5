"""Subtrees of an octree as the states of their nodes, and the octree that they make together.

A window of a grid, a cube whose side is a power of two and whose corner is a multiple of it, is a
subtree of the grid's octree: voxelized by itself it has the same nodes and bricks. The states of
its nodes are all that is kept of a window until the octree is written (svo/octree/links.py), and
labels of its full leaves; its bricks wait elsewhere, in the order of the windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.files.octrees.windows import Key
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.svo.octree.layout import BRICK_SIDE, descend
from voxtool.svo.octree.links import EMPTY, FULL, REFINED, level_states
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.plan import NODE_BLOCK

LEAST = NODE_BLOCK  # voxels along a side of a window
MARGIN = 8  # voxels around a window whose faces may reach into its nodes
CORNERS = morton_decode(np.arange(8, dtype=np.uint64))  # of the eight halves of a cube, in order


@dataclass(frozen=True)
class Subtree:
    """A node and all below it.

    levels : the (n,) uint8 states of the nodes of each level, from the root down to level 1;
    bricks : their number;
    labels : labels of the full nodes of each level, or () without labels.
    """

    levels: tuple[np.ndarray, ...]
    bricks: int
    labels: tuple[np.ndarray, ...] = ()

    @property
    def root(self) -> int:
        """The state of the root."""
        return int(self.levels[0][0])


def depth_of(side: int) -> int:
    """Return the number of levels above the bricks of a cube of `side` voxels."""
    return (side // (2 * BRICK_SIDE)).bit_length()


def leaf_subtree(side: int, state: int) -> Subtree:
    """Return the subtree of a cube that is a leaf, EMPTY or FULL."""
    none = np.empty(0, np.uint8)
    return Subtree((np.full(1, state, np.uint8), *[none] * (depth_of(side) - 1)), 0)


def empty_subtree(side: int) -> Subtree:
    """Return the subtree of a cube without voxels."""
    return leaf_subtree(side, EMPTY)


def labels_by_level(levels: Sequence[np.ndarray], leaves: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the labels of the full nodes of each level, given those of all."""
    counts = [int(np.count_nonzero(states == FULL)) for states in levels]
    return tuple(np.split(leaves, np.cumsum(counts)[:-1]))


def subtree_of(octree: Octree, side: int) -> Subtree:
    """Return an octree as the subtree of a cube of `side` voxels, of which it is the low corner."""
    levels = tuple(level_states(octree.offsets, octree.nodes)[::-1])
    leaves = [one.leaves for one in octree.attributes if one.name == "label"]
    labels = labels_by_level(levels, leaves[0]) if leaves else ()
    found = Subtree(levels, len(octree.bricks), labels)
    while (2 * BRICK_SIDE) << (len(found.levels) - 1) < side:
        beyond = empty_subtree((2 * BRICK_SIDE) << (len(found.levels) - 1))
        found = joined([found, *[beyond] * 7])
    return found


def codes_of(levels: Sequence[np.ndarray]) -> np.ndarray:
    """Return the Morton codes of the bricks of a subtree, (n,) uint64."""
    codes = np.zeros(1, np.uint64)
    for states in levels:
        codes = descend(codes[states == REFINED])
    return codes


def voxels_of(levels: Sequence[np.ndarray], bricks: np.ndarray) -> int:
    """Return the number of voxels of a subtree, given the states of its nodes and its bricks."""
    voxels = int(np.bitwise_count(bricks).sum(dtype=np.int64))
    for number, states in enumerate(levels[::-1], 1):
        voxels += int(np.count_nonzero(states == FULL)) * (BRICK_SIDE << number) ** 3
    return voxels


def joined(children: Sequence[Subtree]) -> Subtree:
    """Return the subtree of eight, in Morton order: a leaf if all of them are empty, or full."""
    roots, *below = _by_level([child.levels for child in children])
    labels = _by_level([child.labels for child in children if child.labels])
    bricks = sum(child.bricks for child in children)
    if (roots == EMPTY).all() or (roots == FULL).all():
        labels = labels and [labels[0][:1], labels[0][:0], *labels[1:]]  # they are equal
        return Subtree((roots[:1], roots[:0], *below), bricks, tuple(labels))
    labels = labels and [labels[0][:0], *labels]
    return Subtree((np.full(1, REFINED, np.uint8), roots, *below), bricks, tuple(labels))


def _by_level(parts: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Return arrays of several subtrees, by level, as one for each level."""
    return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]


def shape_of(key: Key, grid: Grid) -> tuple[int, int, int]:
    """Return the voxels of a window along each axis."""
    x, y, z = (min(key[3], n - a) for a, n in zip(key[:3], grid.shape, strict=True))
    return x, y, z


def refuse_smallest(key: Key, shortage: str, least: int = LEAST) -> None:
    """Raise MemoryLimitError if a window that does not fit cannot be divided."""
    if key[3] <= least:
        raise MemoryLimitError(
            f"a window of {key[3]} voxels a side {shortage}: allow more, or choose a smaller dim"
        )


def halves_of(key: Key) -> list[Key]:
    """Return the eight cubes of a cube, in Morton order."""
    x, y, z, side = key
    half = side // 2
    return [(x + half * i, y + half * j, z + half * k, half) for i, j, k in CORNERS.tolist()]


def disk_row(size: int) -> tuple[str, str]:
    """Return the name and the text of the row that `--plan` prints of the disk."""
    return "disk", f"about {human(size)}, of the file and of windows that wait for it"
