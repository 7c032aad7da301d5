"""Histogram pyramids: counts whose outputs are found by a walk from the top [Dyken 2008].

A level sums 2, 4 or 5 values of the one below, up to a single value, the number of outputs. An
output's work-item finds its value on the way down, in as many steps as there are levels; a scan
would give each value its first output. 4 of 5 values are stored, as the walk needs no fifth
[voCCeL, section 4.1], so the levels hold about as many numbers as there are values.

Kernels: kernels/opencl/histopyramid.cl and, for kernels of outputs, histopyramid.h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.errors import LESS, MemoryLimitError
from voxtool.opencl.device import Array

SOURCE = "opencl/histopyramid.cl"
MOST_STORED = 4  # of the values that one sums


@dataclass(frozen=True)
class Histopyramid:
    """A histogram pyramid over runs of values, on the device.

    Attributes
    ----------
    arity : values that one value above sums.
    sums : the sum of each run, modulo 2**32.
    arguments : those of kernels that walk, by name: PYRAMID in histopyramid.h.
    """

    arity: int
    sums: list[int]
    arguments: dict[str, Any]

    def number(self, starts: Array) -> None:
        """Set what scan_runs leaves in its values: starts[i] is the sum of the values before value
        i of all runs, the last one the sum of all.

        Parameters
        ----------
        starts : uint32, one element more than values.
        """
        kernel = starts.device.kernel(SOURCE, "number_inputs", ARITY=self.arity)
        size = self.arguments["runs"] * self.arguments["inputs"] + 1
        totals = starts.device.put(np.array(self.sums, np.uint32))
        kernel(size, sums=totals, starts=starts, **self.arguments)


def histopyramid(values: Array, n: int, runs: int, arity: int) -> Histopyramid:
    """Return the pyramids of `runs` runs of n values, level by level. Waits for the device. Raises
    MemoryLimitError if numbers of values do not fit 30 bits.

    Parameters
    ----------
    values : uint32, at least n * runs elements; left as they are.
    arity : 2 or more.
    """
    if n * runs >= 1 << 30:
        raise MemoryLimitError(f"a pyramid of {n * runs} values exceeds 32-bit indices: {LESS}")
    device, stored = values.device, min(arity, MOST_STORED)
    groups = level_groups(n, arity)
    places = np.cumsum([0, *(stored * runs * some for some in groups)])
    pyramid = device.empty(int(places[-1]), np.uint32)
    reduce_level = device.kernel(SOURCE, "reduce_level", ARITY=arity)
    count = n
    for some, place in zip(groups, places.tolist(), strict=False):
        sums = device.empty(runs * some, np.uint32)
        reduce_level(runs * some, values, count, some, place, pyramid, sums)
        values, count = sums, some
    levels = np.stack([places[:-1], groups], axis=1).astype(np.uint32)
    arguments = {
        "pyramid": pyramid,
        "levels": device.put(levels),
        "height": len(groups),
        "inputs": n,
        "runs": runs,
    }
    return Histopyramid(arity, values.get(0, runs).tolist(), arguments)


def level_groups(n: int, arity: int) -> list[int]:
    """Return the number of groups of each level over n values, the lowest first, the last one 1."""
    groups = [max(-(-n // arity), 1)]
    while groups[-1] > 1:
        groups.append(-(-groups[-1] // arity))
    return groups


def pyramid_bytes(n: int, runs: int, arity: int) -> int:
    """Return the bytes of the levels of `histopyramid`, and of the sums while it is built."""
    groups = level_groups(n, arity)
    return 4 * runs * (min(arity, MOST_STORED) * sum(groups) + sum(groups[:2]))
