"""Marching cubes: a vertex on each cut edge [Lorensen 1987].

A work-item writes the vertices and triangles of a tile. The edges that its cubes share with those
of the next tiles are numbered first, so that a triangle's vertices are read from a table.

Kernels: kernels/svo/surface/marching_cubes.cl.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from voxtool.opencl.primitives import scan_runs
from voxtool.svo.surface.cut_cells import Extracted, Tiles, check_edges, count_lost

SOURCE = "svo/surface/marching_cubes.cl"


def march_cubes(tiles: Tiles, counted: Callable[..., None]) -> Extracted:
    """Return the surface of the tiles. Before memory is taken for it, `counted` is called with
    `tiles=`, `cubes=` and `edges=`. MemoryLimitError is raised if there are MAX_EDGES edges or
    more."""
    device, n = tiles.device, tiles.n
    first = device.empty(3 * n + 1, np.uint32)
    scene = {
        **tiles.arguments,
        "cut": device.empty(n, np.uint64),
        "cases": device.empty(64 * n, np.uint8),
        "cut_edges": device.empty(3 * n, np.uint64),
        "first": first,
    }
    with device.stage("classify"):
        tiles.kernel(SOURCE, "classify_tiles")(n, **scene)
        lost = count_lost(tiles, scene["cut"])  # read with the surface
        vertices, triangles, cubes = scan_runs(first, n, 3)
        check_edges(vertices)
        counted(tiles=n, cubes=cubes, edges=vertices)
    with device.stage("triangles"):
        points = device.empty(3 * vertices, np.int32)
        faces = device.empty(3 * triangles, np.uint32)
        tiles.kernel(SOURCE, "polygonise")(n, points=points, triangles=faces, **scene)
    return Extracted(cubes, lost, points, faces, first, 3)
