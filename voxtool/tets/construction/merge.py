"""Merging of points at one position, or within a distance of each other.

Kernels: kernels/tets/construction/merge.cl.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.mesh.topology import components
from voxtool.opencl.primitives import bucket_sort
from voxtool.tets.volume.mesh import VolumeCells, check_finite
from voxtool.vector import dot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.opencl import Device

SOURCE = "tets/construction/merge.cl"
MAX_PAIRS = 1 << 27  # pairs of points that are compared
PAIRS = 1 << 22  # pairs that are compared at a time


@dataclass(frozen=True, eq=False)
class MergedPoints:
    """The points that cells use.

    points : (P, 3) float64; scalars : (P,) float64, or one a cell.
    numbers : uint32: for each point of the mesh, the number of the point that it became; undefined
        for those that no cell uses.
    report : counts of what was found and done: JSON types only.
    """

    points: np.ndarray
    scalars: np.ndarray
    numbers: np.ndarray
    report: dict[str, Any]


def merged_points(
    device: Device, found: VolumeCells, merge_distance: float, max_pairs: int = MAX_PAIRS
) -> MergedPoints:
    """Return the points that cells use. Points at one position (-0.0 equals 0.0), or within the
    merge distance directly or through others, become the first of them.

    merge_distance : world units; max_pairs : pairs of points that are compared at most.

    Raises
    ------
    MeshError : a point or a scalar is not finite.
    VoxtoolError : the distance is not a length.
    MemoryLimitError : more than max_pairs pairs would be compared.
    """
    if not 0 <= merge_distance < math.inf:
        raise VoxtoolError(f"a merge distance of {merge_distance:g}: give a length from 0 on")
    points, scalars = found.points, found.scalars
    used = np.zeros(len(points), bool)
    for _, block in found.blocks:
        used[block.ravel()] = True
    check_finite(found.name, points, used, "point", "the position")
    if not found.constant:
        check_finite(found.name, scalars, used, "point", found.scalar)
        scalars = scalars[used]
    points = points[used]
    first = first_at_place(device, points)
    if merge_distance > 0:
        first = first_within(points, first, merge_distance, max_pairs)
    other = 0 if found.constant else int(np.count_nonzero(scalars != scalars[first]))
    report = {
        **found.report,
        "points": len(points),
        "merged_points": int(np.count_nonzero(first != np.arange(len(points)))),
        "merged_scalars": other,
    }
    numbers = np.zeros(len(used), np.uint32)
    numbers[used] = first
    return MergedPoints(points, scalars, numbers, report)


def first_at_place(device: Device, points: np.ndarray) -> np.ndarray:
    """Return the number of the first point at the position of each, (P,) int64; -0.0 equals 0.0."""
    count = len(points)
    bits = count.bit_length()  # about as many buckets as points
    at = device.put(points)
    buckets, keys = device.empty(count, np.uint32), device.empty(count, np.uint64)
    device.kernel(SOURCE, "key_points")(count, at, 64 - bits, buckets, keys)
    _, keys, items = bucket_sort(buckets, keys, count, 1 << bits)
    first = device.empty(count, np.uint32)
    device.kernel(SOURCE, "first_points")(count, at, keys, items, first)
    return first.take().astype(np.int64)


def first_within(
    points: np.ndarray, first: np.ndarray, distance: float, max_pairs: int = MAX_PAIRS
) -> np.ndarray:
    """Return the number of the first point of each chain of points at most `distance` apart, (P,)
    int64."""
    kept = np.flatnonzero(first == np.arange(len(points)))
    low = points[kept].min(axis=0)
    side = max(distance, float((points[kept].max(axis=0) - low).max()) * 2.0**-20)
    x, y, z = ((points[kept] - low) / side).astype(np.int64).T
    key = x << 42 | y << 21 | z
    order = np.argsort(key, kind="stable")
    key, sorted_points = key[order], points[kept][order]
    ones, others, pairs = [], [], 0
    for step in _FORWARD:
        begin = np.searchsorted(key, key + step, "left")
        if step == 0:
            begin = np.arange(1, len(key) + 1)
        count = np.searchsorted(key, key + step, "right") - begin
        pairs += int(count.sum())
        if pairs > max_pairs:
            raise MemoryLimitError(
                f"a merge distance of {distance:g} compares more than {max_pairs:,} pairs of "
                f"{len(kept):,} points: choose a smaller one"
            )
        for a, b in _expanded(begin, count):
            d = (sorted_points[a] - sorted_points[b]) / distance
            near = dot(d, d) <= 1
            ones.append(order[a[near]])
            others.append(order[b[near]])
    label = components(np.concatenate(ones), np.concatenate(others), len(kept))
    number = np.cumsum(first == np.arange(len(points))) - 1
    return kept[label][number[first]]


# Differences of the keys of a cell of the grid and of those that follow it; its own is first.
_FORWARD = [0] + [
    (dx << 42) + (dy << 21) + dz
    for dx in (-1, 0, 1)
    for dy in (-1, 0, 1)
    for dz in (-1, 0, 1)
    if (dx, dy, dz) > (0, 0, 0)
]


def _expanded(begin: np.ndarray, count: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of each i with begin[i], ..., begin[i] + count[i] - 1, some PAIRS at a time."""
    ends = np.cumsum(count)
    start = 0
    while start < len(count):
        done = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, done + PAIRS, "right")), start + 1)
        n = count[start:stop]
        a = np.repeat(np.arange(start, stop), n)
        b = np.arange(len(a)) - np.repeat(ends[start:stop] - n - done, n) + begin[a]
        yield a, b
        start = stop
