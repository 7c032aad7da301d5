"""Dual surfaces of an octree: voxel faces, the exact boundary of the samples, and surface nets.

Each loop of a cut cube has a vertex, each cut edge a quad [Nielson 2004]; case_tables.py says how
loops are separated so that the surface is manifold. Voxel faces have their vertices in the middle
of the cubes, the corners that eight samples share, so quads are the faces of samples. Vertices of
surface nets [Gibson 1998] begin at the mean of the loop's crossings. If samples are voxels, which
are only inside or not, they then move towards the mean of their neighbours and never leave their
cube; coverages need no such relaxation.

Kernels: kernels/svo/surface/dual.cl.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from voxtool.choices import SURFACE_NETS
from voxtool.opencl import Array
from voxtool.opencl.primitives import build_histopyramid, exclusive_scan
from voxtool.svo.surface.cut_cells import CutCubes, Tiles

SOURCE = "svo/surface/dual.cl"


def dual_surface(
    tiles: Tiles, cubes: CutCubes, style: str, relaxations: int
) -> tuple[Array, Array, int]:
    """Return the vertices, (3 V,) int32 as `Isosurface.points`, the quads, (4 Q,) uint32, counter-
    clockwise seen from outside, and the number of quads."""
    device, n = tiles.device, cubes.n
    first_vertex, quad_counts, first_link = (device.empty(n + 1, np.uint32) for _ in range(3))
    scene = {
        **cubes.arguments,
        "resolved": device.empty(n, np.uint16),
        "first_vertex": first_vertex,
        "first_link": first_link,
    }
    with device.stage("classify"):
        tiles.kernel(SOURCE, "resolve_cases")(n, quad_counts, **scene)
        vertices = exclusive_scan(first_vertex, n)
    with device.stage("vertices"):
        points = device.empty(3 * vertices, np.int32)
        place = "place_means" if style == SURFACE_NETS else "place_corners"
        tiles.kernel(SOURCE, place)(n, points, **scene)
    if relaxations:
        with device.stage("relax"):
            points = _relax(tiles, points, n, relaxations, scene)
    with device.stage("histopyramid"):
        pyramid = build_histopyramid(quad_counts, n)
    with device.stage("quads"):
        quads = device.empty(4 * pyramid.total, np.uint32)
        list_quads = tiles.kernel(SOURCE, "list_quads")
        list_quads(pyramid.total, quads, **pyramid.arguments, **scene)
    return points, quads, pyramid.total


def _relax(
    tiles: Tiles, points: Array, cubes: int, relaxations: int, scene: dict[str, Any]
) -> Array:
    """Return the vertices, moved towards the mean of their neighbours in several rounds."""
    device, vertices = tiles.device, points.size // 3
    linked = device.empty(exclusive_scan(scene["first_link"], cubes), np.uint32)
    link_start = device.empty(vertices + 1, np.uint32)
    tiles.kernel(SOURCE, "link_vertices")(cubes, link_start, linked, **scene)
    moved = device.empty(3 * vertices, np.int32)
    for _ in range(relaxations):
        tiles.kernel(SOURCE, "relax")(vertices, points, link_start, linked, moved)
        points, moved = moved, points
    return points


def split_quads(tiles: Tiles, points: Array, quads: Array, n: int) -> Array:
    """Return two triangles for each quad, none of zero area, (6 n,) uint32."""
    triangles = tiles.device.empty(6 * n, np.uint32)
    tiles.kernel(SOURCE, "split_quads")(n, quads, points, triangles)
    return triangles
