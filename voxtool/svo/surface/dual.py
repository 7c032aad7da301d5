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

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import SURFACE_NETS
from voxtool.opencl.primitives import build_histopyramid, exclusive_scan

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Array, Device
    from voxtool.svo.surface.cut_cells import CutCubes, Tiles

SOURCE = "svo/surface/dual.cl"


def dual_surface(
    device: Device, tiles: Tiles, cubes: CutCubes, style: str, relaxations: int
) -> tuple[Array, Array, int]:
    """The vertices, (3 V,) int32 as `Isosurface.points`, the quads, (4 Q,) uint32, counter-
    clockwise seen from outside, and the number of quads."""

    def kernel(name: str) -> Callable[..., None]:
        return device.kernel(SOURCE, name, **tiles.sampling.options)

    resolved = device.empty(cubes.n, np.uint16)
    first_vertex, quad_counts, first_link = (device.empty(cubes.n + 1, np.uint32) for _ in range(3))
    scene = {
        **tiles.arguments,
        **cubes.arguments,
        "resolved": resolved,
        "first_vertex": first_vertex,
        "first_link": first_link,
    }
    with device.stage("classify"):
        kernel("resolve_cases")(cubes.n, quad_counts, **scene)
        vertices = exclusive_scan(first_vertex, cubes.n)
        links = exclusive_scan(first_link, cubes.n) if relaxations else 0
    with device.stage("vertices"):
        points = device.empty(3 * vertices, np.int32)
        place = "place_means" if style == SURFACE_NETS else "place_corners"
        kernel(place)(cubes.n, points, **scene)
    if relaxations:
        with device.stage("relax"):
            points = _relax(device, kernel, points, cubes.n, links, relaxations, scene)
    with device.stage("histopyramid"):
        pyramid = build_histopyramid(quad_counts, cubes.n)
    with device.stage("quads"):
        quads = device.empty(4 * pyramid.total, np.uint32)
        kernel("list_quads")(pyramid.total, quads, **pyramid.arguments, **scene)
    return points, quads, pyramid.total


def _relax(
    device: Device,
    kernel: Callable[[str], Callable[..., None]],
    points: Array,
    cubes: int,
    links: int,
    relaxations: int,
    scene: dict[str, Any],
) -> Array:
    """The vertices, moved towards the mean of their neighbours in several rounds."""
    vertices = points.size // 3
    link_start = device.empty(vertices + 1, np.uint32)
    linked = device.empty(links, np.uint32)
    kernel("link_vertices")(cubes, link_start, linked, **scene)
    moved = device.empty(3 * vertices, np.int32)
    for _ in range(relaxations):
        kernel("relax")(vertices, points, link_start, linked, moved)
        points, moved = moved, points
    return points


def split_quads(device: Device, tiles: Tiles, points: Array, quads: Array, n: int) -> Array:
    """(6 n,) uint32: two triangles for each quad, none of zero area."""
    triangles = device.empty(6 * n, np.uint32)
    device.kernel(SOURCE, "split_quads", **tiles.sampling.options)(n, quads, points, triangles)
    return triangles
