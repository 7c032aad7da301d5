"""Marching cubes over the cut cubes of an octree.

Each cut edge has a vertex [Lorensen 1987]. A 5:1 histopyramid over the triangle counts of the cubes
[voCCeL, section 4.1] gives each triangle a work-item, which finds its cube through the pyramid.

Kernels: kernels/svo/surface/marching_cubes.cl.
"""

from __future__ import annotations

import numpy as np

from voxtool.opencl import Array
from voxtool.opencl.primitives import build_histopyramid
from voxtool.svo.surface.cut_cells import CutCubes, Tiles

SOURCE = "svo/surface/marching_cubes.cl"


def march_cubes(tiles: Tiles, cubes: CutCubes) -> tuple[Array, Array]:
    """Return the vertices, (3 V,) int32 as `Isosurface.points`, and the triangles, (3 F,)
    uint32."""
    device = tiles.device
    scene = {**cubes.arguments, "first_vertex": cubes.arguments["first_edge"]}
    with device.stage("vertices"):
        points = device.empty(3 * cubes.edges, np.int32)
        tiles.kernel(SOURCE, "place_vertices")(tiles.n, points, **scene)
    with device.stage("histopyramid"):
        counts = device.empty(cubes.n, np.uint32)
        tiles.kernel(SOURCE, "count_triangles")(cubes.n, counts, **scene)
        pyramid = build_histopyramid(counts, cubes.n)
    with device.stage("triangles"):
        triangles = device.empty(3 * pyramid.total, np.uint32)
        polygonise = tiles.kernel(SOURCE, "polygonise")
        polygonise(pyramid.total, triangles, **pyramid.arguments, **scene)
    return points, triangles
