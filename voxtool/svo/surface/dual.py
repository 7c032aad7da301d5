"""Dual surfaces of an octree: blocks, the exact boundary of the samples; nets, a smooth surface.

A vertex each loop of a cut cube, a quad each cut edge (Nielson 2004); how loops are told apart, so
that the surface is manifold, is in cases.py. Blocks put a vertex in the middle of its cube, the
corner that eight samples share: quads are the faces of samples. Nets (Gibson 1998) begin in the
mean of the loop's crossings. Where samples are voxels, which say no more than inside or not, they
then move towards the mean of the neighbours, but never leave their cube; coverages need no such
smoothing.

Kernels: kernels/svo/surface/dual.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl import Array, Device
from voxtool.opencl.primitives import build_histopyramid, exclusive_scan
from voxtool.svo.surface.cut_cells import CutCubes, Tiles

if TYPE_CHECKING:
    from collections.abc import Callable

SOURCE = "svo/surface/dual.cl"


def dual_surface(
    device: Device, tiles: Tiles, cubes: CutCubes, style: str, relaxations: int
) -> tuple[Array, Array, int]:
    """The points of the vertices, (3 V,) int32 as in Isosurface, the quads, (4 Q,) uint32, counter-
    clockwise seen from outside, and how many quads there are; of blocks, or of nets."""

    def kernel(name: str) -> Callable[..., None]:
        return device.kernel(SOURCE, name, **tiles.field.options)

    nets, relaxed = style == "nets", relaxations > 0
    n = np.uint32(cubes.n)
    resolved = device.empty(cubes.n, np.uint16)
    first_vertex, quad_counts, first_link = (device.empty(cubes.n + 1, np.uint32) for _ in range(3))
    with device.stage("classify"):
        kernel("resolve_cases")(
            cubes.n, tiles.codes, *tiles.arguments, *cubes.lookup, cubes.places, cubes.cases, n,
            resolved, first_vertex, quad_counts, first_link,
        )  # fmt: skip
        vertices = exclusive_scan(first_vertex, cubes.n)
        links = exclusive_scan(first_link, cubes.n) if relaxed else 0
    with device.stage("vertices"):
        points = device.empty(3 * vertices, np.int32)
        shift = np.int32(tiles.shift)
        if nets:
            kernel("place_means")(
                cubes.n, tiles.codes, *tiles.arguments, *tiles.sample_arguments, cubes.places,
                resolved, n, first_vertex, shift, points,
            )  # fmt: skip
        else:
            kernel("place_corners")(
                cubes.n, tiles.codes, cubes.places, n, first_vertex, shift, points
            )
    if relaxed:
        with device.stage("relax"):
            link_start = device.empty(vertices + 1, np.uint32)
            linked = device.empty(links, np.uint32)
            kernel("link_vertices")(
                cubes.n, tiles.codes, *tiles.arguments, *cubes.lookup, cubes.places, resolved, n,
                first_vertex, first_link, link_start, linked,
            )  # fmt: skip
            moved = device.empty(3 * vertices, np.int32)
            for _ in range(relaxations):
                kernel("relax")(vertices, points, link_start, linked, np.uint32(vertices), moved)
                points, moved = moved, points
            for array in (link_start, linked, moved):
                array.release()
    with device.stage("histopyramid"):
        pyramid = build_histopyramid(quad_counts, cubes.n)
    with device.stage("quads"):
        quads = device.empty(4 * pyramid.total, np.uint32)
        kernel("list_quads")(
            pyramid.total, *pyramid.arguments, np.uint32(pyramid.total), tiles.codes,
            *tiles.arguments, *cubes.lookup, cubes.places, resolved, first_vertex, quads,
        )  # fmt: skip
    for array in (pyramid, resolved, first_vertex, quad_counts, first_link):
        array.release()
    return points, quads, pyramid.total


def split_quads(device: Device, tiles: Tiles, points: Array, quads: Array, n: int) -> Array:
    """(6 Q,) uint32: two triangles a quad, none of zero area; the quads are consumed."""
    triangles = device.empty(6 * n, np.uint32)
    split = device.kernel(SOURCE, "split_quads", **tiles.field.options)
    split(n, quads, np.uint32(n), points, triangles)
    quads.release()
    return triangles
