"""Coplanar unit quads joined to rectangles: first in rows, then equal rows in columns.

By sorting: quads that lie side by side in a row have keys that rise by one, and so have rows of
equal beginning and length. A rectangle's side may have vertices of others on it: T-junctions.

Kernels: kernels/svo/surface/greedy_meshing.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import compact, exclusive_scan, radix_sort
from voxtool.svo.surface.plan import MAX_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Callable

SOURCE = "svo/surface/greedy_meshing.cl"
FIELD = MAX_SAMPLES.bit_length()  # bits of a coordinate of a corner
QUAD_BITS, ROW_BITS = 3 + 3 * FIELD, 3 + 4 * FIELD
HEADERS = {"svo/surface/greedy_meshing.h": program.c_constants(FIELD=FIELD)}


def join_rectangles(
    device: Device, points: Array, quads: Array, n: int
) -> tuple[Array, Array, int]:
    """The points that still serve, (3 V,) int32, the rectangles, (4 R,) uint32, and how many.

    Parameters
    ----------
    points : (3 V,) int32 on the corners of samples; quads : (4 n,) uint32, unit squares, of which
        the lowest corner comes first. Both are consumed.
    """

    def kernel(name: str) -> Callable[..., None]:
        return device.kernel(SOURCE, name)

    keys, order = device.empty(n, np.uint64), device.empty(n, np.uint32)
    kernel("key_quads")(n, quads, np.uint32(n), points, keys, order)
    keys, order = radix_sort(keys, n, QUAD_BITS, order)
    row_start, rows = _runs(device, keys, n)
    row_keys, row_order = device.empty(rows, np.uint64), device.empty(rows, np.uint32)
    kernel("key_rows")(rows, keys, np.uint32(n), row_start, np.uint32(rows), row_keys, row_order)
    row_keys, row_order = radix_sort(row_keys, rows, ROW_BITS, row_order)
    column_start, count = _runs(device, row_keys, rows)

    rectangles = device.empty(4 * count, np.uint32)
    vertices = points.size // 3
    numbers = device.zeros(vertices + 1, np.uint32)
    kernel("join_rows")(
        count, column_start, np.uint32(count), row_keys, row_order, np.uint32(rows), row_start,
        order, quads, rectangles, numbers,
    )  # fmt: skip
    kept = device.empty(3 * exclusive_scan(numbers, vertices), np.int32)
    kernel("keep_points")(vertices, points, numbers, np.uint32(vertices), kept)
    kernel("renumber")(4 * count, rectangles, np.uint32(4 * count), numbers)
    for array in (keys, order, row_start, row_keys, row_order, column_start, numbers):
        array.release()
    points.release()
    quads.release()
    return kept, rectangles, count


def _runs(device: Device, keys: Array, n: int) -> tuple[Array, int]:
    """Where runs of keys that rise by one begin, and how many there are."""
    flags, places = device.empty(n + 1, np.uint32), device.empty(n, np.uint32)
    device.kernel(SOURCE, "flag_rows")(n, keys, np.uint32(n), flags, places)
    starts, count = compact(places, flags, n)
    flags.release()
    places.release()
    return starts, count
