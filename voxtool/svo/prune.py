"""Octrees in canonical form, from the states of their nodes.

A node is refined if a triangle makes it active, or if only some of its voxels are set. A fill rule
may refine further nodes; `prune` removes their children, so that the octree depends only on the
mesh and on the set of voxels.
"""

from __future__ import annotations

import numpy as np

from voxtool.morton import distinct
from voxtool.svo.layout import BRICK, BRICK_SIDE, INSIDE, NODE, VALID

EMPTY, FULL, REFINED = range(3)  # states of nodes
ALL_VOXELS = ~np.uint64(0)


def states_of(offsets: np.ndarray, nodes: np.ndarray) -> list[np.ndarray]:
    """Return the states of the nodes of an octree, by level from level 1 up."""
    child = nodes["child"][: offsets[-2]]
    states = np.where(child & INSIDE, FULL, EMPTY).astype(np.uint8)
    states[(child & VALID) != 0] = REFINED
    return np.split(states, offsets[1:-2])[::-1]


def prune(
    lists: list[np.ndarray], states: list[np.ndarray], bricks: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make leaves of the refined nodes that are neither active nor mixed.

    `lists` holds the ascending Morton codes of the refined nodes by level, from level 1 up,
    `states` the (n,) uint8 states of all nodes of each level, and `bricks` the masks of the
    children of the refined level-1 nodes. The level-1 nodes with codes `active`, which are among
    the refined ones, stay refined. Returns the offsets, nodes and bricks of an Octree.
    """
    parts, below = [], np.empty(0, np.uint8)
    for level, (codes, state) in enumerate(zip(lists, states, strict=True), 1):
        if level == 1:
            bricks = bricks.reshape(-1, 8)
            empty, full = (bricks == 0).all(axis=1), (bricks == ALL_VOXELS).all(axis=1)
            stays = ~(empty | full)
            stays[np.searchsorted(codes, active)] = True
            bricks = bricks[stays].ravel().astype(BRICK, copy=False)
        else:
            below = below.reshape(-1, 8)
            empty, full = (below == EMPTY).all(axis=1), (below == FULL).all(axis=1)
            stays = ~(empty | full)
            parts.append(below[stays].ravel())
        below = state.copy()
        refined = np.flatnonzero(state == REFINED)
        below[refined[~stays & empty]] = EMPTY
        below[refined[~stays & full]] = FULL
    parts.append(below)
    return _linked(parts[::-1], bricks)


def levels_of(
    codes: np.ndarray, full: list[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the ascending codes of the refined nodes and the states of all nodes, by level from
    level 1 up: of the octree of refined level-1 nodes, given by their ascending codes, and of FULL
    leaves, given by their codes, for each level up to the root's."""
    lists, states = [codes], []
    for leaves in full[:-1]:
        lists.append(distinct(np.concatenate([lists[-1], leaves]) >> np.uint64(3)))
    for refined, leaves, parents in zip(lists, full, [*lists[1:], None], strict=True):
        if parents is None:
            state, places = np.full(1, EMPTY, np.uint8), (refined.astype(int), leaves.astype(int))
        else:
            state = np.full(8 * len(parents), EMPTY, np.uint8)
            places = child_places(refined, parents), child_places(leaves, parents)
        state[places[0]], state[places[1]] = REFINED, FULL
        states.append(state)
    return lists, states


def octree_of_bricks(
    side: int,
    codes: np.ndarray,
    masks: np.ndarray,
    full: list[np.ndarray] | None = None,
    *,
    collapse: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets, nodes and bricks of the canonical octree of occupied bricks, given by their
    ascending codes and masks, and of FULL leaves, given by their codes for each level from 1 to the
    root's. With `collapse`, nodes whose voxels are all set become leaves."""
    none = codes[:0]
    top = (side // (2 * BRICK_SIDE)).bit_length()
    lists, states = levels_of(distinct(codes >> np.uint64(3)), full or [none] * top)
    bricks = np.zeros(8 * len(lists[0]), BRICK)
    bricks[child_places(codes, lists[0])] = masks
    return prune(lists, states, bricks, none if collapse else lists[0])


def child_places(codes: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return the index of each node among the children of the parents; all codes ascend."""
    rank = np.searchsorted(parents, codes >> np.uint64(3))
    return 8 * rank + (codes & np.uint64(7)).astype(np.int64)


def _linked(
    levels: list[np.ndarray], bricks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the linked nodes of levels that are given by their nodes' states, root first."""
    sizes = [len(states) for states in levels] + [len(bricks)]
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.uint32)
    nodes = np.zeros(int(offsets[-1]), NODE)
    child, parent = nodes["child"], nodes["parent"]
    for depth, states in enumerate(levels):
        own = child[offsets[depth] : offsets[depth + 1]]
        own[states == FULL] = INSIDE
        refined = np.flatnonzero(states == REFINED).astype(np.uint32)
        own[refined] = VALID | 8 * np.arange(len(refined), dtype=np.uint32)
        parent[offsets[depth + 1] : offsets[depth + 2]] = VALID | np.repeat(refined, 8)
    child[offsets[-2] :] = VALID | np.arange(len(bricks), dtype=np.uint32)
    return offsets, nodes, bricks
