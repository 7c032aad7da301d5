"""Conforming meshes: tetrahedra or hexahedra, positively oriented, matched across their faces.

Flat and duplicate cells are dropped and inverted ones are turned, in float64. On which side of a
plane a vertex is, is decided exactly.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MeshError
from voxtool.tets.faces import match_faces
from voxtool.tets.merge import MAX_PAIRS, merged_cells
from voxtool.tets.mesh import ConformingMesh, VolumeCells, volume_cells
from voxtool.tets.split import repeats, split
from voxtool.tets.volume import HEXAHEDRON_FACES, PLANAR, TETRAHEDRON_FACES
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.tets.mesh import UnstructuredMesh

MAX_COUNT = (1 << 31) - 1  # cells, and vertices: indices are int32
FLATTEST = 1e-14  # 6 |V| by the cube of the longest edge
SMALLEST = 2.0**-40  # longest edge by the mesh's longest side
ROUNDING = 8 * 2.0**-53  # of a determinant of differences, by the sum of its terms' sizes


def tetrahedra(
    mesh: UnstructuredMesh,
    merge_distance: float = 0.0,
    *,
    found: VolumeCells | None = None,
    max_pairs: int = MAX_PAIRS,
) -> ConformingMesh:
    """Return the volume cells of a mesh as tetrahedra.

    Points at one place (bit-equal, -0.0 is 0.0) become one, and those within `merge_distance` of
    each other, directly or through others that are: the first of the file stays, with its scalar.
    Hexahedra, wedges and pyramids are split. Tetrahedra are dropped that repeat a vertex, that are
    duplicates, whose volume is zero, exactly or as 6 |V| <= 1e-14 longest edge^3, or whose longest
    edge is 2^-40 of the mesh's longest side or less. Those of negative volume are reoriented. A
    face that more than two cells have, or two on the same side, has no neighbours. The report
    counts all of it.

    Parameters
    ----------
    merge_distance : world units.
    found : the mesh's volume cells, if they are known.
    max_pairs : pairs of points that are compared, beyond which the merging is refused.

    Raises
    ------
    MeshError : no volume cells, a kind that cannot be split, an index out of range, a point or a
        scalar that is not finite, or no volume left.
    MemoryLimitError : too many points are within the merge distance.
    """
    found = merged_cells(mesh, found or volume_cells(mesh), merge_distance, max_pairs)
    parts, sources, either, first = [], [], [], 0
    report = found.report
    report["coincident"] = report["collapsed"] = 0
    for kind, block in found.blocks:
        report["coincident" if kind == "tetra" else "collapsed"] += int(repeats(block).sum())
        pieces, source = split(kind, block)
        parts.append(pieces)
        sources.append(source + first)
        either.append(np.full(len(pieces), kind == "wedge"))  # programs wind it in either way
        first += len(block)
    cells, source = np.concatenate(parts), np.concatenate(sources)
    unit = scaled(found.points)
    volume, sign, size = signed_volumes(unit, cells)
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


def hexahedra(
    mesh: UnstructuredMesh,
    merge_distance: float = 0.0,
    *,
    found: VolumeCells | None = None,
    max_pairs: int = MAX_PAIRS,
) -> ConformingMesh:
    """The hexahedra of a mesh of constant cells, as they are; merged, dropped and turned as by
    `tetrahedra`.

    Raises
    ------
    MeshError : as `tetrahedra`; or there are cells of another kind, scalars at points, or
        hexahedra that are not convex with planar faces, within 1e-5 of their longest edge.
    MemoryLimitError : as `tetrahedra`.
    """
    where = mesh.name or "mesh"
    hint = "use --layout raycast, which splits cells into tetrahedra"
    if not mesh.constant:
        raise MeshError(
            f"{where}: {mesh.scalar} is one a point and --layout hexahedra takes one a cell: name "
            f"a cell array, or {hint}"
        )
    found = merged_cells(mesh, found or volume_cells(mesh), merge_distance, max_pairs)
    others = [kind for kind, _ in found.blocks if kind != "hexahedron"]
    if others:
        raise MeshError(f"{where}: has {others[0]} cells beside hexahedra: {hint}")
    cells = np.concatenate([block for _, block in found.blocks])
    _refuse_some(where, repeats(cells), "name a vertex twice", hint)
    again = _again(cells)
    cells, source = cells[~again], np.flatnonzero(~again)
    pieces, piece_of = split("hexahedron", cells)
    unit = scaled(found.points)
    volume, _, _ = signed_volumes(unit, pieces)
    total = np.zeros(len(cells))
    np.add.at(total, piece_of, volume)
    bent, size = _bent(unit, cells, total)
    flat = _flat(unit, total, size)
    _refuse_some(where, (bent > PLANAR * size) & ~flat, "are not convex with planar faces", hint)
    turned = total < 0
    cells[turned] = cells[turned][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    report = found.report
    report["coincident"] = report["collapsed"] = 0
    report["duplicates"] = int(np.count_nonzero(again))
    report["zero_volume"] = int(np.count_nonzero(total == 0))
    report["flat"] = int(np.count_nonzero(flat & (total != 0)))
    report["turned"] = int(np.count_nonzero(turned & ~flat))
    return _finished(mesh, found, cells[~flat], source[~flat], HEXAHEDRON_FACES)


def _refuse_some(where: str, bad: np.ndarray, what: str, hint: str) -> None:
    if bad.any():
        raise MeshError(
            f"{where}: {int(np.count_nonzero(bad)):,} of {len(bad):,} hexahedra {what}, the first "
            f"is {int(np.argmax(bad))}: {hint}"
        )


def _again(cells: np.ndarray) -> np.ndarray:
    """(N,) bool: cells of the same vertices as an earlier one."""
    ordered = np.sort(cells, axis=1)
    order = np.lexsort(ordered.T)
    same = np.zeros(len(cells), bool)
    same[order[1:]] = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    return same


def scaled(points: np.ndarray) -> np.ndarray:
    """The points in units of a power of two that brings them into [-1, 1]: nothing overflows."""
    return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))


def _flat(points: np.ndarray, volume: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N,) bool: cells of six such volumes and longest edges that are too flat, or too small."""
    side = np.ptp(points, axis=0).max()
    return (np.abs(volume) <= FLATTEST * size * size * size) | (size <= SMALLEST * side)


def signed_volumes(
    points: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Six times the volumes of tetrahedra, their exact signs, and their longest edges."""
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
    """Return how far a vertex of each hexahedron is from the plane of one of its faces, or outside
    another face, and the longest edge. `volume` is six times each volume."""
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


def _finished(
    mesh: UnstructuredMesh,
    found: VolumeCells,
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
