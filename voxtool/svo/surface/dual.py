"""Triangles of voxel faces and surface nets, from the cubes that the surface of an octree cuts.

Both are dual: each loop of a cut cube has a vertex, each cut edge a quad [Nielson 2004];
case_tables.py says how loops are separated so that the surface is manifold. A work-item writes the
vertices or quads of a tile, from a table of its cubes and those beside it, and splits quads at once
if nothing else needs them. Voxel faces have their vertices in the middle of the cubes, the corners
that eight samples share, so quads are the faces of samples. Vertices of surface nets [Gibson 1998]
begin at the mean of the loop's crossings. If samples are voxels, which are only inside or not, they
then move towards the mean of their neighbours and never leave their cube; coverages need no such
relaxation.

Vertices of sharp surfaces lie where the planes of the source mesh meet (sharp.py).

Greedy meshing joins coplanar unit squares to rectangles, first in rows, then rows in columns.
Squares side by side in a row have sorted keys that rise by one; so have rows of equal beginning and
length in a column. The side of a rectangle may have vertices of others on it: T-junctions.

Kernels: dual.cl, relax.cl and greedy_meshing.cl in kernels/svo/surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import MAX_DIM, SURFACE_NETS
from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import compact, exclusive_scan, radix_sort, scan_runs
from voxtool.svo.surface.case_tables import CASES, MAX_LOOPS
from voxtool.svo.surface.cut_cells import Extracted, Tiles, check_edges, count_lost

if TYPE_CHECKING:
    from voxtool.svo.surface.sharp import Vertices

DUAL, RELAX, MERGE = (f"svo/surface/{n}.cl" for n in ("dual", "relax", "greedy_meshing"))
COORDINATE_BITS = MAX_DIM.bit_length()  # bits of a corner of a square
KEY_BITS = 3 + 3 * COORDINATE_BITS  # bits of a square or a row
BATCH = 64  # vertices that a work-item moves; a power of two, whole vectors
HEADERS = {"svo/surface/greedy_meshing.h": program.c_constants(COORDINATE_BITS=COORDINATE_BITS)}


@dataclass(frozen=True)
class CutCubes:
    """The cubes that the surface cuts, on the device, in the order of their tiles.

    Arguments of kernels, by name: those of the tiles, and

    cut, joined, several : (tiles,) masks of the cut cubes of each tile, and of those of them whose
        case is the alternative, or that have several loops.
    cases : (64 tiles,) cases of the cut cubes of each tile, then unused ones.
    first : (4 tiles + 1,) numbers of vertices, quads, neighbours beyond the fourth, and cut cubes
        before each tile; those of each kind begin with the sum of the kinds before.
    """

    n: int
    vertices: int
    quads: int
    beyond: int
    arguments: dict[str, Any]


def dual_surface(
    tiles: Tiles,
    counted: Callable[..., None],
    style: str,
    relaxations: int,
    lanes: int,
    merge: bool,
    crossings: dict[str, Any] | None = None,
) -> Extracted:
    """Return the surface of the tiles. Before memory is taken for it, `counted` is called with
    `tiles=`, `cubes=` and `edges=`. `relaxations`: of surface nets, in vertices of which a
    work-item moves `lanes` side by side; `merge`: of voxel faces, whether coplanar squares are
    joined; `crossings`: of find_crossings, of a sharp surface. MemoryLimitError is raised if there
    are MAX_EDGES edges or more."""
    device = tiles.device
    with device.stage("classify"):
        cubes = _classify(tiles)
        lost = count_lost(tiles, cubes.arguments["cut"])
    check_edges(cubes.quads)
    counted(tiles=tiles.n, cubes=cubes.n, edges=cubes.quads)
    features = None
    with device.stage("vertices"):
        if crossings is not None:
            from voxtool.svo.surface.sharp import place_features

            features = place_features(tiles, crossings, cubes.vertices, cubes.arguments)
            points = _between(tiles, cubes, relaxations, lanes, features)
        elif style == SURFACE_NETS and tiles.sampling.binary:
            points = _relaxed(tiles, cubes, relaxations, lanes)
        else:
            points = _placed(tiles, cubes, style)
    if features is None and not merge:
        with device.stage("triangles"):
            triangles = device.empty(6 * cubes.quads, np.uint32)
            list_triangles = tiles.kernel(DUAL, "list_quads", SPLIT=1)
            list_triangles(tiles.n, points, triangles, **cubes.arguments)
        return Extracted(cubes.n, lost, points, triangles, cubes.arguments["first"], 4)
    with device.stage("quads"):
        quads = device.empty(4 * cubes.quads, np.uint32)
        tiles.kernel(DUAL, "list_quads")(tiles.n, quads, **cubes.arguments)
    if merge:
        with device.stage("merge"):
            points, quads = join_squares(device, points, quads)
    with device.stage("triangles"):
        if features is None:
            triangles = split_quads(tiles, points, quads)
            return Extracted(cubes.n, lost, points, triangles, cubes.arguments["first"], 4)
        from voxtool.svo.surface.sharp import put_open, split_along_features

        put_open(tiles, features, points)
        triangles = split_along_features(tiles, features, points, quads)
    homes = points, _unpacked(tiles, cubes, features.means)
    return Extracted(
        cubes.n,
        lost,
        features.points,
        triangles,
        cubes.arguments["first"],
        4,
        features.found,
        homes,
    )


def _classify(tiles: Tiles) -> CutCubes:
    """Return the cubes whose corners are not all alike."""
    device, n = tiles.device, tiles.n
    first = device.empty(4 * n + 1, np.uint32)
    scene = {
        **tiles.arguments,
        **{name: device.empty(n, np.uint64) for name in ("cut", "joined", "several")},
        "cases": device.empty(64 * n, np.uint8),
        "first": first,
    }
    tiles.kernel(DUAL, "classify_tiles")(n, **scene)
    vertices, quads, beyond, cubes = scan_runs(first, n, 4)
    return CutCubes(cubes, vertices, quads, beyond, scene)


def _placed(tiles: Tiles, cubes: CutCubes, style: str) -> Array:
    """Return the vertices, (3 V,) int32, in the middle of their cubes or of their crossings."""
    points = tiles.device.empty(3 * cubes.vertices, np.int32)
    if style == SURFACE_NETS:
        tiles.kernel(DUAL, "place_means")(tiles.n, points=points, **cubes.arguments)
    else:
        tiles.kernel(DUAL, "place_corners")(tiles.n, points=points, **cubes.arguments)
    return points


def _between(
    tiles: Tiles, cubes: CutCubes, relaxations: int, lanes: int, features: Vertices
) -> Array:
    """Return the vertices of a sharp surface, (3 V,) int32: those without planes relax between
    those on features."""
    if features.found.open:
        return _relaxed(tiles, cubes, relaxations, lanes, features)
    return _unpacked(tiles, cubes, features.held)


def _relaxed(
    tiles: Tiles,
    cubes: CutCubes,
    relaxations: int,
    lanes: int,
    features: Vertices | None = None,
) -> Array:
    """Return the vertices of surface nets of voxels, (3 V,) int32, moved towards the mean of their
    neighbours in several rounds; those on features stay there."""
    device, n = tiles.device, cubes.vertices
    cases = 2 * CASES  # with their alternatives
    means = device.empty(MAX_LOOPS * cases, np.uint64)
    tiles.kernel(DUAL, "find_means")(cases, means, **tiles.arguments)
    batch = 1 if lanes == 1 else BATCH
    padded = -(-n // batch) * batch
    packed, moved = (device.empty(padded, np.uint64) for _ in range(2))
    links = {
        "links": device.empty(4 * padded, np.uint32),
        "beyond_start": device.empty(padded // batch + 1, np.uint32),
        "beyond": device.empty(2 * cubes.beyond, np.uint32),
        "around": device.empty(padded, np.uint16),
    }
    tiles.kernel(DUAL, "link_vertices")(
        tiles.n, means=means, packed=packed, batch=batch, **links, **cubes.arguments
    )
    if features is not None:
        from voxtool.svo.surface.sharp import hold_features

        hold_features(tiles, features, packed)
    if relaxations:
        with device.stage("relax"):
            relax = device.kernel(RELAX, "relax", LANES=lanes, BATCH=batch)
            for _ in range(relaxations):
                relax(padded // batch, packed, relaxed=moved, **links)
                packed, moved = moved, packed
                if features is not None:
                    hold_features(tiles, features, packed)
    del links, moved  # frees memory
    return _unpacked(tiles, cubes, packed)


def _unpacked(tiles: Tiles, cubes: CutCubes, packed: Array) -> Array:
    """Return the vertices, (3 V,) int32, that are packed in their cells."""
    points = tiles.device.empty(3 * cubes.vertices, np.int32)
    tiles.kernel(DUAL, "unpack")(tiles.n, packed=packed, points=points, **cubes.arguments)
    return points


def split_quads(tiles: Tiles, points: Array, quads: Array) -> Array:
    """Return two triangles for each of (4 Q,) quads, none of zero area, (6 Q,) uint32."""
    triangles = tiles.device.empty(6 * (quads.size // 4), np.uint32)
    tiles.kernel(DUAL, "split_quads")(quads.size // 4, quads, points, triangles)
    return triangles


def join_squares(device: Device, points: Array, quads: Array) -> tuple[Array, Array]:
    """Return the vertices still in use, (3 V,) int32, and the rectangles, (4 R,) uint32, of unit
    squares, (4 Q,) uint32 vertices, the lowest corner first."""
    n = quads.size // 4
    keys, order = device.empty(n, np.uint64), device.empty(n, np.uint32)
    device.kernel(MERGE, "key_squares")(n, quads, points, keys, order)
    keys, order = radix_sort(keys, n, KEY_BITS, order)
    flags, places = device.empty(n + 1, np.uint32), device.empty(n, np.uint32)
    device.kernel(MERGE, "flag_rows")(n, keys, flags, places)
    row_start, rows = compact(places, flags, n)
    row_keys, row_order = device.empty(rows, np.uint64), device.empty(rows, np.uint32)
    device.kernel(MERGE, "key_rows")(rows, keys, n, row_start, row_keys, row_order)
    row_keys, row_order = radix_sort(row_keys, rows, KEY_BITS, row_order)
    device.kernel(MERGE, "flag_columns")(rows, row_keys, row_order, row_start, keys, flags, places)
    del keys
    column_start, count = compact(places, flags, rows)
    del flags, places

    rectangles = device.empty(4 * count, np.uint32)
    vertices = points.size // 3
    numbers = device.zeros(vertices + 1, np.uint32)
    device.kernel(MERGE, "join_rows")(
        count, column_start, row_keys, row_order, rows, row_start, order, quads, rectangles, numbers
    )
    kept = device.empty(3 * exclusive_scan(numbers, vertices), np.int32)
    device.kernel(MERGE, "keep_points")(vertices, points, numbers, kept)
    device.kernel(MERGE, "renumber")(4 * count, rectangles, numbers)
    return kept, rectangles
