"""The parallel primitives against numpy, on every device."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Device
from voxtool.opencl.primitives import BLOCK, GROUP, exclusive_scan

TWO_LEVELS = BLOCK * BLOCK  # from here on, the sums of blocks are scanned in blocks


def check(device: Device, values: np.ndarray, room: int = 0) -> None:
    """Scan, and compare all n + 1 results; what lies beyond is left alone."""
    n = len(values)
    beyond = np.full(1 + room, 0xDEADBEEF, np.uint32)
    array = device.put(np.concatenate([values.astype(np.uint32), beyond]))
    total = exclusive_scan(array, n)
    found = array.get()
    array.release()
    expected = np.concatenate([[0], np.cumsum(values, dtype=np.uint64)])
    assert expected[-1] < 1 << 32
    assert total == expected[-1]
    assert np.array_equal(found[: n + 1], expected)
    assert np.array_equal(found[n + 1 :], beyond[1:])


SIZES = sorted(
    {0, 1, 2, 3, 7, 1001, 65_537, 1_000_003}
    | {2**k + d for k in (3, 5, 8, 10, 11, 12, 16, 20) for d in (-1, 0, 1)}
    | {k * limit + d for limit in (GROUP, BLOCK) for k in (1, 2, 3) for d in (-1, 0, 1)}
    | {TWO_LEVELS + d for d in (-BLOCK, -1, 0, 1, BLOCK)}
)


@pytest.mark.parametrize("size", SIZES)
def test_scan_at_block_limits(device: Device, size: int) -> None:
    rng = np.random.default_rng(size)
    check(device, rng.integers(0, 8, size))
    check(device, rng.integers(0, 2, size), room=5)


@pytest.mark.parametrize("size", [1, GROUP, BLOCK, BLOCK + 1, 100_000])
def test_scan_of_equal_values(device: Device, size: int) -> None:
    for value in (0, 1, 0xFFFFFFFF // size):
        check(device, np.full(size, value))


@pytest.mark.parametrize("place", [0, 1, BLOCK - 1, BLOCK, 3 * BLOCK - 1])
def test_scan_of_one_large_value(device: Device, place: int) -> None:
    values = np.zeros(3 * BLOCK, np.uint32)
    values[place] = 0xFFFFFFFF
    check(device, values)


def test_scan_of_several_million(device: Device) -> None:
    size = TWO_LEVELS + 1_234_567
    check(device, np.random.default_rng(1).integers(0, 0xFFFFFFFF // size, size, endpoint=True))


@given(st.lists(st.integers(0, 1 << 20), max_size=3000))
@settings(max_examples=30)
def test_scan_of_anything(device: Device, values: list[int]) -> None:
    check(device, np.array(values, np.uint32))


def test_scan_again_and_again_is_the_same(device: Device) -> None:
    values = np.random.default_rng(2).integers(0, 100, 300_001).astype(np.uint32)
    results = []
    for _ in range(5):
        array = device.put(values)
        exclusive_scan(array, len(values) - 1)
        results.append(array.get())
        array.release()
    assert all(np.array_equal(results[0], r) for r in results[1:])


def test_scan_beyond_31_bits_is_refused(device: Device) -> None:
    array = device.empty(1, np.uint32)
    with pytest.raises(MemoryLimitError, match="choose a smaller dim"):
        exclusive_scan(array, 1 << 31)
    array.release()
