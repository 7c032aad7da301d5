"""Equal subtrees of an octree, stored once ([Kampe 2013]), from its nodes' states and its bricks.

Bottom-up, a level at a time: a refined node is the eight words of its children, and a child's word
says that it is empty or full, or which distinct subtree it is. Pairs of words are ranked by
sorting, then pairs of ranks, then pairs of these: three sorts give equal nodes one number, in the
lexicographic order of their words. Ranks are small, so a key and its place share 64 bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from voxtool.svo.links import EMPTY, FULL, REFINED
from voxtool.svo.prune import ALL_VOXELS

CHILDREN = 8
KEY_BITS = 64
SUBTREE = np.uint32(REFINED)  # the word of distinct subtree 0; EMPTY and FULL are words, too


def merge(
    levels: Sequence[np.ndarray], bricks: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray, int]:
    """Return the distinct subtrees of an octree, that is given by the states of the nodes of each
    level, from level 1 up, and its bricks.

    Returns
    -------
    The words of the distinct refined nodes of each level, (n, 8) uint32 from level 1 up, each level
    in lexicographic order; the distinct bricks that are neither empty nor full, ascending; and the
    word of the root.
    """
    table, words = merge_bricks(bricks)
    found = []
    for states in levels:
        rows, index = merge_rows(words.reshape(-1, CHILDREN))
        found.append(rows)
        words = states.astype(np.uint32)
        words[states == REFINED] = SUBTREE + index
    return found, table, int(words[0])


def merge_bricks(bricks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct bricks that are neither empty nor full, ascending, and the word of each
    brick, (n,) uint32."""
    words = np.where(bricks == 0, np.uint32(EMPTY), np.uint32(FULL))
    mixed = np.flatnonzero((bricks != 0) & (bricks != ALL_VOXELS))
    table, index = ranked(bricks[mixed])
    words[mixed] = SUBTREE + index
    return table, words


def merge_rows(words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of (n, 8) uint32 rows, in lexicographic order, and the index of each
    row among them, (n,) uint32."""
    found, index = [], words
    while index.shape[1] > 1:
        pairs, index = rank_pairs(index)
        found.append(pairs)
    rows = found.pop()
    for pairs in reversed(found):
        rows = pairs[rows].reshape(len(rows), 2 * rows.shape[1])
    return rows, index[:, 0]


def rank_pairs(words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of the pairs of (n, 2 k) uint32 words, (m, 2) uint32 in
    lexicographic order, and the index of each pair among them, (n, k) uint32."""
    width = np.uint64(int(words.max(initial=0)).bit_length())
    keys = (words[:, 0::2].astype(np.uint64) << width) | words[:, 1::2]
    values, index = ranked(keys.ravel())
    pairs = np.stack([values >> width, values & ~(~np.uint64(0) << width)], axis=1)
    return pairs.astype(np.uint32), index.reshape(keys.shape)


def ranked(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of (n,) uint64 keys, ascending, and the index of each key among
    them, (n,) uint32."""
    places = np.uint64(len(keys).bit_length())
    if int(keys.max(initial=0)).bit_length() + int(places) <= KEY_BITS:
        # keys and their places in one word: sorting these is several times as fast as argsort
        both = np.sort((keys << places) | np.arange(len(keys), dtype=np.uint64))
        order, ascending = both & ~(~np.uint64(0) << places), both >> places
    else:
        order = np.argsort(keys)
        ascending = keys[order]
    first = np.ones(len(keys), bool)
    np.not_equal(ascending[1:], ascending[:-1], out=first[1:])
    index = np.empty(len(keys), np.uint32)
    index[order.view(np.int64)] = np.cumsum(first, dtype=np.uint32) - np.uint32(1)
    return ascending[first], index
