"""Cells of any kind to tetrahedra whose faces match, in float64: merge, split, drop, turn, pair.

Coincident points become one. Hexahedra, wedges and pyramids are split so that a quadrilateral that
two cells share is cut along the same diagonal, the one from its smallest vertex number (Dompierre,
Labbé, Vallet, Camarero: How to subdivide pyramids, prisms and hexahedra into tetrahedra, 8th
International Meshing Roundtable, 1999). Which side of a plane a vertex is on is decided exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MemoryLimitError, MeshError, VoxtoolError, count_of
from voxtool.tets.volume import HEXAHEDRON_FACES, PLANAR, TETRAHEDRON_FACES
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from collections.abc import Iterator

# Of each kind of cell the faces, outward wound, with vertices as VTK numbers them.
CELL_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": TETRAHEDRON_FACES,
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": HEXAHEDRON_FACES,
}
CORNERS = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
FLAT = ("vertex", "line", "triangle", "quad", "polygon", "pixel")  # and their curved forms

MAX_COUNT = (1 << 31) - 1  # cells, and vertices: indices are int32
FLATTEST = 1e-14  # 6 |V| by the cube of the longest edge
SMALLEST = 2.0**-40  # longest edge by the mesh's longest side
ROUNDING = 8 * 2.0**-53  # of a determinant of differences, by the sum of its terms' sizes
MAX_PAIRS = 1 << 27  # of points that are compared
PAIRS = 1 << 22  # of these at a time


@dataclass(frozen=True, eq=False)
class UnstructuredMesh:
    """Cells of several kinds with a scalar, as a file has them.

    points : (P, 3) float64, world units.
    cells : of each block its kind, as meshio names it (tetra, hexahedron, wedge, pyramid, tetra10,
        ...), and (N, k) int64, the points of each cell as VTK numbers them.
    scalars : (P,) float64, one a point; or a list of (N,), one for each cell of each block.
    scalar : what they are called, with the component ("momentum magnitude").
    source_sha256, name, units : hex digest of the file, its name for messages, the world unit; "".
    """

    points: np.ndarray
    cells: list[tuple[str, np.ndarray]]
    scalars: np.ndarray | list[np.ndarray]
    scalar: str
    source_sha256: str = ""
    name: str = ""
    units: str = ""

    @property
    def constant(self) -> bool:
        """Whether the scalar is one a cell."""
        return isinstance(self.scalars, list)


@dataclass(frozen=True, eq=False)
class ConformingMesh:
    """Cells of one kind, positively oriented, none flat, none twice, matched across their faces.

    vertices : (V, 3) float64, world units; each is in a cell.
    cells : (T, 4) int32, tetrahedra; or (T, 8), hexahedra.
    neighbours : (T, 4 or 6) int32: the cell across each face, -1 where there is none.
    scalars : (V,) float64, or (T,) where the mesh is constant.
    constant : whether the scalar is one a cell.
    scalar, source_sha256, name, units : as in UnstructuredMesh.
    report : counts of what was found and done: JSON types only.
    """

    vertices: np.ndarray
    cells: np.ndarray
    neighbours: np.ndarray
    scalars: np.ndarray
    constant: bool
    scalar: str
    source_sha256: str = ""
    name: str = ""
    units: str = ""
    report: dict[str, Any] = field(default_factory=dict)


@dataclass
class _Found:
    """What the file's mesh comes to before its cells are made what the layout wants.

    points : (U, 3) float64: those that volume cells use, in the file's order.
    blocks : of each kind in turn, (N, k) int64, corners, with merged points' numbers.
    scalars : (U,) or, where the mesh is constant, one a cell of these blocks; float64.
    """

    points: np.ndarray
    blocks: list[tuple[str, np.ndarray]]
    scalars: np.ndarray
    report: dict[str, Any]


def tetrahedra(mesh: UnstructuredMesh, merge_distance: float = 0.0) -> ConformingMesh:
    """The volume cells of a mesh as tetrahedra.

    Points at one place (bit-equal, -0.0 is 0.0) become one, and those within `merge_distance` of
    each other, directly or through others that are: the first of the file stays, with its scalar.
    Hexahedra, wedges and pyramids are split. Tetrahedra are dropped that name a vertex twice, that
    are there already, those of zero volume, exactly or as 6 |V| <= 1e-14 longest edge^3, and those
    whose longest edge is 2^-40 of the mesh's longest side or less; those of negative volume are
    turned. A face that more than two cells have, or two on the same side, has no neighbours. The
    report counts all of it.

    Parameters
    ----------
    merge_distance : world units.

    Raises
    ------
    MeshError : no volume cells, a kind that cannot be split, an index out of range, a point or a
        scalar that is not finite, or no volume left.
    MemoryLimitError : too many points are within the merge distance.
    """
    found = _merged(mesh, merge_distance)
    parts, sources, either, first = [], [], [], 0
    report = found.report
    report["coincident"] = report["collapsed"] = 0
    for kind, block in found.blocks:
        report["coincident" if kind == "tetra" else "collapsed"] += int(_repeats(block).sum())
        pieces, source = _split(kind, block)
        parts.append(pieces)
        sources.append(source + first)
        either.append(np.full(len(pieces), kind == "wedge"))  # programs wind it in either way
        first += len(block)
    cells, source = np.concatenate(parts), np.concatenate(sources)
    unit = _unit(found.points)
    volume, sign, size = _volumes(unit, cells)
    flat = _flat(unit, volume, size)
    turned = sign < 0
    cells[turned] = cells[turned][:, [1, 0, 2, 3]]
    again = _again(cells)
    report["duplicates"] = int(np.count_nonzero(again))
    report["zero_volume"] = report["coincident"] + int(np.count_nonzero((sign == 0) & ~again))
    report["flat"] = int(np.count_nonzero(flat & (sign != 0) & ~again))
    kept = ~(again | flat | (sign == 0))
    report["turned"] = int(np.count_nonzero(turned & kept & ~np.concatenate(either)))
    return _finished(mesh, found, cells[kept], source[kept], TETRAHEDRON_FACES)


def hexahedra(mesh: UnstructuredMesh, merge_distance: float = 0.0) -> ConformingMesh:
    """The hexahedra of a mesh of constant cells, as they are; merged, dropped and turned as by
    `tetrahedra`.

    Raises
    ------
    MeshError : as `tetrahedra`; or there are cells of another kind, scalars at points, or
        hexahedra that are not convex with planar faces, within 1e-5 of their longest edge.
    MemoryLimitError : as `tetrahedra`.
    """
    where = mesh.name or "mesh"
    mend = "use --layout raycast, which splits cells into tetrahedra"
    if not mesh.constant:
        raise MeshError(
            f"{where}: {mesh.scalar} is one a point and --layout hexahedra wants one a cell: name "
            f"a cell array, or {mend}"
        )
    found = _merged(mesh, merge_distance)
    others = [kind for kind, _ in found.blocks if kind != "hexahedron"]
    if others:
        raise MeshError(f"{where}: has {others[0]} cells beside hexahedra: {mend}")
    cells = np.concatenate([block for _, block in found.blocks])
    _refuse_some(where, _repeats(cells), "name a vertex twice", mend)
    again = _again(cells)
    cells, source = cells[~again], np.flatnonzero(~again)
    pieces, piece_of = _split("hexahedron", cells)
    unit = _unit(found.points)
    volume, _, _ = _volumes(unit, pieces)
    total = np.zeros(len(cells))
    np.add.at(total, piece_of, volume)
    bent, size = _bent(unit, cells, total)
    flat = _flat(unit, total, size)
    _refuse_some(where, (bent > PLANAR * size) & ~flat, "are not convex with planar faces", mend)
    turned = total < 0
    cells[turned] = cells[turned][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    report = found.report
    report["coincident"] = report["collapsed"] = 0
    report["duplicates"] = int(np.count_nonzero(again))
    report["zero_volume"] = int(np.count_nonzero(total == 0))
    report["flat"] = int(np.count_nonzero(flat & (total != 0)))
    report["turned"] = int(np.count_nonzero(turned & ~flat))
    return _finished(mesh, found, cells[~flat], source[~flat], HEXAHEDRON_FACES)


# ---- what the file has


def _merged(mesh: UnstructuredMesh, merge_distance: float) -> _Found:
    """The checked volume cells, with one number a place."""
    where = mesh.name or "mesh"
    if not 0 <= merge_distance < math.inf:
        raise VoxtoolError(f"a merge distance of {merge_distance:g}: give a length from 0 on")
    points, blocks, scalars, report = volume_cells(mesh)
    used = np.zeros(len(points), bool)
    for _, block in blocks:
        used[block.ravel()] = True
    number = np.cumsum(used) - 1
    _check_finite(where, points, used, "point", "the position")
    if not mesh.constant:
        _check_finite(where, scalars, used, "point", mesh.scalar)
        scalars = scalars[used]
    points = points[used]
    first = _first_at_place(points)
    if merge_distance > 0:
        first = _first_within(points, first, merge_distance)
    merged = first != np.arange(len(points))
    report["points"] = len(points)
    report["merged_points"] = int(np.count_nonzero(merged))
    report["merged_scalars"] = 0
    if not mesh.constant:
        report["merged_scalars"] = int(np.count_nonzero(scalars != scalars[first]))
    blocks = [(kind, first[number[block]]) for kind, block in blocks]
    return _Found(points, blocks, scalars, report)


def volume_cells(
    mesh: UnstructuredMesh,
) -> tuple[np.ndarray, list[tuple[str, np.ndarray]], np.ndarray, dict[str, Any]]:
    """Points, the corners of each block of volume cells, scalars, and what was read and ignored.

    Raises
    ------
    MeshError : there are none, of a kind that cannot be split, or arrays that are not as
        UnstructuredMesh says.
    """
    where = mesh.name or "mesh"
    points = np.asarray(mesh.points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"{where}: points of shape {points.shape}: give (P, 3)")
    read, ignored, curved, blocks, values = {}, {}, 0, [], []
    for number, (kind, block) in enumerate(mesh.cells):
        if not len(block) or kind.rstrip("0123456789") in FLAT:
            ignored[kind] = ignored.get(kind, 0) + len(block)
            continue
        plain = kind.rstrip("0123456789")
        if plain not in CORNERS:
            raise MeshError(
                f"{where}: has {count_of(len(block), 'cell')} of kind {kind}, which cannot be "
                "split: convert them to tetrahedra, hexahedra, wedges or pyramids"
            )
        corners = _corners(where, kind, block, CORNERS[plain])
        curved += len(block) if corners.shape[1] < block.shape[1] else 0
        _check_indices(where, kind, block, len(points))
        read[kind] = read.get(kind, 0) + len(block)
        blocks.append((plain, corners))
        if isinstance(mesh.scalars, list):
            values.append(_cell_scalars(where, kind, mesh.scalars[number], block, mesh.scalar))
    if not blocks:
        kinds = ", ".join(f"{count:,} {kind}" for kind, count in ignored.items() if count)
        raise MeshError(
            f"{where}: no volume cells (it has {kinds or 'no cells'}): give a mesh of tetrahedra, "
            "hexahedra, wedges or pyramids"
        )
    scalars = np.concatenate(values) if mesh.constant else np.asarray(mesh.scalars, np.float64)
    if not mesh.constant and scalars.shape != (len(points),):
        raise MeshError(
            f"{where}: {mesh.scalar} of shape {scalars.shape} for {len(points)} points: give one "
            "a point"
        )
    report = {"cells": read, "ignored": {k: n for k, n in ignored.items() if n}, "curved": curved}
    return points, blocks, scalars, report


def _corners(where: str, kind: str, block: np.ndarray, count: int) -> np.ndarray:
    """(N, count) int64: the corners of cells, which come first."""
    if block.ndim != 2 or block.shape[1] < count or not np.issubdtype(block.dtype, np.integer):
        raise MeshError(
            f"{where}: {kind} cells of shape {block.shape} and type {block.dtype}: give whole "
            f"numbers (N, {count})"
        )
    return block[:, :count].astype(np.int64)


def _check_indices(where: str, kind: str, block: np.ndarray, points: int) -> None:
    if block.min() < 0 or block.max() >= points:
        bad = (block < 0) | (block >= points)
        cell = int(np.argmax(bad.any(axis=1)))
        raise MeshError(
            f"{where}: {kind} {cell} names point {block[cell][bad[cell]][0]} where there are "
            f"{points}, both counted from 0: mend the index, or the file is truncated"
        )


def _cell_scalars(
    where: str, kind: str, values: np.ndarray, block: np.ndarray, scalar: str
) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.shape != (len(block),):
        raise MeshError(
            f"{where}: {scalar} of shape {values.shape} for {len(block)} {kind} cells: give one a "
            "cell"
        )
    _check_finite(where, values, np.ones(len(values), bool), kind, scalar)
    return values


def _check_finite(where: str, values: np.ndarray, used: np.ndarray, noun: str, what: str) -> None:
    """What volume cells use must be finite."""
    finite = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
    bad = used & ~finite
    if bad.any():
        first = int(np.argmax(bad))
        raise MeshError(
            f"{where}: {what} is not finite at {count_of(int(np.count_nonzero(bad)), noun)}, the "
            f"first is {noun} {first} ({values[first]}): give a number, or leave the cells out"
        )


def _refuse_some(where: str, bad: np.ndarray, what: str, mend: str) -> None:
    if bad.any():
        raise MeshError(
            f"{where}: {int(np.count_nonzero(bad)):,} of {len(bad):,} hexahedra {what}, the first "
            f"is {int(np.argmax(bad))}: {mend}"
        )


# ---- merging


def _first_at_place(points: np.ndarray) -> np.ndarray:
    """(P,) int64: of each point the first that is at its place, bit-equal but for -0.0."""
    order = np.lexsort(points.T)  # stable, so the first of a run comes first
    new = np.ones(len(order), bool)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    first = np.empty(len(points), np.int64)
    first[order] = order[np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))]
    return first


def _first_within(points: np.ndarray, first: np.ndarray, distance: float) -> np.ndarray:
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
        if pairs > MAX_PAIRS:
            raise MemoryLimitError(
                f"a merge distance of {distance:g} compares more than {MAX_PAIRS:,} pairs of "
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


# ---- splitting


def _split(kind: str, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra of cells, (N, 4) int64, and the number of each one's cell; those that would name
    a vertex twice are left out.

    A cell is the cone from its smallest vertex over the faces that do not have it.
    """
    if kind == "tetra":
        whole = np.flatnonzero(~_repeats(block))
        return block[whole], whole
    quads = [face for face in CELL_FACES[kind] if len(face) == 4]
    code = block.argmin(axis=1)
    for face in quads:
        code = 2 * code + block[:, face].argmin(axis=1) % 2
    pieces, sources = [], []
    for value in np.unique(code).tolist():
        cuts = {face: value >> (len(quads) - 1 - i) & 1 for i, face in enumerate(quads)}
        template = _template(kind, value >> len(quads), cuts)
        cells = np.flatnonzero(code == value)
        pieces.append(block[cells][:, template].reshape(-1, 4))
        sources.append(np.repeat(cells, len(template)))
    cells, source = np.concatenate(pieces), np.concatenate(sources)
    order = np.argsort(source, kind="stable")
    order = order[~_repeats(cells[order])]
    return cells[order], source[order]


def _template(
    kind: str, apex: int, cuts: dict[tuple[int, ...], int]
) -> list[tuple[int, int, int, int]]:
    """The tetrahedra of a cell whose smallest vertex is `apex`; of each quadrilateral, whether it
    is cut from its first vertex (0) or from its second (1)."""
    triangles = []
    for face in CELL_FACES[kind]:
        if apex in face:
            continue
        if len(face) == 4:
            a, b, c, d = face[cuts[face] :] + face[: cuts[face]]
            triangles += [(a, b, c), (a, c, d)]
        else:
            triangles.append(face)
    if kind != "hexahedron":
        return [(apex, *triangle) for triangle in triangles]
    seen = {vertex for face in CELL_FACES[kind] if apex in face for vertex in face}
    (far,) = set(range(8)) - seen
    around = [triangle for triangle in triangles if far in triangle]
    if len(around) > 3:
        return [(apex, *triangle) for triangle in triangles]
    # no diagonal from the far vertex, so it can be cut off whole: five tetrahedra do
    after = {}
    for triangle in around:
        i = triangle.index(far)
        after[triangle[(i + 1) % 3]] = triangle[(i + 2) % 3]
    a = min(after)
    b, c = after[a], after[after[a]]
    others = [(apex, *triangle) for triangle in triangles if far not in triangle]
    return [*others, (apex, a, b, c), (far, a, c, b)]


# ---- dropping and turning


def _repeats(cells: np.ndarray) -> np.ndarray:
    """(N,) bool: cells that name a vertex twice."""
    ordered = np.sort(cells, axis=1)
    return (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)


def _again(cells: np.ndarray) -> np.ndarray:
    """(N,) bool: cells of the same vertices as an earlier one."""
    ordered = np.sort(cells, axis=1)
    order = np.lexsort(ordered.T)
    same = np.zeros(len(cells), bool)
    same[order[1:]] = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    return same


def _unit(points: np.ndarray) -> np.ndarray:
    """The points in units of a power of two that brings them into [-1, 1]: nothing overflows."""
    return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))


def _flat(points: np.ndarray, volume: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N,) bool: cells of six such volumes and longest edges that are too flat, or too small."""
    side = np.ptp(points, axis=0).max()
    return (np.abs(volume) <= FLATTEST * size * size * size) | (size <= SMALLEST * side)


def _volumes(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of tetrahedra six times the volume, its exact sign, and the longest edge."""
    corners = points[cells]
    a, b, c = (corners[:, i] - corners[:, 0] for i in (1, 2, 3))
    size = np.zeros(len(cells))
    for p, q in ((a, 0), (b, 0), (c, 0), (a, b), (b, c), (c, a)):
        size = np.maximum(size, length(p - q))
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = a.T, b.T, c.T
    terms = ((az, bx * cy, cx * by), (bz, cx * ay, ax * cy), (cz, ax * by, bx * ay))
    volume, magnitude = np.zeros(len(cells)), np.zeros(len(cells))
    for height, plus, minus in terms:
        volume += height * (plus - minus)
        magnitude += np.abs(height) * (np.abs(plus) + np.abs(minus))
    sign = np.sign(volume).astype(np.int8)
    doubtful = (np.abs(volume) <= ROUNDING * magnitude) | (magnitude < 2.0**-900)
    for cell in np.flatnonzero(doubtful):
        sign[cell] = _exact_sign(corners[cell])
    return volume, sign, size


def _exact_sign(corners: np.ndarray) -> int:
    """The sign of the volume of one tetrahedron, (4, 3) float64."""
    o, *rest = [[Fraction(x) for x in corner] for corner in corners.tolist()]
    a, b, c = ([x - y for x, y in zip(corner, o, strict=True)] for corner in rest)
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return (determinant > 0) - (determinant < 0)


def _bent(
    points: np.ndarray, cells: np.ndarray, volume: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of hexahedra of these six volumes how far a vertex is off the plane of a face of its own or
    beyond any other, and the longest edge."""
    corners = points[cells]
    way = np.where(volume < 0, -1.0, 1.0)
    bent, size = np.zeros(len(cells)), np.zeros(len(cells))
    for face in HEXAHEDRON_FACES:
        a, b, c, d = (corners[:, i] for i in face)
        for p, q in pairwise((a, b, c, d, a)):
            size = np.maximum(size, length(q - p))
        normal = cross(c - a, d - b) * way[:, None]
        area = length(normal)
        bent[area == 0] = np.inf
        normal /= np.where(area == 0, 1, area)[:, None]
        centre = (a + b + c + d) / 4
        for i in range(8):
            height = dot(corners[:, i] - centre, normal)
            bent = np.maximum(bent, np.abs(height) if i in face else height)
    return bent, size


# ---- faces


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


def _finished(
    mesh: UnstructuredMesh,
    found: _Found,
    cells: np.ndarray,
    source: np.ndarray,
    faces: tuple[tuple[int, ...], ...],
) -> ConformingMesh:
    """The cells that are left, with the vertices that they use, and their neighbours."""
    where = mesh.name or "mesh"
    if not len(cells):
        raise MeshError(f"{where}: all of its cells have zero volume: it has no inside")
    used = np.zeros(len(found.points), bool)
    used[cells.ravel()] = True
    if len(cells) > MAX_COUNT or np.count_nonzero(used) > MAX_COUNT:
        raise MeshError(f"{where}: {len(cells):,} cells, at most {MAX_COUNT:,} fit: split it")
    number = np.cumsum(used) - 1
    cells = number[cells].astype(np.int32)
    neighbours, counts = match_faces(cells, np.array(faces))
    return ConformingMesh(
        found.points[used],
        cells,
        neighbours,
        found.scalars[source] if mesh.constant else found.scalars[used],
        mesh.constant,
        mesh.scalar,
        mesh.source_sha256,
        mesh.name,
        mesh.units,
        {**found.report, **counts},
    )
