"""Equal subtrees of an octree, stored once ([Kampe 2013]), from its nodes' states and its bricks.

Bottom-up, a level at a time: a refined node is the eight words of its children, and a child's word
says that it is empty or full, or which distinct subtree it is. Pairs of columns of words are ranked
by sorting, then pairs of ranks, then the pair of these: equal nodes get one number, in the
lexicographic order of their words. Ranks are small, so a key and its place share 64 bits.

Cubes that are merged one by one join in the same way: their tables take the place of the nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.prune import ALL_VOXELS

CHILDREN = 8
KEY_BITS = 64
SUBTREE = np.uint32(REFINED)  # the word of distinct subtree 0; EMPTY and FULL are words, too


class Subtrees(NamedTuple):
    """The distinct subtrees of a cube."""

    rows: list[np.ndarray]  # by level from level 1 up, (n, 8) uint32 words, in lexicographic order
    leaves: np.ndarray  # (m,) uint64 bricks that are neither empty nor full, ascending
    root: int  # the word of the root

    @property
    def nbytes(self) -> int:
        """Bytes of the tables."""
        return sum(rows.nbytes for rows in self.rows) + self.leaves.nbytes


def no_subtrees(levels: int, root: int = EMPTY) -> Subtrees:
    """Return those of an empty or full cube with a number of levels above the bricks."""
    return Subtrees([np.empty((0, CHILDREN), np.uint32)] * levels, np.empty(0, np.uint64), root)


def merge(levels: Sequence[np.ndarray], bricks: np.ndarray) -> Subtrees:
    """Return the distinct subtrees of an octree, that is given by the states of the nodes of each
    level, from level 1 up, and its bricks."""
    table, words = merge_bricks(bricks)
    found = []
    for states in levels:
        rows, index = merge_rows(words.reshape(-1, CHILDREN))
        found.append(rows)
        words = states.astype(np.uint32)
        words[states == REFINED] = SUBTREE + index
    return Subtrees(found, table, int(words[0]))


def join(parts: Sequence[Subtrees]) -> Subtrees:
    """Return the distinct subtrees of the cube that consists of eight, in Morton order: a leaf if
    all of them are empty, or full. The rows of the parts are used up, to free their memory."""
    leaves, index = ranked(np.concatenate([part.leaves for part in parts]))
    words = _words_of(index, [len(part.leaves) for part in parts])
    found = []
    for _ in range(len(parts[0].rows)):
        tables = [part.rows.pop(0) for part in parts]
        sizes = list(map(len, tables))
        for i, word in enumerate(words):
            tables[i] = word[tables[i]]
        rows, index = merge_rows(np.concatenate(tables))
        found.append(rows)
        words = _words_of(index, sizes)
    roots = np.array([[word[part.root] for word, part in zip(words, parts, strict=True)]])
    if (roots == EMPTY).all() or (roots == FULL).all():
        return Subtrees([*found, roots[:0]], leaves, int(roots[0, 0]))
    return Subtrees([*found, roots], leaves, int(SUBTREE))


def _words_of(index: np.ndarray, sizes: list[int]) -> list[np.ndarray]:
    """Return for each part the new words by the old ones, (2 + n,) uint32, from the new index of
    each subtree of all parts."""
    leaf = np.array([EMPTY, FULL], np.uint32)
    parts = np.split(SUBTREE + index, np.cumsum(sizes)[:-1])
    return [np.concatenate([leaf, part]) for part in parts]


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
    steps, columns = [], list(words.T)
    while len(columns) > 1:
        ranks = [rank_pairs(*pair) for pair in zip(columns[0::2], columns[1::2], strict=True)]
        steps.append([pairs for pairs, _ in ranks])
        columns = [index for _, index in ranks]
    (rows,) = steps.pop()
    for tables in reversed(steps):
        parts = [pairs[rank] for pairs, rank in zip(tables, rows.T, strict=True)]
        rows = np.concatenate(parts, axis=1)
    return rows, columns[0]


def rank_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of pairs of (n,) uint32 words, (m, 2) uint32 in lexicographic order,
    and the index of each pair among them, (n,) uint32."""
    width = np.uint64(int(second.max(initial=0)).bit_length())
    keys = first.astype(np.uint64)
    keys <<= width
    keys |= second
    values, index = ranked(keys)
    pairs = np.stack([values >> width, values & ~(~np.uint64(0) << width)], axis=1)
    return pairs.astype(np.uint32), index


def ranked(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct ones of (n,) uint64 keys, ascending, and the index of each key among
    them, (n,) uint32."""
    places = np.uint64(len(keys).bit_length())
    if int(keys.max(initial=0)).bit_length() + int(places) <= KEY_BITS:
        # keys and their places in one word: sorting these is several times as fast as argsort
        ascending = keys << places
        ascending |= np.arange(len(keys), dtype=np.uint64)
        ascending.sort()
        order = ascending & ~(~np.uint64(0) << places)
        ascending >>= places
    else:
        order = np.argsort(keys)
        ascending = keys[order]
    first = np.ones(len(keys), bool)
    np.not_equal(ascending[1:], ascending[:-1], out=first[1:])
    index = np.empty(len(keys), np.uint32)
    index[order.view(np.int64)] = np.cumsum(first, dtype=np.uint32) - np.uint32(1)
    return ascending[first], index
