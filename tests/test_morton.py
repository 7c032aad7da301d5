"""Morton codes against their definition, and steps against coordinates."""

from __future__ import annotations

from itertools import product

import numpy as np

from voxtool.morton import among, morton_box, morton_decode, morton_encode, morton_step


def test_a_code_interleaves_bits() -> None:
    cells = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (3, 1, 2), (2**21 - 1,) * 3])
    assert morton_encode(cells).tolist() == [1, 2, 4, 0b101011, 2**63 - 1]
    assert np.array_equal(morton_decode(morton_encode(cells)), cells)


def test_steps_are_those_of_coordinates() -> None:
    for side in (1, 2, 8, 2**21):
        cells = np.array([0, 1, side // 2, max(side - 2, 0), side - 1])[:, None] % side
        cells = cells + np.zeros(3, np.int64)
        cells[:, 1] = cells[::-1, 1]
        for axis, step in product(range(3), (-side, -3, -1, 0, 1, 3, side)):
            moved, within = morton_step(morton_encode(cells), axis, step, side)
            expected = cells + step * np.eye(3, dtype=np.int64)[axis]
            inside = ((expected >= 0) & (expected < side)).all(axis=1)
            assert np.array_equal(within, inside), (side, axis, step)
            assert np.array_equal(morton_decode(moved[within]), expected[inside])


def test_the_box_around_cells() -> None:
    random = np.random.default_rng(3)
    for top in (1, 2, 100, 1 << 21):
        cells = random.integers(0, top, (50, 3))
        low, high = morton_box(morton_encode(cells))
        assert np.array_equal(low, cells.min(axis=0))
        assert np.array_equal(high, cells.max(axis=0))


def test_membership() -> None:
    values = np.array([5, 0, 9, 3, 7], np.uint64)
    assert among(np.array([3, 5, 8], np.uint64), values).tolist() == [
        True,
        False,
        False,
        True,
        False,
    ]
    assert not among(values[:0], values).any()
