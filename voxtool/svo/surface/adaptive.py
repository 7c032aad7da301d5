"""A surface with fewer triangles where it is flat: dual contouring on the octree of its cells.

The vertices of the uniform surface lie in the cells of the dual grid, one or a few in each. Cells
are the leaves of an octree, from whose finest level on eight are merged to one. The vertices of a
merged cell that hang together become one vertex, at the best place for the planes of their faces
[Ju 2002, Schaefer 2007]. So flat parts have large cells, and each sheet that passes through a cell
has a vertex of its own there.

**Topology.** Vertices S that hang together are merged only if the faces around them form a disk
whose boundary is one cycle, and all of whose other vertices lie on it. The disk is replaced by the
cone from the new vertex over the same cycle: the new surface is homeomorphic to the old one, so it
stays closed and manifold, with the same shells and handles. The test is that of [Schaefer 2007]
without its assumptions on signs, and the link condition [Dey 1999] of a whole cell in place of an
edge. It counts: of F faces around S, n have one corner in S, whose opposite edges are the rim.

    n >= 3, no two edges of the rim start at one vertex, and F = 2 |S| + n - 2

That is enough. Say that d edges are in the rim twice, once in each direction, and that o vertices
around S are not on it. No vertex but those of S is passed by the boundary of the faces twice, as
its edges are in the rim: the faces are a surface of |S| + n + o vertices, whose boundary has n - 2d
edges. By Euler's formula F = 2 |S| + n + 2 (o + d - chi), so chi = o + d + 1. With a boundary chi
is at most 1: a disk, o = d = 0. Without one it is 2, and n = 2d is 0 or 2.

Corners of a face lie in cells that touch. Cells of a level whose coordinates have one parity are
merged at once, then those of the next of the eight parities: no face touches two of them, so what
is true for each alone is true for all.

**Distance.** Merged vertices are predicted by the root mean square of the distances to their
planes. What is within the tolerance is proved afterwards, in both directions, by the exact
distances of hausdorff.py. Where that fails, the largest cells at the corners of the face are not
merged any more and all is merged again. In the end nothing fails: at the latest where nothing is
merged.

Merging is numpy on the host, in whole numbers and float64 sums of one order; distances are the
same on every device. So the surface is the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from voxtool.mesh.topology import components
from voxtool.morton import distinct
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import faces_beyond
from voxtool.svo.surface.isosurface import LATTICE, LATTICE_BITS, NEAREST, Adaptive, Isosurface
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.opencl import Device

SHARE = 0.5  # of the tolerance, up to which the predicted distance of a vertex may be
STIFFNESS, STEPS = 2.0**-7, 4  # of the pull to where a vertex is, beside that to its planes
PARITIES = np.indices((2, 2, 2)).reshape(3, -1).T
UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)  # rows and columns of a symmetric matrix
HELD = 0  # level of the cells of vertices that are not merged


@dataclass
class _Net:
    """A surface while its cells are merged. A vertex is named by the least of the uniform vertices
    that are merged to it.

    points, faces : (V, 3) int64, (F, 3) int64, as those of an Isosurface.
    planes : (V, 13) float64, for each vertex the sums over the planes of its faces, weighted by
        area, of n n, n (n . p), p . n squared and the points p; in samples, as long as pitches.
    most : (V,) int64, the highest level of a cell in which a vertex may be merged.
    """

    points: np.ndarray
    faces: np.ndarray
    cells: np.ndarray
    planes: np.ndarray
    most: np.ndarray
    pitch: np.ndarray


def adapt(surface: Isosurface, tolerance: float, device: Device) -> Isosurface:
    """Return the surface with cells of different size, no point of which is further from the given
    surface than the tolerance, in world units, nor any of that from it."""
    uniform = surface.mesh()
    to_uniform = TriangleDistance(uniform, device)
    pitch = np.array(surface.grid.pitch)
    start = _net_of(surface, pitch / pitch.max())
    most, reach = start.most, SHARE * tolerance / (pitch.max() * surface.side)
    known: dict[bytes, float] = {}  # distances of faces that are within the tolerance
    rounds = 0
    while True:
        rounds += 1
        net, owner, level = _merged(replace(start, most=most), reach)
        found = _surface_of(surface, net)
        mesh = found.mesh()
        names = [corners.tobytes() for corners in found.points[found.faces]]
        new = np.array([name not in known for name in names])
        there = np.zeros(len(names), bool)
        there[new], far = faces_beyond(mesh, mesh.faces[new], to_uniform, tolerance)
        known |= zip(compress(names, new), far.tolist(), strict=True)
        back, near = faces_beyond(uniform, uniform.faces, TriangleDistance(mesh, device), tolerance)
        wrong = np.concatenate([net.faces[there], owner[start.faces[back]]])
        wrong = wrong[(level[wrong] > HELD).any(axis=1)]  # others are faces of both
        if not len(wrong):
            break
        for name in compress(names, there):
            del known[name]
        most = _split(most, wrong, owner, level)
    furthest = max(float(near.max()), *(known[name] for name in names))
    told = Adaptive(tolerance, len(surface.faces), min(furthest, tolerance), rounds)
    return replace(found, adaptive=told)


def _net_of(surface: Isosurface, pitch: np.ndarray) -> _Net:
    """Return the uniform surface as a net; pitch : (3,), that of its samples, the longest 1."""
    points, faces = surface.points.astype(np.int64), surface.faces.astype(np.int64)
    corners = points[faces] / LATTICE * pitch
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = length(normals)
    normals /= areas[:, None]
    middles = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    offsets = dot(normals, middles)
    squares = normals[:, UPPER[0]] * normals[:, UPPER[1]]
    of_face = np.column_stack([squares, normals * offsets[:, None], offsets * offsets, middles])
    of_face *= areas[:, None]
    planes = np.zeros((len(points), of_face.shape[1]))
    for corner in faces.T:
        planes += _sums(corner, of_face, len(points))
    cells = (points - LATTICE // 2) >> LATTICE_BITS
    return _Net(points, faces, cells, planes, np.full(len(points), 63), pitch)


def _sums(of: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of rows by number, (count, columns), in their order."""
    return np.column_stack([np.bincount(of, column, count) for column in rows.T])


def _merged(net: _Net, reach: float) -> tuple[_Net, np.ndarray, np.ndarray]:
    """Return the net whose cells are merged as far as may be; the vertex to which each uniform one
    is merged, and the level of the cell of that vertex, (V,) int64 each."""
    arrays = {name: getattr(net, name).copy() for name in ("points", "faces", "planes", "most")}
    net = replace(net, **arrays)
    owner = np.arange(len(net.points))
    at = np.full(len(owner), HELD)
    span = int((net.cells.max(axis=0) - net.cells.min(axis=0)).max(initial=0))
    for level in range(1, span.bit_length() + 1):
        before = len(net.faces)
        for parity in PARITIES:
            merged, into = _merge_parity(net, level, parity, reach)
            if len(merged):
                to = np.arange(len(owner))
                to[merged] = into
                owner, at[into] = to[owner], level
        if len(net.faces) == before:
            break
    return net, owner, at


def _merge_parity(
    net: _Net, level: int, parity: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Merge the cells of a level that have a parity, and return the vertices that are merged and
    those to which each is."""
    cells = net.cells >> level
    x, y, z = ((cells & 1) == parity).T
    chosen = x & y & z & (net.most >= level)
    u, v = net.faces.ravel(), np.roll(net.faces, -1, axis=1).ravel()
    linked = np.flatnonzero(chosen[u] & chosen[v])
    u, v = u[linked], v[linked]
    linked = (cells[u] == cells[v]).all(axis=1)
    u, v = u[linked], v[linked]
    if not len(u):
        return u, v
    members = distinct(np.concatenate([u, v]))
    number = np.full(len(chosen), -1)
    number[members] = np.arange(len(members))
    roots = components(number[u], number[v], len(members))
    firsts, group = np.unique(roots, return_inverse=True)
    number[members] = group
    placed = _placed(net, members, group, len(firsts), level, reach)
    return _contract(net, members, group, number, placed)


def _placed(
    net: _Net, members: np.ndarray, group: np.ndarray, groups: int, level: int, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the places of the vertices of groups of members, (groups, 3) int64, in their cells;
    the sums of their planes, and whether these are within reach."""
    planes = _sums(group, net.planes[members], groups)
    a, weight = planes[:, :6], planes[:, 0] + planes[:, 3] + planes[:, 5]
    pull = STIFFNESS * weight
    xx, xy, xz, yy, yz, zz = a.T
    xx, yy, zz = xx + pull, yy + pull, zz + pull
    # the adjugate of a symmetric matrix
    cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    dy, dz, ez = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * cx + xy * cy + xz * cz
    rows = np.stack([cx, cy, cz, cy, dy, dz, cz, dz, ez], axis=1).reshape(-1, 3, 3)
    best = planes[:, 10:] / weight[:, None]
    for _ in range(STEPS):
        b = planes[:, 6:9] + pull[:, None] * best
        best = np.stack([dot(rows[:, i], b) for i in range(3)], axis=1) / determinant[:, None]
    lows = np.empty((groups, 3), np.int64)
    lows[group] = (net.cells[members] >> level << level) * LATTICE + LATTICE // 2
    places = np.rint(best / net.pitch * LATTICE).astype(np.int64)
    places = np.clip(places, lows + NEAREST, lows + (LATTICE << level) - NEAREST)
    at = places / LATTICE * net.pitch
    away = planes[:, 9] - 2 * dot(at, planes[:, 6:9])
    for k, (i, j) in enumerate(zip(*UPPER, strict=True)):
        away += (1 if i == j else 2) * a[:, k] * at[:, i] * at[:, j]
    return places, planes, away <= reach * reach * weight


def _contract(
    net: _Net,
    members: np.ndarray,
    group: np.ndarray,
    number: np.ndarray,
    placed: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Contract the groups that are disks to a vertex each; return as _merge_parity."""
    places, planes, fits = placed
    groups, faces = len(fits), net.faces
    of = number[faces]
    a, b, c = (of >= 0).T
    near = np.flatnonzero(a | b | c)
    of = of[near]
    within = np.count_nonzero(of >= 0, axis=1)
    owner = of.max(axis=1)
    turn = np.where(within == 1, of.argmax(axis=1), of.argmin(axis=1))  # the corner that is alone
    turned = faces[near][np.arange(len(near))[:, None], (turn[:, None] + np.arange(3)) % 3]
    one = within == 1
    apex, a, b = turned[one].T
    rim = owner[one]

    edges = np.bincount(rim, minlength=groups)
    sizes, disks = np.bincount(group, minlength=groups), np.bincount(owner, minlength=groups)
    fits = fits & (edges >= 3) & (disks == 2 * sizes + edges - 2)
    starts = distinct(rim * len(number) + a) // len(number)
    fits &= np.bincount(starts, minlength=groups) == edges
    fits[rim[_turns_over(net, apex, places[rim], a, b)]] = False

    firsts = np.full(groups, len(number))
    np.minimum.at(firsts, group, members)
    merged = fits[group]
    members, group = members[merged], group[merged]
    into = firsts[group]
    kept = members == into
    net.points[into[kept]] = places[group[kept]]
    net.planes[into[kept]] = planes[group[kept]]
    np.minimum.at(net.most, into, net.most[members])
    gone = near[fits[owner] & (within > 1)]
    changed = near[fits[owner] & one]
    to = np.arange(len(number))
    to[members] = into
    net.faces[changed] = to[faces[changed]]
    net.faces = np.delete(net.faces, gone, axis=0)
    return members, into


def _turns_over(
    net: _Net, apex: np.ndarray, places: np.ndarray, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Return which faces look the other way, or have no area, once their apex is in its place."""
    edge, p = net.points[b] - net.points[a], net.points[a]
    before, after = (cross(edge, top - p) for top in (net.points[apex], places))
    scaled = [side / net.pitch for side in (before, after)]
    return dot(*scaled) <= 0


def _split(most: np.ndarray, wrong: np.ndarray, owner: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the highest levels at which vertices may be merged where the largest cells at the
    corners of wrong faces, (n, 3) vertices, are split."""
    levels = level[wrong]
    largest = levels == levels.max(axis=1, keepdims=True)
    allowed = np.full(len(most), 63)
    np.minimum.at(allowed, wrong[largest], levels[largest] - 1)
    return np.minimum(most, allowed[owner])


def _surface_of(surface: Isosurface, net: _Net) -> Isosurface:
    """Return the surface of a net, whose vertices keep the order of the uniform ones."""
    used = np.zeros(len(net.points), bool)
    used[net.faces] = True
    number = np.cumsum(used) - 1
    return replace(
        surface,
        points=net.points[used].astype(np.int32),
        faces=number[net.faces].astype(np.int32),
    )
