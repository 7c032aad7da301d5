"""The cells of an octree: which matter, and what lies around each, against the dense array."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from voxtool.svo.cells.subtrees import AROUND, Cells, groups_of
from voxtool.svo.octree.octree import Octree


def blocks_of_voxels(seed: int) -> np.ndarray:
    """Return voxels with large full and empty blocks, some of them at the low sides."""
    random = np.random.default_rng(seed)
    coarse = random.random((8, 6, 5)) < (0.1, 0.5, 0.9)[seed]
    dense = np.kron(coarse, np.ones((8, 8, 8), bool))[:-1]
    return dense ^ (random.random(dense.shape) < (0, 0.01, 0.001)[seed])


@pytest.mark.parametrize("side", [8, 16, 64])
@pytest.mark.parametrize("seed", range(3))
def test_what_lies_around_a_cell(seed: int, side: int) -> None:
    dense = blocks_of_voxels(seed)
    octree = Octree.from_dense(dense)
    cells, margin = Cells(octree, side), 7
    end = octree.grid.side
    whole = np.zeros((end + 5 * side,) * 3, bool)  # from two cells below the octree on
    whole[tuple(slice(2 * side, 2 * side + n) for n in dense.shape)] = dense
    mixed = cells.mixed()
    assert (np.diff(cells.keys(mixed).astype(np.int64)) > 0).all()
    listed = set(map(tuple, mixed.tolist()))
    near = slice(side - margin, 2 * side + margin)
    for cell in product(range(-1, end // side), repeat=3):
        begin = [(c + 1) * side for c in cell]
        around = whole[tuple(slice(a, a + AROUND * side) for a in begin)]
        if cell not in listed:  # all is alike in and beside it
            own = around[(slice(side - 1, 2 * side + 1),) * 3]
            assert own.all() or not own.any()
        elif len(listed) < 50 or sum(cell) % 4 == 0:
            octree = cells.around(np.array(cell), margin)
            octree.validate()
            np.testing.assert_array_equal(
                octree.to_dense()[near, near, near], around[near, near, near]
            )


def test_groups_are_read_in_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("voxtool.svo.cells.subtrees.GAP", 16)
    array = np.arange(1000)
    starts = np.array([0, 8, 24, 400, 16, 960])
    expected = (starts[:, None] + np.arange(8)).ravel()
    np.testing.assert_array_equal(groups_of(array, starts), expected)
    assert not len(groups_of(array, starts[:0]))
