"""Conforming meshes: tetrahedra or hexahedra, positively oriented, matched across their faces.

Volumes and lengths are float64; the side of a plane on which a vertex lies is decided exactly.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np

from voxtool.errors import MeshError
from voxtool.tets.cells import (
    HEXAHEDRON_FACES,
    TETRAHEDRON_FACES,
    match_faces,
    repeats,
    split,
)
from voxtool.tets.merge import MAX_PAIRS, merged_cells
from voxtool.tets.mesh import ConformingMesh, VolumeCells
from voxtool.tets.volume import PLANAR
from voxtool.vector import cross, dot, length

MAX_COUNT = (1 << 31) - 1  # cells, and vertices: indices are int32
FLATTEST = 1e-14  # 6 |V| / longest edge^3 of a cell that is dropped
SMALLEST = 2.0**-40  # longest edge / longest side of the mesh, of a cell that is dropped
ROUNDING = 8 * 2.0**-53  # of a determinant of differences, relative to the sizes of its terms


def tetrahedra(
    found: VolumeCells, merge_distance: float = 0.0, max_pairs: int = MAX_PAIRS
) -> ConformingMesh:
    """Return cells as tetrahedra; points are merged as by `merged_cells`.

    Hexahedra, wedges and pyramids are split. A tetrahedron is dropped if it repeats a vertex or
    another tetrahedron, if its volume is zero (exactly, or 6 |V| <= 1e-14 longest edge^3), or if
    its longest edge is at most 2^-40 of the mesh's longest side. A negative volume is turned over.
    A face of more than two cells, or of two on the same side, has no neighbours. The report counts
    all of it.

    Raises
    ------
    MeshError : no volume is left, or a point or a scalar is not finite.
    MemoryLimitError : too many points are within the merge distance.
    """
    found = merged_cells(found, merge_distance, max_pairs)
    parts, sources, either, first = [], [], [], 0
    for kind, block in found.blocks:
        pieces, source = split(kind, block)
        parts.append(pieces)
        sources.append(source + first)
        either.append(np.full(len(pieces), kind == "wedge"))  # programs wind wedges both ways
        first += len(block)
    cells = np.concatenate(parts)
    unit = scaled(found.points)
    volume, sign, size = signed_volumes(unit, cells)
    flat, repeated = _flat(unit, volume, size), _repeated(cells)
    source, winds = np.concatenate(sources), ~np.concatenate(either)
    return _conforming(found, cells, source, sign, flat, repeated, winds)


def hexahedra(
    found: VolumeCells, merge_distance: float = 0.0, max_pairs: int = MAX_PAIRS
) -> ConformingMesh:
    """Return the hexahedra of a mesh with constant cells, whole; they are merged, dropped and
    turned over as by `tetrahedra`.

    Raises
    ------
    MeshError : as `tetrahedra`; or there are cells of another kind, scalars at points, or
        hexahedra that are not convex with planar faces, within 1e-5 of their longest edge.
    MemoryLimitError : as `tetrahedra`.
    """
    hint = "use --layout raycast, which splits cells into tetrahedra"
    if not found.constant:
        raise MeshError(
            f"{found.name}: {found.scalar} is one a point and --layout hexahedra takes one a cell: "
            f"name a cell array, or {hint}"
        )
    found = merged_cells(found, merge_distance, max_pairs)
    others = [kind for kind, _ in found.blocks if kind != "hexahedron"]
    if others:
        raise MeshError(f"{found.name}: has {others[0]} cells beside hexahedra: {hint}")
    cells = np.concatenate([block for _, block in found.blocks])
    _refuse_some(found.name, repeats(cells), "name a vertex twice", hint)
    pieces, piece_of = split("hexahedron", cells)
    unit = scaled(found.points)
    volume = np.zeros(len(cells))
    np.add.at(volume, piece_of, signed_volumes(unit, pieces)[0])
    bent, size = _bent(unit, cells, volume)
    flat, repeated = _flat(unit, volume, size), _repeated(cells)
    refused = (bent > PLANAR * size) & ~flat & ~repeated
    _refuse_some(found.name, refused, "are not convex with planar faces", hint)
    return _conforming(found, cells, np.arange(len(cells)), np.sign(volume), flat, repeated)


def _refuse_some(name: str, bad: np.ndarray, what: str, hint: str) -> None:
    """Raise MeshError if some hexahedra are bad."""
    if bad.any():
        raise MeshError(
            f"{name}: {int(np.count_nonzero(bad)):,} of {len(bad):,} hexahedra {what}, the first "
            f"is {int(np.argmax(bad))}: {hint}"
        )


def _repeated(cells: np.ndarray) -> np.ndarray:
    """Return which cells have the vertices of an earlier cell, (N,) bool."""
    ordered = np.sort(cells, axis=1)
    order = np.lexsort(ordered.T)
    same = np.zeros(len(cells), bool)
    same[order[1:]] = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    return same


def scaled(points: np.ndarray) -> np.ndarray:
    """Return points divided by a power of two that brings them into [-1, 1]: nothing overflows."""
    return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))


def _flat(points: np.ndarray, volume: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return which cells are too flat or too small, (N,) bool, by six times their volume and their
    longest edge."""
    side = np.ptp(points, axis=0).max()
    return (np.abs(volume) <= FLATTEST * size * size * size) | (size <= SMALLEST * side)


def signed_volumes(
    points: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return six times the volumes of tetrahedra, their exact signs, and their longest edges."""
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
    """Return the sign of the volume of one tetrahedron, (4, 3) float64."""
    o, a, b, c = np.vectorize(Fraction, otypes=[object])(corners)
    volume = dot(a - o, cross(b - o, c - o))
    return int(volume > 0) - int(volume < 0)


def _bent(
    points: np.ndarray, cells: np.ndarray, volume: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far vertices of each hexahedron are from the plane of their face, or outside
    another face, at most; and its longest edge. `volume` is six times each volume."""
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


def _conforming(
    found: VolumeCells,
    cells: np.ndarray,
    source: np.ndarray,
    sign: np.ndarray,
    flat: np.ndarray,
    repeated: np.ndarray,
    winds: np.ndarray | bool = True,
) -> ConformingMesh:
    """Return the cells that are kept, turned over where the sign of their volume is negative, with
    the vertices that they use and their neighbours.

    source : the number of each cell in `found`; winds : whether its winding means anything.
    """
    hexa = cells.shape[1] == 8
    turned = sign < 0
    cells[turned] = cells[turned][:, [4, 5, 6, 7, 0, 1, 2, 3] if hexa else [1, 0, 2, 3]]
    kept = ~(repeated | flat | (sign == 0))
    repeating = [(kind == "tetra", int(repeats(block).sum())) for kind, block in found.blocks]
    coincident = sum(count for is_tetra, count in repeating if is_tetra)
    report = {
        **found.report,
        "coincident": coincident,
        "collapsed": sum(count for is_tetra, count in repeating if not is_tetra),
        "duplicates": int(np.count_nonzero(repeated)),
        "zero_volume": coincident + int(np.count_nonzero((sign == 0) & ~repeated)),
        "flat": int(np.count_nonzero(flat & (sign != 0) & ~repeated)),
        "turned": int(np.count_nonzero(turned & kept & winds)),
    }
    if not kept.any():
        raise MeshError(f"{found.name}: all of its cells have zero volume: it has no inside")
    cells, source = cells[kept], source[kept]
    used = np.zeros(len(found.points), bool)
    used[cells.ravel()] = True
    if len(cells) > MAX_COUNT or np.count_nonzero(used) > MAX_COUNT:
        raise MeshError(f"{found.name}: {len(cells):,} cells, at most {MAX_COUNT:,} fit: split it")
    cells = (np.cumsum(used) - 1)[cells].astype(np.int32)
    faces = np.array(HEXAHEDRON_FACES if hexa else TETRAHEDRON_FACES)
    neighbours, counts = match_faces(cells, faces)
    scalars = found.scalars[source] if found.constant else found.scalars[used]
    return ConformingMesh(
        found.points[used], cells, neighbours, scalars, found.constant, {**report, **counts}
    )
