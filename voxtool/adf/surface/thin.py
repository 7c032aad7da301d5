"""Parts of a field that are thinner than its smallest leaves, kept in one piece.

The vertices of leaves inside a sheet or rod thinner than a leaf are few, and far apart. So vertices
beside it count as inside, too: those that are nearer to the surface than REACH edges, unless the
field falls by REACH edges from there to a vertex that is a step of one edge along each axis away.
Beside a thick part it does: in one of the eight directions the distance to a plane falls by an edge
or more. In a sheet of thickness t its least value is -t/2, so the vertices within REACH
edges of the sheet's middle are inside. Each point of the middle is within sqrt(3)/2 edges of its
nearest vertex, and where the nearest vertex changes, the two are ends of an edge. So a part in one
piece has inside vertices in one piece.

At the sharp edge of a part, a few vertices may be inside alone, with no inside vertex at the other
end of an edge. They are joined to the innermost corner of the leaves around them, along the edges.
If those have none, vertices outside the mesh are outside again.

The surface around them is then moved towards the part's own sides, along the gradient of the field.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from voxtool.adf.construction.stages import BLOCK
from voxtool.adf.field.cells import cell_of
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import trilinear, trilinear_gradient
from voxtool.mesh.topology import components
from voxtool.morton import morton_encode

ROUNDING = np.float32(2.0**-40)  # sides: exceeds that of distances in a cube
REACH = 0.9  # edges, more than sqrt(3)/2
STEPS = np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1  # along all axes
FLAT = (
    0.9  # of a slope: between two sides of a sheet it is less, and says nothing of where they are
)
SPECK = 8  # vertices
AROUND = (np.indices((5, 5, 5)).reshape(3, -1).T - 2) @ (1, 1 << 21, 1 << 42)  # of keys: 2 edges
KEPT = 1 / 16  # edges from the surface, so that two sides do not pass through each other


def beside_thin(field: DistanceField, offset: np.float32) -> np.ndarray:
    """Return which vertices of blocks are beside parts thinner than leaves, (n, 3, 3, 3) bool;
    offset: that of the surface, in sides."""
    found = np.zeros(field.voxels.shape, bool)
    levels, cells = cell_of(field.blocks)
    deepest = np.flatnonzero(levels == field.depth - 1)
    fall = np.float32(REACH * math.ldexp(1.0, -field.depth))
    values = field.voxels[deepest] - offset
    near = (values >= -ROUNDING) & (values < fall)
    for step in STEPS:  # as far as the block itself tells
        from_, to = (tuple(slice(*ends) for ends in _overlap(s)) for s in (step[::-1], -step[::-1]))
        near[:, *from_] &= values[:, *to] > values[:, *from_] - fall
    block, vertex = np.nonzero(near.reshape(len(deepest), 27))
    places = 2 * cells[deepest[block]] + BLOCK[:, vertex].T
    _, first, copies = np.unique(morton_encode(places), return_index=True, return_inverse=True)
    value = values.reshape(-1, 27)[block[first], vertex[first]]
    edge = math.ldexp(field.side, -field.depth)
    beside = np.array(field.origin) + edge * (places[first][:, None] + STEPS)
    around = field.query(beside.reshape(-1, 3)).distance.reshape(-1, 8) / field.side - offset
    alone = around.min(axis=1, initial=np.inf) > value - fall
    found.reshape(-1, 27)[deepest[block], vertex] = alone[copies.ravel()]
    return found


def _overlap(step: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the end of the vertices of a block that have another a step away."""
    return [(max(-s, 0), 3 - max(s, 0)) for s in step.tolist()]


def join_specks(
    corners: np.ndarray,
    deepest: np.ndarray,
    keys: np.ndarray,
    values: np.ndarray,
    inside: np.ndarray,
) -> None:
    """Add to the vertices that are inside, (v,) bool, those that join pieces of up to SPECK
    vertices to others; take away pieces that nothing joins, none of whose vertices is in the mesh,
    within two edges of others.

    corners : (n, 8) int64, the vertices of leaves; deepest : (n,) bool, those of the smallest
    leaves; keys : (v,) int64, rising, such that that of the middle of two vertices is the mean;
    values : (v,) float64.
    """
    around, first, last = corners[deepest], [], []
    for corner, bit in itertools.product(range(8), (1, 2, 4)):
        if corner & bit:
            continue
        low, high = corners[:, corner], corners[:, corner | bit]
        middle = (keys[low] + keys[high]) >> 1
        cut = ~deepest & (keys[np.minimum(np.searchsorted(keys, middle), len(keys) - 1)] == middle)
        first.append(low[~cut])
        last.append(high[~cut])
    low, high = np.concatenate(first), np.concatenate(last)
    for _ in range(3):
        both = inside[low] & inside[high]
        piece = components(low[both], high[both], len(inside))
        small = np.bincount(piece, minlength=len(inside))[piece] <= SPECK
        leaf, corner = np.nonzero((small & inside)[around])
        rows, own = np.arange(len(leaf)), around[leaf]
        other = inside[own] & (piece[own] != piece[own[rows, corner]][:, None])
        depths = np.where(other, values[own], np.inf)
        innermost = depths.argmin(axis=1)
        least = depths[rows, innermost]
        name = piece[own[rows, corner]]
        order = np.lexsort((values[own[rows, corner]], least, name))
        chosen = order[(np.diff(name[order], prepend=-1) != 0) & np.isfinite(least[order])]
        if not len(chosen):
            break
        own, at, left = own[chosen], corner[chosen], (corner ^ innermost)[chosen]
        for _ in range(2):  # two corners of a leaf are up to three edges apart
            ways = np.stack([at ^ bit for bit in (1, 2, 4)], axis=1)
            costs = np.take_along_axis(values[own], ways, 1)
            bit = 1 << np.where(left[:, None] & [1, 2, 4], costs, np.inf).argmin(axis=1)
            going = left & (left - 1) != 0  # not yet beside it
            at, left = np.where(going, at ^ bit, at), np.where(going, left ^ bit, left)
            inside[own[np.arange(len(own)), at]] = True
    both = inside[low] & inside[high]
    piece = components(low[both], high[both], len(inside))
    least = np.full(len(inside), np.inf)
    np.minimum.at(least, piece[inside], values[inside])
    small = np.bincount(piece, minlength=len(inside))[piece] <= SPECK
    alone = np.flatnonzero(small & inside & (least[piece] >= 0))
    beside = keys[alone, None] + AROUND
    at = np.minimum(np.searchsorted(keys, beside), len(keys) - 1)
    others = (keys[at] == beside) & inside[at] & (piece[at] != piece[alone, None])
    near = np.zeros(len(inside), bool)
    near[piece[alone[others.any(axis=1)]]] = True
    inside[alone[near[piece[alone]]]] = False


def moved_onto(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return where points lead along the gradient to the surface, (n, 3), in edges of their leaves,
    from these (n, 3) places in them and the values less the offset at their corners, (n, 2, 2, 2),
    in edges; a point whose leaf lies on both sides of a sheet stays."""
    slope = trilinear_gradient(values, t)
    steep = slope[:, 0] * slope[:, 0] + slope[:, 1] * slope[:, 1] + slope[:, 2] * slope[:, 2]
    far = np.maximum(trilinear(values, t) - KEPT, 0) * (steep > FLAT * FLAT)
    return t - (far / np.sqrt(np.maximum(steep, FLAT * FLAT)))[:, None] * slope
