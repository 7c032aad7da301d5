"""The cells on both sides of each face.

Kernels: kernels/tets/construction/neighbours.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl.primitives import bucket_sort

if TYPE_CHECKING:
    from voxtool.opencl import Array

SOURCE = "tets/construction/neighbours.cl"
FACES = {4: 4, 8: 6}  # of a cell, by its vertices


def match_faces(
    cells: Array, corners: int, count: int, vertices: int
) -> tuple[Array, dict[str, int]]:
    """Return the cell across each face, int32, -1 where there is none; and counts of faces.

    Two cells are neighbours if no third cell has the face, and they are on opposite sides of it.

    cells : uint32, the `corners` vertices of each of `count` cells; vertices : how many.
    """
    device, n = cells.device, FACES[corners] * count
    buckets, keys = device.empty(n, np.uint32), device.empty(n, np.uint64)
    device.kernel(SOURCE, "key_faces", CORNERS=corners)(n, cells, buckets, keys)
    ends, keys, items = bucket_sort(buckets, keys, n, vertices)
    del buckets
    neighbours, counts = device.empty(n, np.int32), device.zeros(2, np.uint32)
    device.kernel(SOURCE, "match_faces", CORNERS=corners)(
        n, cells, ends, keys, items, neighbours, counts
    )
    non_manifold, folded = counts.get().tolist()
    return neighbours, {"non_manifold_faces": non_manifold, "folded_faces": folded}
