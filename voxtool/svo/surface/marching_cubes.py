"""Marching cubes: a vertex on each cut edge [Lorensen 1987].

A work-item writes the vertices and triangles of a tile. The edges that its cubes share with those
of the next tiles are numbered first, so that a triangle's vertices are read from a table. With a
histogram pyramid in place of the scan, a work-item writes one vertex or one triangle [Dyken 2008];
vertices are shared, so the pyramid gives the first number of each tile, too.

Kernels: marching_cubes.cl and per_output.cl in kernels/svo/surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from voxtool.opencl.histopyramid import histopyramid
from voxtool.opencl.primitives import scan_runs
from voxtool.svo.surface.cut_cells import Extracted, Tiles, check_edges, count_lost

SOURCE, PER_OUTPUT = (f"svo/surface/{name}.cl" for name in ("marching_cubes", "per_output"))


def march_cubes(tiles: Tiles, counted: Callable[..., None], arity: int | None = None) -> Extracted:
    """Return the surface of the tiles; `arity` is that of a histogram pyramid, None for a scan.
    Before memory is taken for it, `counted` is called with `tiles=`, `cubes=` and `edges=`.
    MemoryLimitError is raised if there are MAX_EDGES edges or more."""
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
        if arity is None:
            vertices, triangles, cubes = scan_runs(first, n, 3)
        else:
            pyramid = histopyramid(first, n, 3, arity)
            pyramid.number(first)
            scene |= pyramid.arguments
            vertices, triangles, cubes = pyramid.sums
        check_edges(vertices)
        counted(tiles=n, cubes=cubes, edges=vertices)
    with device.stage("triangles"):
        points = device.empty(3 * vertices, np.int32)
        faces = device.empty(3 * triangles, np.uint32)
        scene |= {"points": points, "triangles": faces}
        if arity is None:
            tiles.kernel(SOURCE, "polygonise")(n, **scene)
        else:
            tiles.kernel(PER_OUTPUT, "place_vertex", ARITY=arity)(vertices, **scene)
            tiles.kernel(PER_OUTPUT, "place_triangle", ARITY=arity)(triangles, **scene)
    return Extracted(cubes, lost, points, faces, first, 3)
