"""Greedy meshing: coplanar unit squares joined to rectangles, first in rows, then rows in columns.

Squares side by side in a row have sorted keys that rise by one; so have rows of equal beginning and
length in a column. The side of a rectangle may have vertices of others on it: T-junctions.

Kernels: kernels/svo/surface/greedy_meshing.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import compact, exclusive_scan, radix_sort
from voxtool.svo.surface.plan import MAX_SAMPLES

SOURCE = "svo/surface/greedy_meshing.cl"
COORDINATE_BITS = MAX_SAMPLES.bit_length()  # of a corner
SQUARE_BITS, ROW_BITS = 3 + 3 * COORDINATE_BITS, 3 + 4 * COORDINATE_BITS
HEADERS = {"svo/surface/greedy_meshing.h": program.c_constants(COORDINATE_BITS=COORDINATE_BITS)}


def join_squares(device: Device, points: Array, quads: Array, n: int) -> tuple[Array, Array, int]:
    """Return the vertices still in use, (3 V,) int32, the rectangles, (4 R,) uint32, and R, of n
    unit squares, (4 n,) uint32 vertices, the lowest corner first."""
    keys, order = device.empty(n, np.uint64), device.empty(n, np.uint32)
    device.kernel(SOURCE, "key_squares")(n, quads, points, keys, order)
    keys, order = radix_sort(keys, n, SQUARE_BITS, order)
    row_start, rows = _runs(device, keys, n)
    row_keys, row_order = device.empty(rows, np.uint64), device.empty(rows, np.uint32)
    device.kernel(SOURCE, "key_rows")(rows, keys, n, row_start, row_keys, row_order)
    del keys
    row_keys, row_order = radix_sort(row_keys, rows, ROW_BITS, row_order)
    column_start, count = _runs(device, row_keys, rows)

    rectangles = device.empty(4 * count, np.uint32)
    vertices = points.size // 3
    numbers = device.zeros(vertices + 1, np.uint32)
    device.kernel(SOURCE, "join_rows")(
        count, column_start, row_keys, row_order, rows, row_start, order, quads, rectangles, numbers
    )
    kept = device.empty(3 * exclusive_scan(numbers, vertices), np.int32)
    device.kernel(SOURCE, "keep_points")(vertices, points, numbers, kept)
    device.kernel(SOURCE, "renumber")(4 * count, rectangles, numbers)
    return kept, rectangles, count


def _runs(device: Device, keys: Array, n: int) -> tuple[Array, int]:
    """Return the places where runs of keys that rise by one begin, and their number."""
    flags, places = device.empty(n + 1, np.uint32), device.empty(n, np.uint32)
    device.kernel(SOURCE, "flag_runs")(n, keys, flags, places)
    return compact(places, flags, n)
