"""Faces of cells, and the cells across them."""

from __future__ import annotations

import numpy as np


def loops(cells: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The faces of cells, the same however a cell sees them: each begins with its smallest vertex
    and goes on to the smaller of the two beside it.

    Returns
    -------
    loops : (T, F, k), as cells.
    reversed : (T, F) bool: the cell has it wound the other way.
    """
    k = faces.shape[1]
    loop = cells[:, faces]
    start = loop.argmin(axis=2)[:, :, None]
    loop = np.take_along_axis(loop, (start + np.arange(k)) % k, axis=2)
    backward = loop[:, :, 1] > loop[:, :, -1]
    loop[backward, 1:] = loop[backward, :0:-1]
    return loop, backward


def match_faces(cells: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, dict[str, int]]:
    """(T, F) int32: the cell across each face, -1 where there is none; and counts of faces.

    Two cells are neighbours where they alone have a face, and on opposite sides.
    """
    loop, backward = loops(cells, faces)
    loop, side = loop.reshape(-1, faces.shape[1]).astype(np.int64), backward.ravel()
    low = loop[:, 0] << 32 | loop[:, 1]
    high = loop[:, 2] << 32 | loop[:, -1]
    order = np.lexsort((high, low))
    new = np.ones(len(order) + 1, bool)
    new[1:-1] = (low[order[1:]] != low[order[:-1]]) | (high[order[1:]] != high[order[:-1]])
    begin = np.flatnonzero(new)
    count = np.diff(begin)
    pair = begin[:-1][count == 2]
    one, other = order[pair], order[pair + 1]
    folded = side[one] == side[other]
    one, other = one[~folded], other[~folded]
    neighbours = np.full(len(loop), -1, np.int32)
    neighbours[one] = other // len(faces)
    neighbours[other] = one // len(faces)
    counts = {
        "non_manifold_faces": int(np.count_nonzero(count > 2)),
        "folded_faces": int(np.count_nonzero(folded)),
    }
    return neighbours.reshape(-1, len(faces)), counts
