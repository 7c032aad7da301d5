"""Octrees in pages: the nodes that hold a voxel, as masks of children, and the bricks.

A page has no links: the refined nodes come level by level, root first, so that the script counts
them. It may end at a level: nodes of that level have the share that is set instead of bricks. The
root stands in a node of twice its size, which also serves a root that is a leaf.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from voxtool.errors import printable
from voxtool.palette import palette
from voxtool.pictures.rendering import scene_of
from voxtool.svo.attributes.of_cells import BRICKS, CellValues
from voxtool.svo.cells.counts import BRICK_POWER, check_isovalue, counts_of
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.attributes import BITS
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import VOXEL, Octree, level_number
from voxtool.svo.pictures.painting import BY_DEFAULT
from voxtool.svo.pictures.raycast import COLOUR
from voxtool.viewer.content import PageContent


def octree_content(
    octree: Octree | MergedOctree, level: int | str = "voxel", isovalue: float | None = None
) -> PageContent:
    """Return the content of a page that shows an octree, down to the nodes of a level; at first,
    above voxels, those of which at least the share `isovalue` is set. A merged octree is expanded
    only for bricks and voxels.

    The arrays are `children`, (n, 2) uint8: for each refined node above the finest that holds a
    voxel, which children hold one, and which of these are refined (bits in Morton order); and for
    the finest nodes that hold one `bricks`, (m, 2) uint32, the masks of their voxels, or with a
    level `shares`, (m,) float32, how much of each is set. Those of an octree's labels and colours,
    `label` and `colour`, have the values of the held children of these nodes, and then of voxels;
    `palette`, (k, 3) uint8, has the colours of labels.
    """
    finest = level_number(octree, level, octree.depth - 1)
    check_isovalue(isovalue)
    if finest <= 0 and isinstance(octree, MergedOctree):
        octree = octree.expanded()
    masks, shares = _children(octree, max(finest, 0))
    counts = list(map(len, masks))
    arrays = {"children": np.concatenate(masks)}
    if finest == VOXEL:
        assert isinstance(octree, Octree)
        bricks = octree.bricks[octree.bricks != 0].astype("<u8", copy=False)
        arrays["bricks"] = bricks.view("<u4").reshape(-1, 2)
    else:
        arrays["shares"] = shares
    attributes = tinted(octree)
    for name in attributes:
        assert isinstance(octree, Octree)
        arrays[name] = _values(octree, name, finest)
    if "label" in attributes:
        arrays["palette"] = palette(len(attributes["label"]["names"]))
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
        **({} if finest == VOXEL else {"finest": finest}),
        **({} if isovalue is None else {"isovalue": isovalue}),
        **({"attributes": attributes} if attributes else {}),
    }

    def smaller_by(share: float) -> str:
        most = share * sum(array.nbytes for array in arrays.values())
        above = range(max(finest, -1) + 1, octree.depth)
        fits = [n for n in above if _bytes_to(masks[: octree.depth - n]) <= most]
        dim = max(int(grid.dim * math.sqrt(share)), 8)  # bytes grow as its square
        shown = f"--level {fits[0]} shows its nodes instead of voxels, or " if fits else ""
        return f"{shown}voxelize with --dim {dim} or so"

    return PageContent("octree", facts, arrays, smaller_by)


def tinted(octree: Octree | MergedOctree) -> dict[str, dict[str, Any]]:
    """Return the attributes that pages show, with the names of labels, in JSON types."""
    held = octree.attributes if isinstance(octree, Octree) else ()
    names = {one.name: list(map(printable, one.names)) for one in held}
    return {name: {"names": names[name]} for name in BY_DEFAULT if name in names}


def _values(octree: Octree, name: str, finest: int) -> np.ndarray:
    """Return the values of the nodes that hold a voxel, level by level from the root down to level
    `finest` or the bricks, and then those of voxels if they are shown."""
    cells = CellValues(octree, name, max(finest, 0) + BRICK_POWER)
    counts = counts_of(octree, max(finest, 0) + BRICK_POWER).of_nodes
    levels = range(octree.depth - 1, max(finest, 0) - 1, -1)
    every = cells.of_all_nodes()
    found = [every[number][counts[number] > 0] for number in levels]
    if finest == VOXEL:
        voxels = CellValues(octree, name, 0)
        for first in range(0, len(octree.bricks), BRICKS):
            part = slice(first, first + BRICKS)
            found.append(voxels.of_bricks(part)[(octree.bricks[part, None] & BITS) != 0])
    return np.concatenate(found)


def _bytes_to(masks: list[np.ndarray]) -> int:
    """Return the bytes of a page down to the children of the last of these nodes."""
    leaves = int(np.bitwise_count(masks[-1][:, 0]).sum())
    return sum(mask.nbytes for mask in masks) + 4 * leaves


def _children(octree: Octree | MergedOctree, finest: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the masks of children of the stored nodes above level `finest`, level by level from
    the root, and how much is set of the nodes of this level that hold a voxel."""
    counts = counts_of(octree, finest + BRICK_SIDE.bit_length() - 1)
    voxels, masks = counts.of_nodes, []
    held, refined = voxels[finest] > 0, np.zeros(len(voxels[finest]), bool)
    shares = voxels[finest][held] / float(counts.levels[finest].side ** 3)
    for level in counts.levels[finest + 1 :]:
        groups = held.reshape(-1, 8)
        masks.append(_packed(groups, refined.reshape(-1, 8))[groups.any(axis=1)])
        held = voxels[level.number] > 0
        refined = level.refined & held
    root = np.zeros((2, 8), bool)
    root[:, 0] = held[0], refined[0]
    masks.append(_packed(root[:1], root[1:]))
    return masks[::-1], shares.astype(np.float32)


def _packed(held: np.ndarray, refined: np.ndarray) -> np.ndarray:
    """Return (n, 8) flags of children as (n, 2) uint8."""
    bits = [np.packbits(flags, axis=1, bitorder="little") for flags in (held, refined)]
    return np.concatenate(bits, axis=1)
