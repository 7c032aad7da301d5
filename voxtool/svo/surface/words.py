"""The words of tiles that the surface of an octree may touch, found from its root down.

A word is a bit for each of 4 x 4 x 4 tiles, so it is a node of the octree or lies in a leaf. A node
matters if one of the 27 nodes of its size around it is refined, or if there are full and empty
nodes among them. Those that matter are among the children of those that matter one level above, so
time and memory follow the content and not the grid: a neighbour that is not among them has the same
state as the node itself.

The words are found again, on the device, by hashing with linear probing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from voxtool.morton import AXIS, among, morton_step
from voxtool.opencl import program
from voxtool.svo.octree.layout import LINK, descend
from voxtool.svo.octree.links import FULL, REFINED, states_of
from voxtool.svo.surface.samples import Tree

NOWHERE = np.uint32(0xFFFFFFFF)  # a place that holds no word
WORD_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # 2**64 by the golden ratio: Fibonacci hashing
HEADERS = {
    "svo/surface/words.h": program.c_constants(NOWHERE=NOWHERE, WORD_MULTIPLIER=WORD_MULTIPLIER)
}


class Words(NamedTuple):
    """Words of tiles of an octree.

    codes : (n,) uint64 Morton codes, ascending.
    inside : (n,) uint64, all bits of those that lie in inside leaves, none of the others.
    refined : (m,) uint64 codes of those that are refined nodes: all such nodes of their level.
    """

    codes: np.ndarray
    inside: np.ndarray
    refined: np.ndarray

    def table(self) -> tuple[np.ndarray, int]:
        """Return the places of the words in a hash table, a power of two of uint32, and by how many
        bits their products with WORD_MULTIPLIER are shifted to give the first place to look at."""
        bits = (2 * len(self.codes) + 1).bit_length()
        shift = np.uint64(64 - bits)
        places = np.full(1 << bits, NOWHERE)
        at = (self.codes * WORD_MULTIPLIER >> shift).astype(np.int64)
        left = np.arange(len(at), dtype=np.uint32)
        while len(left):
            free = left[places[at[left]] == NOWHERE]
            places[at[free]] = free  # of several, one is placed
            left = left[places[at[left]] != left]
            at[left] = (at[left] + 1) % len(places)
        return places, int(shift)


def find_words(tree: Tree, level: int, every: bool = False) -> Words:
    """Return the words near which the surface may be, whose nodes are of a level; or, if `every`,
    all words of the root."""
    codes, child = np.zeros(1, np.uint64), tree.nodes["child"][:1]
    for number in range(tree.top - 1, level - 1, -1):
        refined = np.flatnonzero(states_of(child) == REFINED)
        links = tree.first(number) + (child[refined] & LINK).astype(np.int64)
        below = np.repeat(child[:, None], 8, axis=1)
        below[refined] = tree.nodes["child"][links[:, None] + np.arange(8)]
        near = np.ones(below.shape, bool)
        if not every:
            near = _matter(codes, states_of(below), 1 << (tree.top - number - 1))
        codes, child = descend(codes)[near.ravel()], below[near]
    states = states_of(child)
    inside = np.where(states == FULL, ~np.uint64(0), np.uint64(0))
    return Words(codes, inside, codes[states == REFINED])


def _matter(codes: np.ndarray, states: np.ndarray, side: int) -> np.ndarray:
    """Return which nodes matter, (n, 8) bool, the children of (n,) nodes that do, in a root of
    `side` of these a side, around which all is empty."""
    around = np.uint8(1) << states
    for axis in range(3):
        low, high = np.moveaxis(around.reshape(-1, 2, 2, 2), 3 - axis, 0)
        above, within = morton_step(codes, axis, 1, side)
        nodes = np.flatnonzero(within & among(codes, above))
        upper = np.searchsorted(codes, above[nodes])
        beyond_low, beyond_high = np.zeros_like(low), np.zeros_like(high)
        beyond_low[codes & (AXIS << np.uint64(axis)) == 0] = 1  # empty
        beyond_high[~within] = 1
        beyond_low[upper], beyond_high[nodes] = high[nodes], low[upper]
        both = low | high
        low[...], high[...] = both | beyond_low, both | beyond_high
    return around > 2  # refined, or full and empty
