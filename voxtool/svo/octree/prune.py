"""Octrees in canonical form, from the states of their nodes.

A node is refined if a triangle makes it active, or if only some of its voxels are set. A fill rule
may refine further nodes; `prune` removes their children, so that the octree depends only on the
mesh and on the set of voxels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from voxtool.morton import distinct
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, NODE
from voxtool.svo.octree.links import EMPTY, FULL, REFINED, nodes_of, offsets_of

ALL_VOXELS = ~np.uint64(0)


def kinds_of(eights: np.ndarray, empty: Any = EMPTY, full: Any = FULL) -> np.ndarray:
    """Return the kinds of nodes, (n,) uint8, given those of their children, (n, 8): EMPTY or FULL
    if all children are, otherwise REFINED."""
    kinds = np.full(len(eights), REFINED, np.uint8)
    kinds[_whole(eights == empty)] = EMPTY
    kinds[_whole(eights == full)] = FULL
    return kinds


def _whole(eights: np.ndarray) -> np.ndarray:
    """Return which rows of (n, 8) bool are True throughout: each is read as a word."""
    return eights.view(np.uint64).ravel() == 0x0101010101010101


def kinds_of_bricks(bricks: np.ndarray) -> np.ndarray:
    """Return the kinds_of refined level-1 nodes, given the masks of their bricks, eight a node."""
    return kinds_of(bricks.reshape(-1, 8), 0, ALL_VOXELS)


def pruned_states(states: list[np.ndarray], kinds: np.ndarray) -> list[np.ndarray]:
    """Return the states of the nodes that remain where refined nodes whose eight children are alike
    become leaves, by level from level 1 up. `states` are those of all nodes, by level from level 1
    up, and `kinds` those that the bricks make of the refined level-1 nodes."""
    kept = []
    for state in states[:-1]:
        own = state.copy()
        own[own == REFINED] = kinds
        eights = own.reshape(-1, 8)
        kinds = kinds_of(eights)
        kept.append(eights[kinds == REFINED].ravel())
    root = states[-1].copy()
    root[root == REFINED] = kinds
    return [*kept, root]


def prune(
    codes: np.ndarray, states: list[np.ndarray], bricks: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make leaves of the refined nodes that are neither active nor mixed, as `prune_levels` does.
    Returns the offsets, nodes and bricks of an Octree."""
    levels, kept = prune_levels(codes, states, bricks, active)
    offsets = offsets_of(levels, len(kept))
    nodes, start = np.empty(offsets[-1], NODE), 0
    for block in nodes_of(levels):
        nodes[start : start + len(block)] = block
        start += len(block)
    return offsets.astype(np.uint32), nodes, kept


def prune_levels(
    codes: np.ndarray, states: list[np.ndarray], bricks: np.ndarray, active: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Make leaves of the refined nodes that are neither active nor mixed.

    `codes` are the ascending Morton codes of the refined level-1 nodes, `states` the (n,) uint8
    states of all nodes by level, from level 1 up, and `bricks` the masks of the children of the
    refined level-1 nodes. The level-1 nodes with codes `active`, which are among the refined ones,
    stay refined. Returns the states of the nodes that remain, from the root down, and their bricks.
    """
    kinds = kinds_of_bricks(bricks)
    kinds[np.searchsorted(codes, active)] = REFINED
    kept = bricks.reshape(-1, 8)[kinds == REFINED].ravel().astype(BRICK, copy=False)
    return pruned_states(states, kinds)[::-1], kept


def states_by_level(codes: np.ndarray, full: list[np.ndarray]) -> list[np.ndarray]:
    """Return the states of all nodes of an octree, by level from level 1 up.

    codes : ascending codes of the refined level-1 nodes; full : codes of the FULL leaves, for each
    level up to the root's.
    """
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
    return states


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
    refined = distinct(codes >> np.uint64(3))
    states = states_by_level(refined, full or [none] * top)
    bricks = np.zeros(8 * len(refined), BRICK)
    bricks[child_places(codes, refined)] = masks
    return prune(refined, states, bricks, none if collapse else refined)


def child_places(codes: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return the index of each node among the children of the parents; all codes ascend."""
    rank = np.searchsorted(parents, codes >> np.uint64(3))
    return 8 * rank + (codes & np.uint64(7)).astype(np.int64)
