"""Growth of time with the size of the work: triangles, dims, leaves, pixels and cells.

A model is subdivided, each triangle in four or each tetrahedron in eight, again and again. Its
shape stays the same, so errors do too. The errors of dims, leaves and pixels are measured by the
benches of their work.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.construction.survey import cube_of
from voxtool.adf.queries.query import query_adf
from voxtool.bench.request import is_volume
from voxtool.camera import Camera
from voxtool.choices import MARCHING_CUBES, SURFACE_NETS
from voxtool.distances import plan_distance, plan_field
from voxtool.files import read_unstructured
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.mesh.watertight import watertight
from voxtool.pictures.rendering import camera_for, plan_render, render
from voxtool.selftest.shapes import subdivide
from voxtool.spatial.sampling import sample_cube
from voxtool.svo.surface.extract import extract
from voxtool.svo.voxelization.voxelize import voxelize
from voxtool.tets.construction.conforming import tetrahedra
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import named
from voxtool.tets.volume.mesh import UnstructuredMesh, volume_cells

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

    Works = dict[str, Callable[[Device], object]]  # by method

DIM, LEVEL, TOLERANCE, POINTS, PIXELS = 256, 7, 1e-2, 1 << 16, 256
NETS_DIM = 2048  # the largest of surface nets, whose surfaces have two triangles a face of a voxel
SAME = {"rms": "subdivision does not change the shape: the other benches measure errors"}
ELSEWHERE = {"rms": "the other benches measure errors"}
# The eight parts of a tetrahedron: corners 0 to 3 are its own, 4 to 9 the midpoints of EDGES.
EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
PARTS = ((0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3),
         (4, 6, 8, 9), (4, 5, 6, 9), (4, 7, 5, 9), (4, 8, 7, 9))  # fmt: skip


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    if is_volume(bench.model):
        yield from _subdivided_volume(bench)
        return
    mesh = load_mesh(bench.model)
    yield from _subdivided_mesh(mesh, bench)
    for dim in bench.request.dims:
        yield from _of_dim(mesh, dim, bench)
    for level in bench.request.levels:
        yield from _of_level(mesh, level, bench)
    yield from _of_pixels(mesh, bench)


def _subdivided_mesh(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Work on a mesh, which is subdivided until it would have too many triangles."""
    yield from _of_mesh(mesh, bench)
    while 4 * len(mesh.faces) <= bench.request.triangles:
        mesh = mesh_from_arrays(*subdivide((mesh.vertices, mesh.faces)))
        yield from _of_mesh(mesh, bench)


def _subdivided_volume(bench: Bench) -> Iterator[Point]:
    """Work on a volume, which is subdivided until it would have too many cells."""
    read = read_unstructured(bench.model, bench.request.scalar, bench.request.component)
    volume = whole(read, bench.timed)
    yield from _of_volume(volume, bench)
    while 8 * len(volume.cells[0][1]) <= bench.request.cells:
        volume = eighths(volume)
        yield from _of_volume(volume, bench)


def _of_mesh(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Return each kind of work on a mesh that the device does not have."""
    grid, (origin, side) = Grid.fit(mesh, DIM), cube_of(mesh)
    places = origin + side * sample_cube(POINTS)
    works: Works = {
        "closed or not": lambda device: watertight(mesh, device),
        f"surface26, dim {DIM}": lambda device: voxelize(
            replace(mesh), grid, "surface26", device=device
        ),
        f"solid, parity, dim {DIM}": lambda device: voxelize(
            replace(mesh), grid, fill="parity", device=device
        ),
        f"field, levels to {LEVEL}, tolerance {TOLERANCE:g}": lambda device: plan_field(
            replace(mesh), tolerance=TOLERANCE, max_level=LEVEL, measure=False, device=device
        ).run(),
        f"exact distances at {POINTS:,} points": lambda device: plan_distance(
            replace(mesh), device=device
        ).run()(places),
    }
    count = len(mesh.faces)
    return _points(
        bench, "subdivided mesh", f"{count:,} triangles", works, absent=SAME,
        asked={"triangles": count}, size=count, size_of="triangles",
    )  # fmt: skip


def _of_dim(mesh: Mesh, dim: int, bench: Bench) -> Iterator[Point]:
    """Return octrees of a grid, and surfaces."""
    grid = Grid.fit(mesh, dim)
    octree = voxelize(mesh, grid, fill="parity", device=bench.timed)
    works: Works = {
        "surface26": lambda device: voxelize(mesh, grid, "surface26", device=device),
        "solid, parity": lambda device: voxelize(mesh, grid, fill="parity", device=device),
        "solid, auto": lambda device: voxelize(mesh, grid, device=device),
        MARCHING_CUBES: lambda device: extract(
            octree, style=MARCHING_CUBES, level=0, device=device
        ),
    }
    if dim <= NETS_DIM:
        works[SURFACE_NETS] = lambda device: extract(octree, style=SURFACE_NETS, device=device)
    return _points(
        bench, "finer grids", f"dim {dim}", works, absent=ELSEWHERE,
        asked={"dims": dim}, size=dim, size_of="dim",
    )  # fmt: skip


def _of_level(mesh: Mesh, level: int, bench: Bench) -> Iterator[Point]:
    """Return a field, and queries of it."""
    tolerance, (origin, side) = min(bench.request.tolerances), cube_of(mesh)
    places = origin + side * sample_cube(POINTS)
    build = partial(plan_field, mesh, tolerance=tolerance, max_level=level, measure=False)
    field = build(device=bench.timed).run()
    works: Works = {
        f"field, tolerance {tolerance:g}": lambda device: build(device=device).run(),
        f"queries at {POINTS:,} points": lambda device: query_adf(field, places, device=device),
    }
    return _points(
        bench, "finer fields", f"levels to {level}", works, absent=ELSEWHERE,
        asked={"levels": level, "tolerances": tolerance},
        size=field.reached["leaves"], size_of="leaves",
    )  # fmt: skip


def _of_pixels(mesh: Mesh, bench: Bench) -> Iterator[Point]:
    """Yield larger and larger pictures, one ray a pixel."""
    octree = voxelize(mesh, Grid.fit(mesh, DIM), device=bench.timed)
    field = plan_field(
        mesh, tolerance=TOLERANCE, max_level=LEVEL, measure=False, device=bench.timed
    ).run()
    camera = camera_for(octree, "iso", fov=None)
    for size in bench.request.sizes:
        draw = partial(plan_render, view=camera.rays(size, size), samples=1)
        works: Works = {
            f"octree, dim {DIM}": lambda device, draw=draw: draw(octree, device=device).run(),
            f"field, levels to {LEVEL}": lambda device, draw=draw: draw(field, device=device).run(),
        }
        yield from _points(
            bench, "larger pictures", f"{size} x {size}", works, absent=ELSEWHERE,
            asked={"sizes": size}, size=size**2, size_of="pixels",
        )  # fmt: skip


def _points(bench: Bench, work: str, label: str, works: Works, **fields: Any) -> Iterator[Point]:
    """Yield a point of each method; fields : of Bench.point."""
    for method, run in works.items():
        yield bench.point(work, method, label, run=run, **fields)


def _of_volume(volume: UnstructuredMesh, bench: Bench) -> Iterator[Point]:
    """Return the textures of a volume, and a frame."""
    made = build_tet(volume, device=bench.timed)
    low, high = made.bounds()
    transfer = named("viridis", *made.scalar_range, float((high - low).max()) / 8)
    rays = Camera.fit(low, high, "iso", fov=None).rays(PIXELS, PIXELS)
    works: Works = {
        "textures": lambda device: build_tet(volume, device=device),
        f"frame, {PIXELS} x {PIXELS}": lambda device: render(
            made, rays, transfer=transfer, device=device
        ),
    }
    count = len(volume.cells[0][1])
    return _points(
        bench, "subdivided volume", f"{count:,} cells", works, absent=SAME,
        asked={"cells": count}, size=count, size_of="cells",
    )  # fmt: skip


def whole(mesh: UnstructuredMesh, device: Device) -> UnstructuredMesh:
    """Return a mesh with its cells split into tetrahedra."""
    found = tetrahedra(device, volume_cells(mesh)).on_host()
    scalars = [found.scalars] if found.constant else found.scalars
    return UnstructuredMesh(found.vertices, [("tetra", found.cells)], scalars, mesh.scalar)


def eighths(mesh: UnstructuredMesh) -> UnstructuredMesh:
    """Return a mesh of tetrahedra, each cut in eight at the midpoints of its edges."""
    cells = mesh.cells[0][1]
    ends = np.sort(cells[:, EDGES].reshape(-1, 2), axis=1)
    ends, middle = np.unique(ends, axis=0, return_inverse=True)
    corners = np.concatenate([cells, middle.reshape(-1, 6) + len(mesh.points)], axis=1)
    points = np.concatenate([mesh.points, mesh.points[ends].mean(axis=1)])
    if isinstance(mesh.scalars, list):
        scalars = [np.repeat(mesh.scalars[0], 8)]
    else:
        scalars = np.concatenate([mesh.scalars, mesh.scalars[ends].mean(axis=1)])
    parts = corners[:, PARTS].reshape(-1, 4)
    return UnstructuredMesh(points, [("tetra", parts)], scalars, mesh.scalar)
