"""Marching cubes over the cut cubes of an octree.

Each cut edge has a vertex (Lorensen and Cline 1987). A 5:1 histopyramid over the triangle counts of
the cubes gives each triangle a work-item, which finds its cube through the pyramid.

Kernels: kernels/svo/surface/marching_cubes.cl.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl.primitives import build_histopyramid

if TYPE_CHECKING:
    from voxtool.opencl import Array, Device
    from voxtool.svo.surface.cut_cells import CutCubes, Tiles

SOURCE = "svo/surface/marching_cubes.cl"


def march_cubes(device: Device, tiles: Tiles, cubes: CutCubes) -> tuple[Array, Array]:
    """The vertices, (3 V,) int32 as `Isosurface.points`, and the triangles, (3 F,) uint32."""
    options = tiles.field.options
    with device.stage("vertices"):
        points = device.empty(3 * cubes.edges, np.int32)
        place_vertices = device.kernel(SOURCE, "place_vertices", **options)
        place_vertices(
            tiles.n, tiles.codes, *tiles.arguments, *tiles.sample_arguments,
            cubes.cut_edges, cubes.first_edge, tiles.shift, points,
        )  # fmt: skip
    with device.stage("histopyramid"):
        counts = device.empty(cubes.n, np.uint32)
        count_triangles = device.kernel(SOURCE, "count_triangles", **options)
        count_triangles(cubes.n, cubes.cases, counts)
        pyramid = build_histopyramid(counts, cubes.n)
    with device.stage("triangles"):
        triangles = device.empty(3 * pyramid.total, np.uint32)
        polygonise = device.kernel(SOURCE, "polygonise", **options)
        polygonise(
            pyramid.total, *pyramid.arguments, tiles.codes,
            *tiles.arguments, cubes.places, cubes.cases, cubes.cut_edges, cubes.first_edge,
            triangles,
        )  # fmt: skip
    return points, triangles
