"""Places of the vertices of a field's surface, in sides of the cube.

A vertex begins at the mean of the crossings of its loop. If its leaf has no other loop, and is not
at a side of the cube, it then moves along the gradient of the leaf's interpolation, by Newton's
method, to the surface; it stays within its leaf. Beside a part thinner than leaves (thin.py) no
leaf holds the surface, and it leaves its leaf.
"""

from __future__ import annotations

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import trilinear, trilinear_gradient
from voxtool.adf.surface.dual import Crossings
from voxtool.adf.surface.leaves import CORNERS, Leaves, Vertices
from voxtool.adf.surface.thin import ROUNDING, moved_onto

MARGIN = 2.0**-20  # of the edge, that vertices keep from its ends
CLEAR = (
    2.0**-8
)  # the same of crossings whose nearest triangles are sought, not those around the end
STEPS = 3  # of Newton's method
AT_ONCE = 1 << 14  # vertices that are moved at once, in memory that fits caches


def place_crossings(
    leaves: Leaves, vertices: Vertices, crossings: Crossings, margin: float
) -> np.ndarray:
    """Return where the surface crosses each edge, (c, 3) float64, by linear interpolation, at least
    `margin` edges from its ends.

    A vertex on a side of the cube is outside whatever its value; where its value is inside, the
    crossing is there."""
    low, high = vertices.values[crossings.ends].T
    inside = vertices.inside[crossings.ends]
    t = np.clip(np.divide(low, low - high, out=np.zeros_like(low), where=low != high), 0, 1)
    cut = (vertices.values[crossings.ends] < 0) & ~inside
    t = np.clip(np.where(cut[:, 0], 0.0, np.where(cut[:, 1], 1.0, t)), margin, 1 - margin)
    places = np.ldexp(vertices.places[crossings.ends[:, 0]].astype(np.float64), -leaves.depth)
    rows = np.arange(len(places))
    places[rows, crossings.axes] += np.ldexp(t, -crossings.levels)
    return places


def place_loops(
    field: DistanceField, leaves: Leaves, vertices: Vertices, crossings: Crossings,
    loops: np.ndarray, count: int, places: np.ndarray, offset: np.float32,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the vertices of `count` loops, (count, 3) float64, from the places of the crossings,
    and the leaf of each, (count,) int64.

    The mean is over the leaves around the crossings: a leaf that is twice around one counts it
    twice."""
    each = loops.ravel()
    number = np.bincount(each, minlength=count)
    points = np.stack(
        [np.bincount(each, np.repeat(x, 4), count) / number for x in places.T], axis=1
    )
    of = np.empty(count, np.int64)
    of[each] = crossings.around.ravel()
    alone = np.bincount(of, minlength=len(leaves.codes))[of] == 1
    cells = leaves.cells(of)
    alone &= ((cells > 0) & (cells + 1 < 1 << leaves.levels[of, None])).all(axis=1)
    thin = np.zeros(len(leaves.codes), bool)
    beside = vertices.inside & (vertices.values >= -ROUNDING)
    thin[vertices.leaves] = beside[vertices.corners].any(axis=1)
    for start in range(0, count, AT_ONCE):
        some = slice(start, start + AT_ONCE)
        left = alone[some], thin[of[some]]
        points[some] = _moved(field, leaves, of[some], points[some], *left, offset)
    return points, of


def _moved(
    field: DistanceField, leaves: Leaves, of: np.ndarray, points: np.ndarray, alone: np.ndarray,
    thin: np.ndarray, offset: np.float32,
) -> np.ndarray:  # fmt: skip
    """Return points within leaves: those of leaves with one loop, and all in leaves beside thin
    parts, are moved to the surface."""
    level, blocks = leaves.levels[of], leaves.blocks[of]
    x, y, z = CORNERS[leaves.octants[of]].T
    corners = [field.voxels[blocks, z + k, y + j, x + i] for i, j, k in CORNERS]
    values = np.stack(corners, axis=1).reshape(-1, 2, 2, 2).astype(np.float64) - np.float64(offset)
    low = np.ldexp(leaves.cells(of).astype(np.float64), -level[:, None])
    t = np.clip(np.ldexp(points - low, level[:, None]), MARGIN, 1 - MARGIN)
    for _ in range(STEPS):
        slope = trilinear_gradient(values, t)
        steep = slope[:, 0] * slope[:, 0] + slope[:, 1] * slope[:, 1] + slope[:, 2] * slope[:, 2]
        moving = alone & (steep > 0)
        step = np.divide(trilinear(values, t), steep, out=np.zeros(len(t)), where=moving)
        t = np.clip(t - step[:, None] * slope, MARGIN, 1 - MARGIN)
    if thin.any():
        t[thin] = moved_onto(np.ldexp(values, level[:, None, None, None])[thin], t[thin])
    return low + np.ldexp(t, -level[:, None])
