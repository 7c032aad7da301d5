"""Merging of points: those at one place, and those within a distance of each other."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.tets.mesh import VolumeCells, check_finite
from voxtool.vector import dot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.tets.mesh import UnstructuredMesh

MAX_PAIRS = 1 << 27  # pairs of points that are compared
PAIRS = 1 << 22  # pairs that are compared at a time


def merged_cells(
    mesh: UnstructuredMesh,
    found: VolumeCells,
    merge_distance: float,
    max_pairs: int = MAX_PAIRS,
) -> VolumeCells:
    """The volume cells with the points that they use, coincident points merged.

    Parameters
    ----------
    found : the mesh's volume cells.
    merge_distance : points this near become one, world units; 0 merges those at one place.
    max_pairs : pairs of points, beyond which the work is refused.

    Raises
    ------
    MeshError : a point or a scalar that is not finite.
    VoxtoolError : a distance that is none.
    MemoryLimitError : more than max_pairs points to be compared.
    """
    where = mesh.name or "mesh"
    if not 0 <= merge_distance < math.inf:
        raise VoxtoolError(f"a merge distance of {merge_distance:g}: give a length from 0 on")
    points, blocks, scalars, report = found.points, found.blocks, found.scalars, {**found.report}
    used = np.zeros(len(points), bool)
    for _, block in blocks:
        used[block.ravel()] = True
    number = np.cumsum(used) - 1
    check_finite(where, points, used, "point", "the position")
    if not mesh.constant:
        check_finite(where, scalars, used, "point", mesh.scalar)
        scalars = scalars[used]
    points = points[used]
    first = first_at_place(points)
    if merge_distance > 0:
        first = first_within(points, first, merge_distance, max_pairs)
    merged = first != np.arange(len(points))
    report["points"] = len(points)
    report["merged_points"] = int(np.count_nonzero(merged))
    report["merged_scalars"] = 0
    if not mesh.constant:
        report["merged_scalars"] = int(np.count_nonzero(scalars != scalars[first]))
    blocks = [(kind, first[number[block]]) for kind, block in blocks]
    return VolumeCells(points, blocks, scalars, report)


def first_at_place(points: np.ndarray) -> np.ndarray:
    """Return the first point at the position of each, (P,) int64; -0.0 equals 0.0."""
    order = np.lexsort(points.T)  # stable, so the first of a run comes first
    new = np.ones(len(order), bool)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first = np.empty(len(points), np.int64)
    first[order] = order[np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))]
    return first


def first_within(
    points: np.ndarray, first: np.ndarray, distance: float, max_pairs: int = MAX_PAIRS
) -> np.ndarray:
    """(P,) int64: the first point of each chain of points no further than `distance` apart."""
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
    label = _components(len(kept), np.concatenate(ones), np.concatenate(others))
    number = np.cumsum(first == np.arange(len(points))) - 1
    return kept[label][number[first]]


# Of a cell of the grid those that follow it, itself first, as differences of their keys.
_FORWARD = [0] + [
    (dx << 42) + (dy << 21) + dz
    for dx in (-1, 0, 1)
    for dy in (-1, 0, 1)
    for dz in (-1, 0, 1)
    if (dx, dy, dz) > (0, 0, 0)
]


def _expanded(begin: np.ndarray, count: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Each i with begin[i], ..., begin[i] + count[i] - 1, a bounded number at a time."""
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


def _components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(count,) int64: the least number that each is joined to by pairs (a, b)."""
    label = np.arange(count)
    while True:
        low, high = np.minimum(label[a], label[b]), np.maximum(label[a], label[b])
        if np.array_equal(low, high):
            return label
        np.minimum.at(label, high, low)
        while not np.array_equal(label[label], label):
            label = label[label]
