"""The parallel primitives against numpy, on every device."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import (
    BLOCK,
    DIGIT_BITS,
    FEW,
    GROUP,
    PORTIONS,
    bucket_sort,
    compact,
    exclusive_scan,
    radix_sort,
    scan_runs,
    unique,
)

pytestmark = pytest.mark.every_driver
TWO_LEVELS = BLOCK * BLOCK  # from here on, the sums of blocks are scanned in blocks


# ---- scan


def check(device: Device, values: np.ndarray, room: int = 0) -> None:
    """Scan, and compare all n + 1 results; what lies beyond is left alone."""
    n = len(values)
    beyond = np.full(1 + room, 0xDEADBEEF, np.uint32)
    array = device.put(np.concatenate([values.astype(np.uint32), beyond]))
    total = exclusive_scan(array, n)
    found = array.get()
    expected = np.concatenate([[0], np.cumsum(values, dtype=np.uint64)])
    assert expected[-1] < 1 << 32
    assert total == expected[-1]
    assert np.array_equal(found[: n + 1], expected)
    assert np.array_equal(found[n + 1 :], beyond[1:])


SIZES = sorted(
    {0, 1, 2, 3, 1001, 1_000_003}
    | {k * limit + d for limit in (GROUP, BLOCK) for k in (1, 3) for d in (-1, 0, 1)}
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


def test_scan_and_sort_again_and_again_are_the_same(device: Device) -> None:
    values = np.random.default_rng(2).integers(0, 100, 300_001).astype(np.uint32)
    keys = random_keys(300_001, np.uint64)
    results = []
    for _ in range(5):
        array = device.put(values)
        exclusive_scan(array, len(values) - 1)
        order, _ = radix_sort(device.put(keys), len(keys), 20)
        results.append((array.get(), order.get()))
    assert all(
        np.array_equal(*pair) for run in results for pair in zip(run, results[0], strict=True)
    )


@pytest.mark.parametrize("size", [0, 1, GROUP, BLOCK + 1])
def test_scan_of_runs_adds_the_runs_before(device: Device, size: int) -> None:
    values = np.random.default_rng(size).integers(0, 1 << 32, (3, size), np.uint32)
    array = device.put(np.append(values, np.uint32(7)))
    sums = scan_runs(array, size, 3)
    assert sums == values.sum(axis=1, dtype=np.uint32).tolist()  # modulo 2**32
    assert np.array_equal(array.get()[1:], np.cumsum(values.ravel(), dtype=np.uint32))


# ---- radix sort


def check_sort(device: Device, keys: np.ndarray, bits: int, room: int = 0) -> None:
    """Sort without and with values, which are the keys' numbers: they show what was stable. Once by
    portions of work-items, as on CPUs, and once by blocks of work-groups, as on GPUs."""
    n = len(keys)
    order = np.argsort(keys & keys.dtype.type((1 << bits) - 1), kind="stable")
    padding = np.zeros(room, np.uint32)
    every = np.concatenate([np.arange(n, dtype=np.uint32), padding])
    for numbers, blocks in product((None, every), (False, True)):
        array = device.put(np.concatenate([keys, padding.astype(keys.dtype)]))
        values = None if numbers is None else device.put(numbers)
        found, found_values = radix_sort(array, n, bits, values, blocks=blocks)
        assert found.dtype == keys.dtype
        assert np.array_equal(found.get(0, n), keys[order])
        assert (found_values is None) == (numbers is None)
        if found_values is not None:
            assert np.array_equal(found_values.get(0, n), order)


KEYS = [np.uint32, np.uint64]
DIGITS = 1 << DIGIT_BITS
SORT_SIZES = sorted(
    {0, 1, 2, 3, 1001, 100_003} | {k * DIGITS + d for k in (1, 2, 65) for d in (-1, 0, 1)}
)


def random_keys(size: int, dtype: type, seed: int = 1) -> np.ndarray:
    """Keys of all bits."""
    return np.random.default_rng(seed).integers(0, 1 << 8 * dtype().nbytes, size, dtype=dtype)


@pytest.mark.parametrize("dtype", KEYS)
@pytest.mark.parametrize("size", SORT_SIZES)
def test_sort_at_the_limits_of_portions(device: Device, size: int, dtype: type) -> None:
    check_sort(device, random_keys(size, dtype), 8 * dtype().nbytes)
    check_sort(device, random_keys(size, dtype), 11, room=5)


@pytest.mark.parametrize("past", [-1, 0, 1])
def test_sort_where_portions_begin_to_grow(device: Device, past: int) -> None:
    size = DIGITS * PORTIONS * device.info.units + past
    check_sort(device, random_keys(size, np.uint32), 16)


@pytest.mark.parametrize("bits", [0, 1, 8, 9, 17, 32, 33, 42, 64])
@pytest.mark.parametrize("dtype", KEYS)
def test_sort_by_the_lowest_bits_alone(device: Device, bits: int, dtype: type) -> None:
    keys = random_keys(5003, dtype)
    if bits <= 8 * dtype().nbytes:
        check_sort(device, keys, bits)
        check_sort(device, keys >> dtype(8 * dtype().nbytes - max(bits, 1)), bits)
        return
    array = device.put(keys)
    with pytest.raises(ValueError, match=f"uint32 has no {bits} bits to sort by"):
        radix_sort(array, len(keys), bits)


@pytest.mark.parametrize("dtype", KEYS)
def test_sort_of_keys_in_special_orders(device: Device, dtype: type) -> None:
    bits, size = 8 * dtype().nbytes, 10_007
    rising = np.sort(random_keys(size, dtype))
    low = random_keys(size, dtype) & dtype(3)
    greatest = np.full(size, (1 << bits) - 1, dtype)
    one = greatest.copy()
    one[size // 2] = 0
    orders = (rising, rising[::-1], np.zeros(size, dtype), greatest, one)
    for keys in (*orders, low, low << dtype(bits - 2), np.arange(size, dtype=dtype) % dtype(3)):
        check_sort(device, np.ascontiguousarray(keys), bits)


def test_sort_of_several_million(device: Device) -> None:
    check_sort(device, random_keys(3_000_017, np.uint64) >> np.uint64(22), 42)


@given(st.lists(st.integers(0, (1 << 64) - 1), max_size=1000), st.integers(0, 64))
@settings(max_examples=30)
def test_sort_of_anything(device: Device, keys: list[int], bits: int) -> None:
    check_sort(device, np.array(keys, np.uint64), bits)
    check_sort(device, np.array(keys, np.uint64).astype(np.uint32), bits // 2)


# ---- compaction


def taken(kept: tuple[Array, int]) -> np.ndarray:
    """Exactly the values that there are."""
    array, count = kept
    assert array.size == count
    return array.take()


COMPACT_SIZES = [0, 1, 63, 64, 65, BLOCK - 1, BLOCK, BLOCK + 1, 100_003]


@pytest.mark.parametrize("dtype", KEYS)
@pytest.mark.parametrize("size", COMPACT_SIZES)
def test_compact_keeps_the_flagged_in_order(device: Device, size: int, dtype: type) -> None:
    values = random_keys(size, dtype)
    random = np.random.default_rng(size).integers(0, 2, size)
    for flags in (random, np.zeros(size, int), np.ones(size, int)):
        array = device.put(values)
        scanned = device.put(np.append(flags, 0xDEADBEEF).astype(np.uint32))
        assert np.array_equal(taken(compact(array, scanned, size)), values[flags == 1])
        assert np.array_equal(scanned.get(), np.append(0, np.cumsum(flags)))


@pytest.mark.parametrize("dtype", KEYS)
@pytest.mark.parametrize("size", COMPACT_SIZES)
def test_unique_keeps_each_once(device: Device, size: int, dtype: type) -> None:
    few = np.sort(random_keys(size, dtype) % dtype(max(size // 3, 1)))
    high = few << dtype(8 * dtype().nbytes - 20)
    for keys in (few, np.sort(high), np.arange(size, dtype=dtype), np.full(size, 7, dtype)):
        array = device.put(np.append(keys, dtype(7)))  # the last is not looked at
        assert np.array_equal(taken(unique(array, size)), np.unique(keys))
        assert np.array_equal(array.get(0, size), keys)


@given(st.lists(st.integers(0, 50), max_size=300))
@settings(max_examples=30)
def test_sort_and_unique_of_anything(device: Device, keys: list[int]) -> None:
    array, _ = radix_sort(device.put(np.array(keys, np.uint64)), len(keys), 6)
    assert taken(unique(array, len(keys))).tolist() == sorted(set(keys))


# ---- limits


def test_what_exceeds_31_bits_is_refused(device: Device) -> None:
    array = device.empty(1, np.uint32)
    for refused in (
        lambda: exclusive_scan(array, 1 << 31),
        lambda: radix_sort(array, 1 << 31, 32),
        lambda: unique(array, 1 << 31),
        lambda: compact(array, array, 1 << 31),
    ):
        with pytest.raises(MemoryLimitError, match="choose a smaller dim"):
            refused()


# ---- bucket sort


@pytest.mark.parametrize("items", [1, 2, FEW, FEW + 1, 3 * FEW, 1000])
def test_items_are_sorted_by_bucket_then_key_then_place(device: Device, items: int) -> None:
    """Every second bucket is empty, others hold about `items`; among few keys, many are equal."""
    rng, n, size = np.random.default_rng(items), 3001, max(3000 // items, 1)
    buckets = 2 * rng.integers(0, size, n).astype(np.uint32)
    for keys in (rng.integers(0, 7, n), rng.integers(0, 1 << 63, n), -np.arange(n)):
        keys = keys.astype(np.uint64)
        ends, found, order = bucket_sort(device.put(buckets), device.put(keys), n, 2 * size)
        expected = np.lexsort((keys, buckets))
        assert np.array_equal(order.get(), expected)
        assert np.array_equal(found.get(), keys[expected])
        assert np.array_equal(
            ends.get(0, 2 * size), np.cumsum(np.bincount(buckets, minlength=2 * size))
        )
