"""Histogram pyramids against numpy's cumsum and searchsorted, on every device."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Device
from voxtool.opencl.histopyramid import histopyramid, level_groups, pyramid_bytes

pytestmark = pytest.mark.every_driver
ARITIES = (2, 4, 5)
SIZES = sorted({0, 1} | {k**i + d for k in ARITIES for i in (1, 2, 3, 6) for d in (-1, 0, 1)})
WALK = """
#include "opencl/histopyramid.h"
__kernel void find_inputs(const uint n, PYRAMID, const uint run, __global uint2 *found)
{
    const uint gid = get_global_id(0);
    if (gid < n)
        found[gid] = input_of(THIS_PYRAMID, run, gid);
}
"""


def check(device: Device, counts: np.ndarray, arity: int) -> None:
    """Each output of each of the (R, N) runs is found, and the sum before each value."""
    runs, n = counts.shape
    values = device.put(np.append(counts.astype(np.uint32), np.uint32(0xDEADBEEF)))
    built = histopyramid(values, n, runs, arity)
    assert built.sums == counts.sum(axis=1).tolist()
    find_inputs = device.kernel(WALK, "find_inputs", ARITY=arity)
    for run, row in enumerate(counts):
        outputs = np.arange(row.sum())
        found = device.empty(2 * len(outputs), np.uint32)
        find_inputs(len(outputs), run=run, found=found, **built.arguments)
        ends = np.cumsum(row)
        inputs = np.searchsorted(ends, outputs, side="right")
        expected = np.stack([inputs, outputs - (ends - row)[inputs]], axis=1)
        assert np.array_equal(found.get().reshape(-1, 2), expected)
    built.number(values)
    assert np.array_equal(values.get(), np.cumsum([0, *counts.ravel()]))


@pytest.mark.parametrize("arity", ARITIES)
@pytest.mark.parametrize("size", SIZES)
def test_outputs_find_their_inputs_at_the_limits_of_levels(device, size, arity) -> None:
    check(device, np.random.default_rng(size).integers(0, 4, (3, size)), arity)


@pytest.mark.parametrize("arity", ARITIES)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_outputs_of_any_counts_find_their_inputs(device, arity, data) -> None:
    n, runs = data.draw(st.integers(0, 40)), data.draw(st.integers(1, 3))
    row = st.lists(st.one_of(st.just(0), st.integers(0, 50)), min_size=n, max_size=n)
    counts = [data.draw(row) for _ in range(runs)]
    check(device, np.array(counts, int).reshape(runs, n), arity)


@pytest.mark.parametrize("arity", ARITIES)
def test_the_levels_have_the_height_of_the_text(arity: int) -> None:
    for n in range(2, 700):
        groups = level_groups(n, arity)
        assert arity ** (len(groups) - 1) < n <= arity ** len(groups)


def test_five_values_take_the_memory_of_four() -> None:
    n = 5**7
    levels = {k: pyramid_bytes(n, 1, k) - 4 * sum(level_groups(n, k)[:2]) for k in ARITIES}
    assert levels[5] == 4 * (n - 1)  # all levels: less than the values
    assert levels[5] < levels[4] < levels[2]


def test_numbers_beyond_32_bits_are_refused(device: Device) -> None:
    values = device.empty(0, np.uint32)  # it is refused before values are read
    with pytest.raises(MemoryLimitError, match="exceeds 32-bit indices"):
        histopyramid(values, 1 << 29, 2, 4)
