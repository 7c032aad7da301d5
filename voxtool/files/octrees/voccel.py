"""Octrees as the framework of [voCCeL] exports them: what its words and offsets say.

Its export_xml is not printed there. Listing 5.1 gives the elements and attributes, section
5.1 the bits of a pointer, listing A.2 the offsets, and listings A.6 and A.7 the brick links. They
differ from those of layout.py in two things: offsets have one number a level, and a level 0 node
links to the first of the two 32-bit words of its brick.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from voxtool.errors import FileError
from voxtool.grid import Grid
from voxtool.svo.octree.layout import INSIDE, LINK, VALID
from voxtool.svo.octree.octree import Octree

WORDS = 2  # 32-bit words of a brick
MAX_BRICKS = (int(LINK) + 1) // WORDS
ATTRIBUTES = ("dim", "size", "depth")  # of its root element


def words_of(bricks: np.ndarray) -> np.ndarray:
    """Return level 0 nodes whose links are indices of 32-bit words instead of bricks; FileError if
    they are too many for 30 bits."""
    if len(bricks) > MAX_BRICKS:
        raise FileError(
            f"{len(bricks):,} bricks are more than the {MAX_BRICKS:,} that voCCeL's links reach: "
            "write .svo.xml"
        )
    nodes = bricks.copy()
    nodes["child"] += nodes["child"] & LINK
    return nodes


def nodes_of(words: np.ndarray, first: int) -> np.ndarray:
    """Return the nodes of voCCeL's words, of which those from `first` on are level 0; FileError
    names a node that links to the middle of a brick.

    A pointer that is not valid may hold any link there; it becomes 0.
    """
    nodes = words.copy()
    for name, flags in (("parent", ~LINK), ("child", INSIDE)):
        nodes[name] &= np.where(nodes[name] & VALID, ~np.uint32(0), flags)
    links = nodes["child"][first:]
    odd = np.flatnonzero(links % WORDS)
    if len(odd):
        raise FileError(
            f"octree brick link: level 0, node {odd[0]} links to word {links[odd[0]] & LINK}, "
            "where no brick begins"
        )
    links -= (links & LINK) // np.uint32(WORDS)
    return nodes


def placed(octree: Octree, grid: Grid, mode: str | None, units: str = "") -> Octree:
    """Return an octree of voCCeL's on another grid of the same dim, as of another mode, and in the
    unit of the grid."""
    mode = mode or octree.mode
    if grid.dim != octree.grid.dim:
        raise FileError(
            f"its dim is {octree.grid.dim}, that of the grid is {grid.dim}: name a grid of its dim"
        )
    fill = "parity" if "solid" in mode else "none"
    found = replace(octree, grid=grid, units=units, mode=mode, fill=fill)
    found.validate()
    return found
