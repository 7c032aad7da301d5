"""Cells of one kind: tetrahedra or hexahedra, positively oriented, none flat, none twice.

Volumes and lengths are float64; the side of a plane on which a vertex lies is decided exactly.

Kernels: kernels/tets/construction/conforming.cl.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import MeshError
from voxtool.opencl import program
from voxtool.opencl.primitives import bucket_sort, exclusive_scan
from voxtool.tets.construction.merge import MAX_PAIRS, merged_points
from voxtool.tets.volume.cells import CORNERS, quads, templates
from voxtool.tets.volume.mesh import ConformingMesh, VolumeCells
from voxtool.tets.volume.volume import FLAT as THINNEST
from voxtool.tets.volume.volume import PLANAR, largest_square
from voxtool.vector import cross, difference, dot, triple_product

if TYPE_CHECKING:
    from voxtool.opencl import Array, Device
    from voxtool.tets.construction.merge import MergedPoints

SOURCE = "tets/construction/conforming.cl"
# A cell is dropped by its height over its largest face / longest edge, twice that face / longest
# edge^2, and longest edge / longest side of the mesh. The sign of a determinant of differences is
# decided exactly if it is small relative to its terms, or they are small.
LIMITS = {
    "FLATTEST": 1e-14,
    "NEEDLE": 2.0**-30,
    "SMALLEST": 2.0**-40,
    "ROUNDING": 8 * 2.0**-53,
    "LEAST_MAGNITUDE": 2.0**-900,
    "PLANAR": PLANAR,
}
# The shape of a cell: the sign of its volume plus 1 in the lowest bits, and what else was found.
SIGN, FLAT, DOUBTFUL, BENT, THIN = 3, 4, 8, 16, 32
OUTCOMES = KEPT, TURNED, DUPLICATE, ZERO_VOLUME, TOO_FLAT = range(5)  # what becomes of a cell

HEADERS = {
    "tets/construction/conforming.h": "\n".join(
        (
            *(f"#define {name} {value.hex()}" for name, value in LIMITS.items()),
            program.c_constants(SIGN=SIGN, FLAT=FLAT, DOUBTFUL=DOUBTFUL, BENT=BENT, THIN=THIN),
            f"#define THINNEST {THINNEST.hex()}",
            program.c_constants(
                KEPT=KEPT, TURNED=TURNED, DUPLICATE=DUPLICATE, ZERO_VOLUME=ZERO_VOLUME,
                TOO_FLAT=TOO_FLAT,
            ),
        )
    )
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ConformingCells:
    """A ConformingMesh whose cells are on the device.

    vertices, scalars, constant, report : as there.
    cells : uint32, the `corners` vertices of each of `count` cells.
    thin : whether a tetrahedron is so flat that float32 does not give its height.
    """

    vertices: np.ndarray
    cells: Array
    corners: int
    count: int
    scalars: np.ndarray
    constant: bool
    thin: bool
    report: dict[str, Any]

    def on_host(self) -> ConformingMesh:
        """Return the mesh with a copy of its cells."""
        cells = self.cells.get(0, self.corners * self.count).astype(np.int32)
        return ConformingMesh(
            self.vertices, cells.reshape(-1, self.corners), self.scalars, self.constant, self.report
        )

    def heights(self, scale: float) -> np.ndarray:
        """Return the height of each tetrahedron over its largest face, in units of `scale`, a power
        of two; (T,) float64, to rounding."""
        corners = self.vertices[self.cells.get(0, 4 * self.count).reshape(-1, 4)] / scale
        corners = corners.swapaxes(0, 1)
        return six_volumes(corners) / np.sqrt(largest_square(corners))


@dataclass(frozen=True, eq=False)
class _Block:
    """A block of cells of one kind on the device, by the numbers of merged points.

    corners : uint32; starts : uint32, the number of tetrahedra before each cell's, `pieces` in all;
    repeating : (count,) bool, whether a cell names a vertex twice.
    """

    kind: str
    count: int
    corners: Array
    starts: Array
    pieces: int
    repeating: np.ndarray


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells of one kind on the device, and the cell of the mesh from which each comes: uint32."""

    cells: Array
    corners: int
    count: int
    sources: Array


def tetrahedra(
    device: Device, found: VolumeCells, merge_distance: float = 0.0, max_pairs: int = MAX_PAIRS
) -> ConformingCells:
    """Return cells as tetrahedra; points are merged as by `merged_points`.

    Hexahedra, wedges and pyramids are split. A tetrahedron is dropped if it repeats a vertex or
    another tetrahedron, if its volume is zero, if its height over its largest face is at most 1e-14
    of its longest edge, if it is a needle narrower than about 2^-30 of it, or if that edge is at
    most 2^-40 of the mesh's longest side. A negative volume is turned over.
    The report counts all of it.

    Raises
    ------
    MeshError : no volume is left, or a point or a scalar is not finite.
    MemoryLimitError : too many points are within the merge distance.
    """
    merged = merged_points(device, found, merge_distance, max_pairs)
    blocks = _blocks(device, found, merged)
    cells = _split(device, blocks)
    unit = scaled(merged.points)
    shapes = tetrahedron_shapes(cells.cells, cells.count, unit)
    outcomes = _judged(device, cells, shapes, _repeated(device, cells, len(unit)))
    ends = np.cumsum([block.pieces for block in blocks])
    report = _report(blocks, outcomes, ends) | _held(found, merged, cells, outcomes)
    thin = bool((shapes.get()[np.isin(outcomes.on_host, (KEPT, TURNED))] & THIN).any())
    return _kept(device, found, merged, cells, outcomes, report, thin)


def hexahedra(
    device: Device, found: VolumeCells, merge_distance: float = 0.0, max_pairs: int = MAX_PAIRS
) -> ConformingCells:
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
    merged = merged_points(device, found, merge_distance, max_pairs)
    others = [kind for kind, _ in found.blocks if kind != "hexahedron"]
    if others:
        raise MeshError(f"{found.name}: has {others[0]} cells beside hexahedra: {hint}")
    whole = np.concatenate([block for _, block in found.blocks])
    (block,) = _blocks(device, replace(found, blocks=[("hexahedron", whole)]), merged)
    _refuse_some(found.name, block.repeating, "name a vertex twice", hint)
    numbers = device.put(np.arange(block.count, dtype=np.uint32))
    cells = _Cells(block.corners, 8, block.count, numbers)
    unit = scaled(merged.points)
    shapes = device.empty(block.count, np.uint8)
    device.kernel(SOURCE, "measure_hexahedra")(
        block.count, block.corners, device.put(unit), _longest_side(unit), block.starts,
        _split(device, [block]).cells, shapes,
    )  # fmt: skip
    repeated = _repeated(device, cells, len(unit))
    bent = (shapes.get() & (BENT | FLAT)) == BENT
    _refuse_some(found.name, bent & (repeated.get() == 0), "are not convex with planar faces", hint)
    outcomes = _judged(device, cells, shapes, repeated)
    report = _report([block], outcomes, np.array([block.count]))
    return _kept(device, found, merged, cells, outcomes, report, False)


def _refuse_some(name: str, bad: np.ndarray, what: str, hint: str) -> None:
    """Raise MeshError if some hexahedra are bad."""
    if bad.any():
        raise MeshError(
            f"{name}: {int(np.count_nonzero(bad)):,} of {len(bad):,} hexahedra {what}, the first "
            f"is {int(np.argmax(bad))}: {hint}"
        )


# ---- splitting


def _blocks(device: Device, found: VolumeCells, merged: MergedPoints) -> list[_Block]:
    """Return the blocks of cells, and how many tetrahedra each cell becomes."""
    numbers, blocks = device.put(merged.numbers), []
    for kind, cells in found.blocks:
        count, corners = len(cells), device.put(cells)
        device.kernel(SOURCE, "renumber")(cells.size, corners, numbers)
        starts, repeating = device.empty(count + 1, np.uint32), device.empty(count, np.uint8)
        device.kernel(SOURCE, "count_pieces")(
            count, corners, starts, repeating, **_kind(device, kind)
        )
        pieces = exclusive_scan(starts, count)
        blocks.append(_Block(kind, count, corners, starts, pieces, repeating.take() != 0))
    return blocks


def _kind(device: Device, kind: str) -> dict[str, Any]:
    """Return the arguments KIND of kernels, by name."""
    return {
        "corners": CORNERS[kind],
        "quads": device.put(quads(kind)),
        "quad_count": len(quads(kind)),
        "templates": device.put(templates(kind)),
    }


def _split(device: Device, blocks: list[_Block]) -> _Cells:
    """Return the tetrahedra of all blocks that name no vertex twice."""
    total = sum(block.pieces for block in blocks)
    cells, sources = device.empty(4 * total, np.uint32), device.empty(total, np.uint32)
    offset = first = 0
    for block in blocks:
        device.kernel(SOURCE, "write_pieces")(
            block.count, block.corners, block.starts, offset, first, cells, sources,
            **_kind(device, block.kind),
        )  # fmt: skip
        offset += block.pieces
        first += block.count
    return _Cells(cells, 4, total, sources)


# ---- measuring


def scaled(points: np.ndarray) -> np.ndarray:
    """Return points divided by a power of two that brings them into [-1, 1]: nothing overflows."""
    return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))


def _longest_side(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max())


def tetrahedron_shapes(cells: Array, count: int, points: np.ndarray) -> Array:
    """Return the shapes of tetrahedra, uint8; the signs of their volumes are exact.

    cells : uint32, four vertices each; points : (P, 3) float64 in [-1, 1].
    """
    device = cells.device
    shapes = device.empty(count, np.uint8)
    device.kernel(SOURCE, "measure_tetrahedra")(
        count, cells, device.put(points), _longest_side(points), shapes
    )
    shape = shapes.get()
    doubtful = np.flatnonzero(shape & DOUBTFUL)
    if len(doubtful):  # rounding might have changed their signs
        vertices = cells.get().reshape(-1, 4)[doubtful]
        signs = np.array([_exact_sign(points[cell]) for cell in vertices])
        shape[doubtful] = shape[doubtful] & (FLAT | THIN) | (signs + 1).astype(np.uint8)
        device.write(shapes, shape)
    return shapes


def six_volumes(corners: np.ndarray) -> np.ndarray:
    """Return six times the volume of tetrahedra of (4, T, 3) corners, (T,) float64, to rounding."""
    edges = [difference(corner.T, corners[0].T) for corner in corners[1:]]
    return np.abs(triple_product(*edges))


def _exact_sign(corners: np.ndarray) -> int:
    """Return the sign of the volume of one tetrahedron, (4, 3) float64."""
    o, a, b, c = np.vectorize(Fraction, otypes=[object])(corners)
    volume = dot(a - o, cross(b - o, c - o))
    return int(volume > 0) - int(volume < 0)


# ---- dropping


def _repeated(device: Device, cells: _Cells, points: int) -> Array:
    """Return which cells have the vertices of an earlier cell, uint8."""
    count, corners = cells.count, cells.corners
    buckets, keys = device.empty(count, np.uint32), device.empty(count, np.uint64)
    device.kernel(SOURCE, "key_cells")(count, cells.cells, corners, buckets, keys)
    ends, keys, items = bucket_sort(buckets, keys, count, points)
    repeated = device.empty(count, np.uint8)
    device.kernel(SOURCE, "find_repeated")(count, cells.cells, corners, ends, keys, items, repeated)
    return repeated


@dataclass(frozen=True, eq=False)
class _Outcomes:
    """The outcome of each cell, (N,) uint8, on the host and on the device; and the places of those
    that stay, the exclusive scan of their flags."""

    on_host: np.ndarray
    outcomes: Array
    places: Array
    kept: int


def _judged(device: Device, cells: _Cells, shapes: Array, repeated: Array) -> _Outcomes:
    """Return what becomes of cells."""
    outcomes = device.empty(cells.count, np.uint8)
    places = device.empty(cells.count + 1, np.uint32)
    device.kernel(SOURCE, "judge")(cells.count, shapes, repeated, outcomes, places)
    kept = exclusive_scan(places, cells.count)
    return _Outcomes(outcomes.get(), outcomes, places, kept)


def _report(blocks: list[_Block], outcomes: _Outcomes, ends: np.ndarray) -> dict[str, int]:
    """Return the counts of what was dropped and turned. The cells of each block end at `ends`."""
    parts = np.split(outcomes.on_host, ends[:-1])
    counts = np.array([np.bincount(part, minlength=len(OUTCOMES)) for part in parts])
    winds = [block.kind != "wedge" for block in blocks]  # programs wind wedges both ways
    total = counts.sum(axis=0).tolist()
    repeating = [(block.kind == "tetra", int(block.repeating.sum())) for block in blocks]
    coincident = sum(count for is_tetra, count in repeating if is_tetra)
    return {
        "coincident": coincident,
        "collapsed": sum(count for is_tetra, count in repeating if not is_tetra),
        "duplicates": total[DUPLICATE],
        "zero_volume": coincident + total[ZERO_VOLUME],
        "flat": total[TOO_FLAT],
        "turned": int(counts[winds, TURNED].sum()),
    }


def _held(
    found: VolumeCells, merged: MergedPoints, cells: _Cells, outcomes: _Outcomes
) -> dict[str, Any]:
    """Return the volume and the range of scalars of the tetrahedra that are dropped as too flat."""
    flat = np.flatnonzero(outcomes.on_host == TOO_FLAT)
    if not len(flat):
        return {}
    corners = cells.cells.get().reshape(-1, 4)[flat]
    unit = merged.points[corners].swapaxes(0, 1)
    power = int(np.frexp(np.abs(merged.points).max())[1])
    with np.errstate(over="ignore"):  # infinite beyond float64
        volume = float(np.ldexp((six_volumes(np.ldexp(unit, -power)) / 6).sum(), 3 * power))
    scalars = merged.scalars[cells.sources.get()[flat] if found.constant else corners]
    return {
        "flat_volume": volume, "flat_scalars": [float(scalars.min()), float(scalars.max())]
    }  # fmt: skip


def _kept(
    device: Device,
    found: VolumeCells,
    merged: MergedPoints,
    cells: _Cells,
    outcomes: _Outcomes,
    report: dict[str, Any],
    thin: bool,
) -> ConformingCells:
    """Return the cells that stay, with the vertices that they use."""
    kept, corners = outcomes.kept, cells.corners
    if not kept:
        raise MeshError(f"{found.name}: all of its cells have zero volume: it has no inside")
    points = len(merged.points)
    found_cells, sources = device.empty(corners * kept, np.uint32), device.empty(kept, np.uint32)
    numbers = device.zeros(points + 1, np.uint32)
    device.kernel(SOURCE, "keep_cells")(
        cells.count, cells.cells, corners, cells.sources, outcomes.outcomes, outcomes.places,
        found_cells, sources, numbers,
    )  # fmt: skip
    used = numbers.get(0, points) != 0
    exclusive_scan(numbers, points)
    device.kernel(SOURCE, "renumber")(corners * kept, found_cells, numbers)
    return ConformingCells(
        merged.points[used],
        found_cells,
        corners,
        kept,
        merged.scalars[sources.take() if found.constant else used],
        found.constant,
        thin,
        {**merged.report, **report},
    )
