"""The polygons dual to the leaves of a field: a closed 2-manifold, whatever the values.

An edge of a leaf is *minimal* if no smaller leaf has a vertex within it. Where one of its ends is
inside and the other is not, it has a *crossing*. The face between two leaves is that of the smaller
one; its boundary is a loop of minimal edges, with an even number of crossings. Along the loop,
inside vertices between two crossings are cut off by a segment between these two: insides that only
touch at a face are separated.

A crossing in the boundary of a leaf lies on two of the leaf's faces. Hence the segments in the
boundary of a leaf form closed loops. Each loop is a vertex of the mesh, each segment an edge
between the loops of two leaves, and each crossing a polygon of the loops of the three or four
leaves around it. So an edge has the polygons of its two crossings, and the polygons around a vertex
are one cycle.

Two things could break this when polygons become triangles that know their vertices by number:

- Several segments may join the same two loops. Two leaves share one face, so this happens in a face
  with four or more crossings only. Each such segment but the first gets a vertex in the face, and
  the polygons that it bounds are fans around a vertex at their crossing.
- A diagonal may occur twice. Leaves opposite each other at a crossing share no face, so a diagonal
  is no segment. They share the edge alone if one of them has all of it, and then no other
  polygon has both. So the diagonal ends in a leaf of the smallest size; if both could, the
  shorter one is taken.

Two triangles with the same three vertices would share two edges and a diagonal, or be polygons of
three leaves that have only one minimal edge in common. Neither is possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.surface.leaves import CORNERS, Leaves, Vertices
from voxtool.mesh.topology import components
from voxtool.morton import distinct, morton_encode

if TYPE_CHECKING:
    from voxtool.adf.surface.sharp import Features

# Around an edge, counter-clockwise seen from its high end: leaves 0 to 3, by their sides along the
# two axes that follow the edge's; the face after each of them has the normal NORMALS (0: the first
# of the two axes) and leaf HIGH on its high side.
QUADRANTS = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
NORMALS = np.array([0, 1, 0, 1])
HIGH = np.array([1, 2, 2, 3])
LOW = np.array([0, 1, 3, 0])
NEXT = np.array([1, 2, 3, 0])
PLACE_BITS = 24  # bits of a place along the boundary of a face


@dataclass(frozen=True)
class Crossings:
    """The minimal edges that the surface crosses.

    ends : (c, 2) int64, the vertices at their low and high ends; axes : (c,) int64; levels : (c,)
    int64; around : (c, 4) int64, the leaves.
    """

    ends: np.ndarray
    axes: np.ndarray
    levels: np.ndarray
    around: np.ndarray


@dataclass(frozen=True)
class Segments:
    """Segments in which the surface crosses the faces between leaves.

    first, second : (s, 2) int64, the crossings at their ends, and the face's place around each.
    crowded : (s,) bool, whether the face has several segments.
    """

    first: np.ndarray
    second: np.ndarray
    crowded: np.ndarray


def find_crossings(leaves: Leaves, vertices: Vertices) -> Crossings:
    """Return the crossings, in the order of their ends."""
    corners, inside, count = vertices.corners, vertices.inside, len(vertices.inside)
    keys = []
    signs = inside[corners]
    for axis in range(3):
        low = np.flatnonzero(CORNERS[:, axis] == 0)
        crossed, corner = np.nonzero(signs[:, low] != signs[:, low + (1 << axis)])
        start = corners[crossed, low[corner]]
        keys.append(start * count + corners[crossed, low[corner] + (1 << axis)])
    ends = np.stack(np.divmod(distinct(np.concatenate(keys)), max(count, 1)), axis=1)
    low = vertices.places[ends[:, 0]]
    along = vertices.places[ends[:, 1]] - low
    axes, sizes = along.argmax(axis=1), along.max(axis=1, initial=0)
    levels = leaves.depth - (np.frexp(sizes.astype(np.float64))[1].astype(np.int64) - 1)
    around = np.empty((len(ends), 4), np.int64)
    rows = np.arange(len(ends))
    for quadrant, sides in enumerate(QUADRANTS):
        cell = low.copy()
        for other, side in enumerate(sides, 1):
            cell[rows, (axes + other) % 3] -= sizes * (1 - side)
        around[:, quadrant] = leaves.at(morton_encode(cell))
    minimal = (leaves.levels[around] <= levels[:, None]).all(axis=1)
    return Crossings(ends[minimal], axes[minimal], levels[minimal], around[minimal])


def find_segments(leaves: Leaves, vertices: Vertices, crossings: Crossings) -> Segments:
    """Return the segments, in the order of their faces."""
    around, axes = crossings.around, crossings.axes
    crossing, turn = np.nonzero(around != around[:, NEXT])
    normal = (axes[crossing] + 1 + NORMALS[turn]) % 3
    pair = around[crossing, turn], around[crossing, NEXT[turn]]
    level = np.maximum(leaves.levels[pair[0]], leaves.levels[pair[1]])
    shift = leaves.depth - level
    rows = np.arange(len(crossing))
    low = vertices.places[crossings.ends[crossing, 0]]
    size = 1 << leaves.depth - crossings.levels[crossing]
    cell = low.copy()  # of the high side of the face, at the edge
    for other in (1, 2):
        cell[rows, (axes[crossing] + other) % 3] -= size * (1 - QUADRANTS[HIGH[turn], other - 1])
    cell >>= shift[:, None]
    face = (morton_encode(cell) | np.uint64(1) << (3 * level).astype(np.uint64)) * np.uint64(
        3
    ) + normal.astype(np.uint64)

    # the place along the boundary of the face, counter-clockwise from its low corner, and whether
    # the surface is entered there
    corner = cell << shift[:, None]
    p, q = (normal + 1) % 3, (normal + 2) % 3
    along_p = axes[crossing] == p
    up, across = (low[rows, a] - corner[rows, a] for a in (p, q))
    far = np.where(along_p, across > 0, up == 0)  # runs against the axis
    step, whole = np.where(along_p, up, across), np.int64(1) << shift
    side = np.where(along_p, 2 * far, 1 + 2 * far)
    place = side * (whole + 1) + np.where(far, whole - step, step)
    entering = vertices.inside[crossings.ends[crossing, 1]] ^ far

    order = np.lexsort((place, face))
    face, entering = face[order], entering[order]
    begins = np.diff(face, prepend=~face[:1]) != 0
    start = np.flatnonzero(begins)
    group = np.cumsum(begins) - 1
    sizes = np.diff(np.append(start, len(face)))
    first = np.flatnonzero(entering)
    last = (start + sizes - 1)[group[first]]
    second = np.where(first == last, start[group[first]], first + 1)
    ends = np.stack([crossing, turn], axis=1)[order]
    return Segments(ends[first], ends[second], sizes[group[first]] > 2)


def find_loops(crossings: Crossings, segments: Segments) -> tuple[np.ndarray, int]:
    """Return the loop of each leaf around each crossing, (c, 4) int64, and the number of loops."""
    around = crossings.around
    links = [
        [4 * ends[:, 0] + side[ends[:, 1]] for ends in (segments.first, segments.second)]
        for side in (LOW, HIGH)
    ]
    crossing, turn = np.nonzero(around == around[:, NEXT])
    links.append([4 * crossing + turn, 4 * crossing + NEXT[turn]])
    u, v = (np.concatenate(ends) for ends in zip(*links, strict=True))
    root = components(u, v, around.size)
    least = root == np.arange(around.size)
    return (np.cumsum(least) - 1)[root].reshape(-1, 4), int(np.count_nonzero(least))


def doubled(segments: Segments, loops: np.ndarray) -> np.ndarray:
    """Return the segments that join the same two loops as one before them, ascending."""
    some = np.flatnonzero(segments.crowded)
    crossing, turn = segments.first[some].T
    pairs = np.stack([loops[crossing, LOW[turn]], loops[crossing, HIGH[turn]]], axis=1)
    once = np.unique(pairs, axis=0, return_index=True)[1]
    return np.delete(some, once)


def triangles_of(
    leaves: Leaves, crossings: Crossings, loops: np.ndarray, extra: np.ndarray,
    lowest_inside: np.ndarray, points: np.ndarray, features: Features | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the triangles, (f, 3) int64, and the crossings that are vertices, numbered on from the
    (v, 3) points.

    extra : (c, 4) int64, the vertex of the segment in the face after each leaf, or -1.
    lowest_inside : (c,) bool, whether the low end of each edge is inside; features : along which
    quadrilaterals are split, where either diagonal may be taken; the shorter one without.
    """
    around = crossings.around
    same = around == around[:, NEXT]
    fanned = (extra >= 0).any(axis=1)
    three = same.any(axis=1) & ~fanned
    four = ~same.any(axis=1) & ~fanned
    found, of = [], []

    # of the two leaves that are one, the second is left out
    rest = NEXT[same[three].argmax(axis=1)]
    turns = (rest[:, None] + np.arange(1, 4)) % 4
    found.append(np.take_along_axis(loops[three], turns, 1)[:, None])
    of.append(np.flatnonzero(three))

    a, b, c, d = loops[four].T
    smallest = leaves.levels[around[four]] == crossings.levels[four, None]
    even, odd = smallest[:, 0] | smallest[:, 2], smallest[:, 1] | smallest[:, 3]
    better = _squares(points[a] - points[c]) <= _squares(points[b] - points[d])
    if features:
        better = features.along(loops[four], better)
    chosen = (even & (better | ~odd))[:, None, None]
    one = np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 2, 3)
    other = np.stack([a, b, d, b, c, d], axis=1).reshape(-1, 2, 3)
    found.append(np.where(chosen, one, other))
    of.append(np.flatnonzero(four))

    centred = np.flatnonzero(fanned)
    fans, fan_of = _fans(centred, same, loops, extra, len(points))
    every = np.concatenate([*(part.reshape(-1, 3) for part in found), fans])
    owner = np.concatenate([of[0], np.repeat(of[1], 2), fan_of])
    flipped = ~lowest_inside[owner]
    every[flipped] = every[flipped][:, ::-1]
    return every[np.argsort(owner, kind="stable")], centred


def _fans(
    centred: np.ndarray, same: np.ndarray, loops: np.ndarray, extra: np.ndarray, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles around the crossings `centred`, numbered from `first`, and the crossing
    of each."""
    found, of = [], []
    for turn in range(4):
        sides = ~same[centred, turn]
        centre, crossing = first + np.flatnonzero(sides), centred[sides]
        start, end = loops[crossing, turn], loops[crossing, NEXT[turn]]
        middle = extra[crossing, turn]
        parted = middle >= 0
        for begin, to, which in (
            (start, np.where(parted, middle, end), np.ones(len(centre), bool)),
            (middle, end, parted),
        ):
            found.append(np.stack([centre, begin, to], axis=1)[which])
            of.append(crossing[which])
    return np.concatenate(found), np.concatenate(of)


def _squares(v: np.ndarray) -> np.ndarray:
    return v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1] + v[:, 2] * v[:, 2]
