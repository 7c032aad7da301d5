"""Parallel primitives over device arrays; the kernels are in kernels/opencl/primitives.cl."""

from __future__ import annotations

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.opencl.device import Array

SOURCE = "opencl/primitives.cl"
GROUP = 256
BLOCK = GROUP * 8  # values that a work-group scans


def exclusive_scan(values: Array, n: int) -> int:
    """Replace values[0 .. n-1] by their exclusive prefix sum, values[n] by the sum of all.

    Up- and down-sweep over blocks (the thesis, section 5.1), in any number of levels.

    Parameters
    ----------
    values : uint32, at least n + 1 elements.

    Returns
    -------
    The sum of all; waits for the device.

    Raises
    ------
    MemoryLimitError : n does not fit 31 bits.
    """
    if n >= 1 << 31:
        raise MemoryLimitError(f"a scan of {n} values exceeds 32-bit indices: choose a smaller dim")
    _scan(values, n)
    return int(values.get(n, n + 1)[0])


def _scan(values: Array, n: int) -> None:
    device = values.device
    scan_blocks = device.kernel(SOURCE, "scan_blocks")
    blocks = n // BLOCK + 1  # one holds element n, the sum
    if blocks == 1:
        scan_blocks(GROUP, values, np.uint32(n), values, values, local=GROUP)
        return
    size = blocks * GROUP
    sums = device.empty(blocks + 1, np.uint32)
    device.kernel(SOURCE, "sum_blocks")(size, values, np.uint32(n), sums, local=GROUP)
    _scan(sums, blocks)
    scan_blocks(size, values, np.uint32(n), sums, values, local=GROUP)
    sums.release()
