"""Octrees in pages: the nodes that hold a voxel, as masks of children, and the bricks.

A page has no links: the refined nodes come level by level, root first, so that the script counts
them. The root stands in a node of twice its size, which also serves a root that is a leaf.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.rendering import scene_of
from voxtool.svo.raycast import COLOUR
from voxtool.viewer.content import PageContent

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree


def octree_content(octree: Octree) -> PageContent:
    """Return the content of a page that shows an octree.

    The arrays are `children`, (n, 2) uint8: for each refined node above the bricks that holds a
    voxel, which children hold one, and which of those that do are refined (bits in Morton order;
    the children of level 1 are bricks); and `bricks`, (m, 2) uint32: the masks that are not 0.
    """
    counts, children = _children(octree)
    bricks = octree.bricks[octree.bricks != 0].astype("<u8", copy=False).view("<u4").reshape(-1, 2)
    grid, points = octree.grid, scene_of(octree).points()
    facts = {
        "depth": octree.depth,
        "root": octree.depth + 2,
        "levels": counts,
        "shape": list(grid.shape),
        "origin": list(grid.origin),
        "pitch": list(grid.pitch),
        "units": octree.units,
        "box": [points.min(axis=0).tolist(), points.max(axis=0).tolist()],
        "colour": list(COLOUR),
        "voxels": octree.count,
    }

    def smaller_by(share: float) -> str:  # bytes grow as the square of dim
        return f"voxelize with --dim {max(int(grid.dim * math.sqrt(share)), 8)} or so"

    return PageContent("octree", facts, {"children": children, "bricks": bricks}, smaller_by)


def _children(octree: Octree) -> tuple[list[int], np.ndarray]:
    """Return the number of nodes of each level that are stored, and their masks of children."""
    masks: list[np.ndarray] = []
    held, refined = octree.bricks != 0, np.zeros(len(octree.bricks), bool)
    for level in reversed(octree.levels()):
        if level.number:
            parents = level.refined.copy()
            groups = held.reshape(-1, 8)
            full = groups.any(axis=1)
            masks.append(_packed(groups, refined.reshape(-1, 8))[full])
            parents[parents] = full
            held, refined = parents | level.inside, parents
    root = np.zeros((2, 8), bool)
    root[:, 0] = held[0], refined[0]
    masks.append(_packed(root[:1], root[1:]))
    masks.reverse()
    return [len(mask) for mask in masks], np.concatenate(masks)


def _packed(held: np.ndarray, refined: np.ndarray) -> np.ndarray:
    """Return (n, 8) flags of children as (n, 2) uint8."""
    bits = [np.packbits(flags, axis=1, bitorder="little") for flags in (held, refined)]
    return np.concatenate(bits, axis=1)
