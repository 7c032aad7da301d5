"""The words of tiles near a surface against dense arrays."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.octree import octree_from_dense

from voxtool.morton import morton_decode
from voxtool.svo.surface.samples import WORD_LEVELS, Sampling, grow_tree
from voxtool.svo.surface.words import NOWHERE, WORD_MULTIPLIER, find_words

WORD = 16  # voxels along a side
EMPTY, FULL, REFINED = 1, 2, 4


def leaves(seed: int) -> np.ndarray:
    """Return large full and empty boxes, with few voxels between them."""
    random = np.random.default_rng(seed)
    dense = np.kron(random.random((4, 4, 4)) < 0.4, np.ones((64,) * 3, bool))
    dense[tuple(random.integers(0, 256, (3, 3 * seed)))] ^= True
    return dense


@pytest.mark.parametrize("seed", range(3))
def test_words_are_those_with_unlike_nodes_around(seed: int) -> None:
    dense = leaves(seed)
    tree = grow_tree(octree_from_dense(dense), Sampling.of("voxel", 0.5))
    words = find_words(tree, WORD_LEVELS - 2)
    side = (4 << tree.top) // WORD
    shares = dense.reshape(16, WORD, 16, WORD, 16, WORD).mean(axis=(1, 3, 5))
    states = np.select([shares == 0, shares == 1], [EMPTY, FULL], REFINED)
    shift = tree.shift // WORD
    around = np.pad(states, [(shift, side - shift - 16)] * 3, constant_values=EMPTY)
    own = np.pad(around, 1, constant_values=EMPTY)
    for axis in range(3):
        around = np.stack([np.roll(own, step, axis) for step in (-1, 0, 1)])
        own = np.bitwise_or.reduce(around)
    matter = own[1:-1, 1:-1, 1:-1] > FULL
    assert 100 < len(words.codes) < matter.size // 4
    cells = morton_decode(words.codes)
    assert np.array_equal(np.sort(words.codes), words.codes)
    assert np.array_equal(np.unique(cells, axis=0), np.argwhere(matter))
    held = np.pad(states, [(shift, side - shift - 16)] * 3, constant_values=EMPTY)[tuple(cells.T)]
    assert np.array_equal(words.inside != 0, held == FULL)
    assert np.array_equal(words.refined, words.codes[held == REFINED])


def test_every_word_is_found_in_the_table() -> None:
    dense = leaves(2)
    words = find_words(grow_tree(octree_from_dense(dense), Sampling.of("voxel", 0.5)), 2)
    places, shift = words.table()
    first = (words.codes * WORD_MULTIPLIER >> np.uint64(shift)).astype(int)
    steps = 0
    for number, at in enumerate(first.tolist()):
        while places[at] != number:
            assert places[at] != NOWHERE
            at = (at + 1) % len(places)
            steps += 1
    assert steps < len(first)
    assert np.count_nonzero(places != NOWHERE) == len(words.codes)
