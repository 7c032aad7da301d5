"""Nodes of octrees from their states, and states from nodes.

A node's state says whether it is refined, or an empty or a full leaf. Its links follow from the
states of the nodes before it, so the states of an octree, a byte a node above the bricks, are all
that is needed to write its nodes block by block.

Links have 30 bits. In an octree with more nodes, which only merged subtrees can stand for, they
are the lowest 30 bits: a digest needs no more, as the states say where children are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from voxtool.arrays import Slices, blocks_of
from voxtool.svo.octree.layout import INSIDE, LINK, NODE, VALID

EMPTY, FULL, REFINED = range(3)  # states of nodes
BLOCK = 1 << 17  # nodes whose children are linked at once


def states_of(child: np.ndarray) -> np.ndarray:
    """Return the (n,) uint8 states of nodes above level 0, given by their `child` words."""
    states = np.where(child & INSIDE, FULL, EMPTY).astype(np.uint8)
    states[(child & VALID) != 0] = REFINED
    return states


def level_states(offsets: np.ndarray, nodes: np.ndarray | Slices) -> list[np.ndarray]:
    """Return the states of the nodes of an octree, by level from level 1 up."""
    levels = []
    for start, stop in pairwise(offsets[:-1].tolist()):
        parts = blocks_of(nodes, BLOCK, start, stop)
        states = [np.empty(0, np.uint8), *(states_of(part["child"]) for part in parts)]
        levels.append(np.concatenate(states))
    return levels[::-1]


def offsets_of(levels: Sequence[np.ndarray], bricks: int) -> np.ndarray:
    """Return the (depth + 1,) int64 offsets of the levels among the nodes of an octree, given by
    the states of the nodes of each level, from the root down to level 1, and its bricks."""
    sizes = [len(states) for states in levels] + [bricks]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def nodes_of(levels: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the linked nodes of that octree, in blocks of NODE, root first."""
    root = _linked(np.zeros(1, "<u4"), levels[0], 0)
    root["parent"] = 0
    yield root
    for above, own in zip(levels, [*levels[1:], None], strict=True):
        ranks = 0  # refined nodes above, and in this level, before the block
        first_child = 0
        for start in range(0, len(above), BLOCK):
            refined = (start + np.flatnonzero(above[start : start + BLOCK] == REFINED)).astype(
                "<u4"
            )
            parents = np.repeat(refined & LINK, 8)
            if own is None:
                nodes = np.empty(len(parents), NODE)
                nodes["child"] = _links(8 * ranks, len(parents), 1)
                nodes["parent"] = VALID | parents
            else:
                states = own[8 * ranks : 8 * ranks + len(parents)]
                nodes = _linked(parents, states, first_child)
                first_child += 8 * int(np.count_nonzero(states == REFINED))
            ranks += len(refined)
            yield nodes


def _linked(parents: np.ndarray, states: np.ndarray, first_child: int) -> np.ndarray:
    """Return the nodes with these states and parents, whose first child has this index."""
    nodes = np.zeros(len(states), NODE)
    refined = np.flatnonzero(states == REFINED)
    nodes["parent"] = VALID | parents
    nodes["child"][states == FULL] = INSIDE
    nodes["child"][refined] = _links(first_child, len(refined), 8)
    return nodes


def _links(first: int, count: int, step: int) -> np.ndarray:
    """Return the links to indices first, first + step, ...: their lowest bits, (n,) uint32."""
    found = np.arange(count, dtype="<u4")  # numbers are modulo 2**32
    found *= np.uint32(step)
    found += np.uint32(first & 0xFFFFFFFF)
    found &= LINK
    found |= VALID
    return found
