"""Exact distances: their error against the time of asking at points, on dense grids, and between
meshes.

Errors are those of the magnitudes, against rational arithmetic at a few of the points; between
meshes they are the width of the bounds, and how far the largest distance of samples may be off.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.survey import cube_of
from voxtool.bench import timing
from voxtool.bench.references import distance_errors
from voxtool.choices import SURFACE_NETS
from voxtool.distances import plan_distance, plan_distance_grid
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.selftest.oracles import distances
from voxtool.spatial.distance import TriangleDistance
from voxtool.spatial.hausdorff import hausdorff
from voxtool.spatial.sampling import SurfaceSampler, sample_cube
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

SURFACE_DIM = 64  # of the voxels whose surface a model is compared with
TOLERANCES = (1e-2, 1e-4, 1e-6)  # of bounds, in sides of the cube
SAMPLES = (1000, 100_000)  # of each mesh
CHECKED = 32  # points at which errors are measured
ROUNDING = 1e-9  # relative error that the filter of triangles allows for
LOCATED = {"gradient": True, "nearest": True, "face": True}


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    mesh = load_mesh(bench.model)
    yield from _at_points(mesh, bench)
    yield from _grids(mesh, bench)
    yield from _between_meshes(mesh, bench)


def build_seconds(mesh: Mesh, bench: Bench) -> float:
    """Return median seconds to decide what is inside of a mesh that the device does not have, and
    to prepare exact distances to it."""
    plan = partial(plan_distance, fill=bench.request.fill, device=bench.timed)
    return statistics.median(timing.times(lambda: plan(replace(mesh)).run(), bench.request.repeat))


def _at_points(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Yield distances at one point, a thousand, and many; with and without nearest points."""
    asked, (origin, side) = bench.request, cube_of(mesh)
    places = origin + side * sample_cube(asked.points)
    exact = exact_distances(mesh, places[:CHECKED])
    figures = {"triangles": len(mesh.faces), "build": build_seconds(mesh, bench)}
    every = {
        device: plan_distance(mesh, fill=asked.fill, device=device).run()
        for device in (bench.timed, bench.profiled)
    }
    sign = every[bench.timed].sign
    methods = {f"sign {sign}": {}, f"sign {sign}, gradient, nearest point, face": LOCATED}
    for count, (method, located) in product(sorted({1, 1000, asked.points}), methods.items()):
        some = places[:count]
        found = np.abs(every[bench.timed](some[:CHECKED]))
        yield bench.point(
            f"exact distances at {count:,} random point{'s' * (count > 1)}", method,
            run=lambda device, some=some, located=located: every[device](some, **located),
            asked={"points": count, "fill": asked.fill}, figures=figures, places=count,
            errors=distance_errors(found, exact[:count], side),
        )  # fmt: skip


def _grids(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Yield distances at all voxel centres, with the signs of each fill rule."""
    asked, chosen = bench.request, {}
    for dim, fill in product(asked.grids, sorted(asked.fills, key="auto".__ne__)):
        grid = Grid.fit(mesh, dim)
        plan = partial(plan_distance_grid, grid=grid, fill=fill)
        job = plan(mesh, device=bench.timed)
        rule = job.voxels.plan.fill if job.voxels else "none"
        if fill == "auto":
            chosen[dim] = rule
        elif fill == chosen.get(dim):  # measured already
            continue
        made, count = job.run(), int(np.prod(grid.shape))
        cells = np.unravel_index(np.arange(CHECKED) * count // CHECKED, grid.shape)
        exact = exact_distances(mesh, grid.to_world(np.stack(cells, axis=1) + 0.5))
        yield bench.point(
            "mesh to dense grid of distances",
            f"fill {fill}" + (f" ({rule})" if fill == "auto" else ""), f"dim {dim}",
            run=lambda device, plan=plan: plan(replace(mesh), device=device).run(),
            asked={"grids": dim, "fills": fill}, places=count, size=count, size_of="voxels",
            errors=distance_errors(np.abs(made[cells]), exact, cube_of(mesh)[1]),
            left_out=job.left_out, bytes=made.nbytes,
        )  # fmt: skip


def _between_meshes(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Yield the Hausdorff distance to the surface of the model's voxels, by bounds and by
    samples."""
    octree = plan_voxelize(mesh, Grid.fit(mesh, SURFACE_DIM), device=bench.timed).run()
    surface = plan_extract(octree, style=SURFACE_NETS, device=bench.timed).run().mesh()
    work, side = f"Hausdorff distance to the surface of dim {SURFACE_DIM}", cube_of(mesh)[1]
    figures = {"triangles": len(mesh.faces) + len(surface.faces)}
    best = math.inf
    for tolerance in sorted(TOLERANCES):
        found = hausdorff(mesh, surface, tolerance * side, bench.timed)
        best = min(best, found.upper)
        yield bench.point(
            work, "two bounds", f"tolerance {tolerance:g}",
            run=lambda device, most=tolerance * side: hausdorff(mesh, surface, most, device),
            setting={"tolerance": tolerance}, figures=figures,
            errors={"max": (found.upper - found.lower) / side},
        )  # fmt: skip
    for count in SAMPLES:
        run = partial(_largest_of_samples, mesh, surface, count)
        yield bench.point(
            work, "samples alone", f"{count:,} samples", run=run, setting={"samples": count},
            figures=figures, errors={"max": (best - run(bench.timed)) / side},
        )  # fmt: skip


def _largest_of_samples(a: Mesh, b: Mesh, count: int, device: Device) -> float:
    """Return the largest distance from samples of either mesh to the other."""
    return max(
        float(TriangleDistance(other, device)(points).max())
        for mesh, other in ((a, b), (b, a))
        for points in SurfaceSampler(mesh, "mesh").samples(count, count)
    )


def exact_distances(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return (N,) float64: distances in rational arithmetic, rounded once.

    Triangles whose box is farther from a point than some vertex are left out.
    """
    triangles = mesh.vertices[mesh.faces]
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    found = []
    for point in points:
        from_vertices = ((triangles[:, 0] - point) ** 2).sum(axis=1).min()
        outside = np.maximum(np.maximum(low - point, point - high), 0)
        near = (outside**2).sum(axis=1) <= from_vertices * (1 + ROUNDING)
        found.append(distances(point[None], triangles[near])[0])
    return np.array(found)
