"""The octree of a set as its contract has it, from one that is refined further.

Refined are the nodes that triangles make active, and those whose voxels are not all alike; what
else a fill rule refined on its way is taken back, so that the octree tells the mesh and the set
alone.
"""

from __future__ import annotations

import numpy as np

from voxtool.svo.octree import BRICK, INSIDE, NODE, VALID

EMPTY, FULL, REFINED = range(3)  # states of nodes
ALL_VOXELS = ~np.uint64(0)


def states_of(offsets: np.ndarray, nodes: np.ndarray) -> list[np.ndarray]:
    """The states of the nodes of an octree, as in Octree, by level from level 1 up."""
    child = nodes["child"][: offsets[-2]]
    states = np.where(child & INSIDE, FULL, EMPTY).astype(np.uint8)
    states[(child & VALID) != 0] = REFINED
    return np.split(states, offsets[1:-2])[::-1]


def contract(
    lists: list[np.ndarray], states: list[np.ndarray], bricks: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take back what is refined but neither active nor mixed.

    Parameters
    ----------
    lists : rising Morton codes of the refined nodes of each level, from level 1 up.
    states : of all nodes of these levels.
    bricks : (8 n,) uint64, those of the n refined nodes of level 1.
    active : rising codes of level-1 nodes that stay refined.

    Returns
    -------
    The octree that is left: its offsets, nodes and bricks.
    """
    parts, below = [], np.empty(0, np.uint8)
    for level, (codes, state) in enumerate(zip(lists, states, strict=True), 1):
        if level == 1:
            bricks = bricks.reshape(-1, 8)
            empty, full = (bricks == 0).all(axis=1), (bricks == ALL_VOXELS).all(axis=1)
            stays = np.isin(codes, active, assume_unique=True) | ~(empty | full)
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


def _linked(
    levels: list[np.ndarray], bricks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Link the nodes of the levels above the bricks, given by their states, the root first."""
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
