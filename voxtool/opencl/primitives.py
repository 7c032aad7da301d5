"""Parallel primitives over device arrays: scan, radix sort, bucket sort, compaction.

Each raises MemoryLimitError if the number of elements does not fit 31 bits. Each has a program of
its own in kernels/opencl, as most work needs one or two.
"""

from __future__ import annotations

from typing import overload

import numpy as np

from voxtool.errors import LESS, MemoryLimitError
from voxtool.opencl import program
from voxtool.opencl.device import Array

SCAN, RADIX_SORT, BUCKET_SORT, COMPACTION = (
    f"opencl/{name}.cl" for name in ("scan", "radix_sort", "bucket_sort", "compaction")
)
GROUP = 256  # work-items of a group that scans
ITEMS = 8  # values of one of them
BLOCK = GROUP * ITEMS  # values that a work-group scans
DIGIT_BITS = 8  # bits of a key that one pass sorts by, at most: by portions
BLOCK_DIGIT_BITS = 4  # and by blocks, whose counts must fit local memory
FEW = 32  # items of a bucket that insertion sort sorts fastest
PORTIONS = 128  # portions of keys for each unit of the device, at most
_KEYS = {np.dtype(np.uint32): "uint", np.dtype(np.uint64): "ulong"}

HEADERS = {
    "opencl/primitives.h": program.c_constants(
        GROUP=GROUP,
        ITEMS=ITEMS,
        DIGIT_BITS=DIGIT_BITS,
        BLOCK_DIGIT_BITS=BLOCK_DIGIT_BITS,
        FEW=FEW,
    )
}


def exclusive_scan(values: Array, n: int) -> int:
    """Replace values[0 .. n-1] by their exclusive prefix sum, values[n] by the sum of all.

    Up- and down-sweep over blocks [voCCeL, section 5.1], in any number of levels. Returns the sum
    of all, for which it waits.

    Parameters
    ----------
    values : uint32, at least n + 1 elements.
    """
    _check(n, "scan")
    _scan(values, n)
    return int(values.get(n, n + 1)[0])


def scan_runs(values: Array, n: int, runs: int) -> list[int]:
    """Replace each of `runs` runs of n values by its exclusive prefix sum, to which the sums of the
    runs before it are added; return the sum of each run. Sums are modulo 2**32. Waits for the
    device.

    Parameters
    ----------
    values : uint32, at least n * runs + 1 elements.
    """
    _check(n * runs, "scan")
    _scan(values, n * runs)
    starts = np.array([values.get(n * i, n * i + 1)[0] for i in range(runs + 1)], np.uint32)
    return np.diff(starts).tolist()


def _check(n: int, what: str) -> None:
    if n >= 1 << 31:
        raise MemoryLimitError(f"a {what} of {n} values exceeds 32-bit indices: {LESS}")


def _scan(values: Array, n: int) -> None:
    device = values.device
    scan_blocks = device.kernel(SCAN, "scan_blocks")
    blocks = n // BLOCK + 1  # one holds element n, the sum
    if blocks == 1:
        scan_blocks(GROUP, values, n, values, values, local=GROUP)
        return
    size = blocks * GROUP
    sums = device.empty(blocks + 1, np.uint32)
    device.kernel(SCAN, "sum_blocks")(size, values, n, sums, local=GROUP)
    _scan(sums, blocks)
    scan_blocks(size, values, n, sums, values, local=GROUP)


@overload
def radix_sort(
    keys: Array, n: int, bits: int, values: None = None, *, blocks: bool | None = None
) -> tuple[Array, None]: ...
@overload
def radix_sort(
    keys: Array, n: int, bits: int, values: Array, *, blocks: bool | None = None
) -> tuple[Array, Array]: ...
def radix_sort(
    keys: Array, n: int, bits: int, values: Array | None = None, *, blocks: bool | None = None
) -> tuple[Array, Array | None]:
    """Sort n keys by their lowest `bits` bits; keys that are equal in these keep their order.

    From the lowest digit to the highest [voCCeL, section 5.1]: the digits of each portion of the
    keys are counted, the counts H(digit, portion) are scanned, and the keys of each portion move,
    in order, to where the scan says. Does not wait for the device.

    Parameters
    ----------
    keys : uint32 or uint64, at least n elements; overwritten.
    bits : 0 to the width of a key.
    values : uint32, at least n elements that go where their keys go; overwritten.
    blocks : a portion is a block of a work-group [Satish 2009], or else it belongs to one
        work-item; by default what suits the device.

    Returns
    -------
    The sorted keys and their values, each of at least n elements.
    """
    _check(n, "sort")
    if not 0 <= bits <= 8 * keys.dtype.itemsize:
        raise ValueError(f"{keys.dtype} has no {bits} bits to sort by")
    if n < 2 or bits == 0:
        return keys, values
    device = keys.device
    by_blocks = device.lanes == 1 if blocks is None else blocks
    sort_digit = _sort_blocks if by_blocks else _sort_portions
    passes = -(-bits // (BLOCK_DIGIT_BITS if by_blocks else DIGIT_BITS))
    width = -(-bits // passes)
    spare = device.empty(n, keys.dtype)
    spare_values = None if values is None else device.empty(n, np.uint32)
    for shift in range(0, bits, width):
        digits = 1 << min(width, bits - shift)
        arrays = {"sorted": spare, "values": values, "sorted_values": spare_values}
        sort_digit(keys, n, arrays, shift=shift, digits=digits)
        keys, spare = spare, keys
        values, spare_values = spare_values, values
    return keys, values


def _sort_portions(
    keys: Array, n: int, arrays: dict[str, Array | None], *, shift: int, digits: int
) -> None:
    """Sort by one digit; a work-item counts and moves the keys of a portion."""
    count, scatter = (
        keys.device.kernel(RADIX_SORT, name, KEY=_KEYS[keys.dtype])
        for name in ("count_digits", "scatter_keys")
    )
    # portions of no fewer keys than there are digits: the table is hardly larger than the keys
    portion = -(-n // min(-(-n >> DIGIT_BITS), PORTIONS * keys.device.info.units))
    portions = -(-n // portion)
    table = keys.device.empty(portions * digits + 1, np.uint32)
    digit = {"keys": keys, "count": n, "portion": portion, "shift": shift, "digits": digits}
    count(portions, counts=table, **digit)
    _scan(table, portions * digits)
    scatter(portions, starts=table, **arrays, **digit)


def _sort_blocks(
    keys: Array, n: int, arrays: dict[str, Array | None], *, shift: int, digits: int
) -> None:
    """Sort by one digit; a work-group counts and moves the keys of a block."""
    count, scatter = (
        keys.device.kernel(RADIX_SORT, name, KEY=_KEYS[keys.dtype], BLOCKS=1)
        for name in ("count_block_digits", "scatter_block_keys")
    )
    blocks = -(-n // BLOCK)
    table = keys.device.empty(blocks * digits + 1, np.uint32)
    digit = {"keys": keys, "count": n, "shift": shift, "digits": digits, "blocks": blocks}
    count(blocks * GROUP, counts=table, local=GROUP, **digit)
    _scan(table, blocks * digits)
    scatter(blocks * GROUP, starts=table, local=GROUP, **arrays, **digit)


def bucket_sort(buckets: Array, keys: Array, n: int, size: int) -> tuple[Array, Array, Array]:
    """Sort n items by their bucket, then by their key; equal ones keep their order.

    Items are counted and moved by atomics, then each bucket is sorted on its own, in time n log n
    at worst. This is faster than radix_sort where buckets are small and items of one bucket are
    near each other. Does not wait for the device.

    Parameters
    ----------
    buckets : uint32, below `size`, at least n elements.
    keys : uint64, at least n elements.

    Returns
    -------
    The end of each bucket in the sorted items (uint32, at least `size` elements; it begins where
    the one before it ends); the sorted keys; and their items (uint32).
    """
    _check(n, "sort")
    _check(size, "sort")
    device = keys.device
    ends = device.zeros(size + 1, np.uint32)
    sorted_keys, items = device.empty(n, np.uint64), device.empty(n, np.uint32)
    device.kernel(BUCKET_SORT, "count_buckets")(n, buckets, ends)
    _scan(ends, size)
    device.kernel(BUCKET_SORT, "fill_buckets")(n, buckets, keys, ends, sorted_keys, items)
    device.kernel(BUCKET_SORT, "sort_buckets")(size, ends, sorted_keys, items)
    return ends, sorted_keys, items


def unique(keys: Array, n: int) -> tuple[Array, int]:
    """Return the distinct keys of n sorted ones (uint32 or uint64), in a new array, and their
    number.

    The last key of each run is kept [voCCeL, section 6.3: uniquify]. Waits for the device.
    """
    _check(n, "compaction")
    flags = keys.device.empty(n + 1, np.uint32)
    keys.device.kernel(COMPACTION, "flag_last", KEY=_KEYS[keys.dtype])(n, keys, flags)
    return compact(keys, flags, n)


def compact(values: Array, flags: Array, n: int) -> tuple[Array, int]:
    """Return the values whose flag is 1, in their order, in a new array, and their number.

    Waits for the device.

    Parameters
    ----------
    values : uint32 or uint64, at least n elements.
    flags : uint32, 0 or 1, at least n + 1 elements; replaced by their exclusive scan, which gives
        each kept value its place.
    """
    total = exclusive_scan(flags, n)
    kept = values.device.empty(total, values.dtype)
    move = values.device.kernel(COMPACTION, "move_flagged", KEY=_KEYS[values.dtype])
    move(n, values, flags, kept)
    return kept, total
