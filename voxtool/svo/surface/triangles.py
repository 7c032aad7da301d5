"""Triangles of voxel faces and surface nets, from the cubes that the surface of an octree cuts.

Both are dual: each loop of a cut cube has a vertex, each cut edge a quad
[Nielson 2004]; case_tables.py says how loops are separated so that the surface is manifold. A 5:1
histopyramid over the edges of the cubes [voCCeL, section 4.1] gives each quad a work-item, which
finds its cube. Voxel faces have their vertices in the middle of the cubes, the corners that eight
samples share, so quads are the faces of samples. Vertices of surface nets [Gibson 1998] begin at
the mean of the loop's crossings. If samples are voxels, which are only inside or not, they then
move towards the mean of their neighbours and never leave their cube; coverages need no such
relaxation.

Greedy meshing joins coplanar unit squares to rectangles, first in rows, then rows in columns.
Squares side by side in a row have sorted keys that rise by one; so have rows of equal beginning and
length in a column. The side of a rectangle may have vertices of others on it: T-junctions.

Kernels: dual.cl, relax.cl and greedy_meshing.cl in kernels/svo/surface.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from voxtool.choices import SURFACE_NETS
from voxtool.opencl import Array, Device, program
from voxtool.opencl.primitives import build_histopyramid, compact, exclusive_scan, radix_sort
from voxtool.svo.octree import VOXEL
from voxtool.svo.surface.case_tables import CASES, MAX_LOOPS
from voxtool.svo.surface.cut_cells import CutCubes, Extracted, Tiles, classify_cubes, count_lost
from voxtool.svo.surface.plan import MAX_SAMPLES

DUAL, RELAX, MERGE = (f"svo/surface/{n}.cl" for n in ("dual", "relax", "greedy_meshing"))
COORDINATE_BITS = MAX_SAMPLES.bit_length()  # of a corner of a square
SQUARE_BITS, ROW_BITS = 3 + 3 * COORDINATE_BITS, 3 + 4 * COORDINATE_BITS
HEADERS = {"svo/surface/greedy_meshing.h": program.c_constants(COORDINATE_BITS=COORDINATE_BITS)}


def dual_surface(
    tiles: Tiles,
    counted: Callable[..., None],
    style: str,
    relaxations: int,
    lanes: int,
    merge: bool,
) -> Extracted:
    """Return the surface of the tiles. Before memory is taken for it, `counted` is called with
    `tiles=`, `cubes=` and `edges=`. `relaxations`: of surface nets, in vertices of which a
    work-item moves `lanes` side by side; `merge`: of voxel faces, whether coplanar squares are
    joined."""
    device = tiles.device
    cubes = classify_cubes(tiles, counted)
    lost = count_lost(tiles, cubes.arguments["cut"])
    points, quads = _quads(tiles, cubes, style, relaxations, lanes)
    if merge:
        with device.stage("merge"):
            points, quads = join_squares(device, points, quads)
    with device.stage("triangles"):
        triangles = split_quads(tiles, points, quads)
    return Extracted(cubes.n, lost, points, triangles)


def _quads(
    tiles: Tiles, cubes: CutCubes, style: str, relaxations: int, lanes: int
) -> tuple[Array, Array]:
    """Return the vertices, (3 V,) int32, and the quads, (4 Q,) uint32, counter-clockwise seen from
    outside."""
    device, n = tiles.device, cubes.n
    first_vertex, quad_counts, first_beyond = (device.empty(n + 1, np.uint32) for _ in range(3))
    scene = {
        **cubes.arguments,
        "resolved": device.empty(n, np.uint16),
        "first_vertex": first_vertex,
        "first_beyond": first_beyond,
    }
    with device.stage("classify"):
        tiles.kernel(DUAL, "resolve_cases")(n, quad_counts, **scene)
        vertices = exclusive_scan(first_vertex, n)
    with device.stage("vertices"):
        points = device.empty(3 * vertices, np.int32)
        if style == SURFACE_NETS:
            tiles.kernel(DUAL, "place_means")(n, points=points, means=_means(tiles), **scene)
        else:
            tiles.kernel(DUAL, "place_corners")(n, points, **scene)
    if relaxations:
        with device.stage("relax"):
            _relax(tiles, points, n, relaxations, lanes, scene)
    with device.stage("histopyramid"):
        pyramid = build_histopyramid(quad_counts, n)
    with device.stage("quads"):
        quads = device.empty(4 * pyramid.total, np.uint32)
        list_quads = tiles.kernel(DUAL, "list_quads")
        list_quads(pyramid.total, quads, **pyramid.arguments, **scene)
    return points, quads


def _means(tiles: Tiles) -> Array:
    """Return where the vertices of each case are in its cube, if samples are voxels; none
    otherwise."""
    if tiles.sampling.level != VOXEL:
        return tiles.device.empty(0, np.int32)
    cases = 2 * CASES  # with their alternatives
    means = tiles.device.empty(3 * MAX_LOOPS * cases, np.int32)
    tiles.kernel(DUAL, "find_means")(cases, means, **tiles.arguments)
    return means


def _relax(
    tiles: Tiles, points: Array, cubes: int, relaxations: int, lanes: int, scene: dict[str, Any]
) -> None:
    """Move the vertices towards the mean of their neighbours in several rounds."""
    device, n = tiles.device, points.size // 3
    padded = -(-n // lanes) * lanes
    packed, moved = (device.empty(padded, np.uint64) for _ in range(2))
    further = exclusive_scan(scene["first_beyond"], cubes)
    links = {
        "links": device.empty(4 * n, np.uint32),
        "beyond_start": device.empty(padded // lanes + 1, np.uint32),
        "beyond": device.empty(2 * further, np.uint32),
        "around": device.empty(padded, np.uint16),
    }
    tiles.kernel(DUAL, "link_vertices")(
        cubes, points=points, packed=packed, lanes=lanes, **links, **scene
    )
    relax, unpack = (device.kernel(RELAX, name, LANES=lanes) for name in ("relax", "unpack"))
    for _ in range(relaxations):
        relax(padded // lanes, packed, relaxed=moved, n=n, **links)
        packed, moved = moved, packed
    unpack(n, packed, points)


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
    keys, order = radix_sort(keys, n, SQUARE_BITS, order)
    row_start, rows = _runs(device, keys, n)
    row_keys, row_order = device.empty(rows, np.uint64), device.empty(rows, np.uint32)
    device.kernel(MERGE, "key_rows")(rows, keys, n, row_start, row_keys, row_order)
    del keys
    row_keys, row_order = radix_sort(row_keys, rows, ROW_BITS, row_order)
    column_start, count = _runs(device, row_keys, rows)

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


def _runs(device: Device, keys: Array, n: int) -> tuple[Array, int]:
    """Return the places where runs of keys that rise by one begin, and their number."""
    flags, places = device.empty(n + 1, np.uint32), device.empty(n, np.uint32)
    device.kernel(MERGE, "flag_runs")(n, keys, flags, places)
    return compact(places, flags, n)
