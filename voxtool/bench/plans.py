"""Measures what plans leave out, and what that saves in time and bytes, in ten scenes of each wing.

The models are the names of the scenes, which are generated. Each has the ablations (ablation.py) of
what its plan leaves out where a decision can undo it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation
from voxtool.camera import Camera
from voxtool.choices import MARCHING_CUBES
from voxtool.distances import plan_field
from voxtool.errors import VoxtoolError
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.pictures.rendering import plan_render
from voxtool.selftest.crowds import needles
from voxtool.selftest.shapes import ball, box, join, octahedron, tetrahedra
from voxtool.spatial.sampling import sample_cube
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.vector import length

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Ablation
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.selftest.shapes import Shape

POINTS = 1 << 14  # at which the distances of a field are asked for
FIELD = {"tolerance": 1e-3, "max_level": 6, "measure": False}
UNIT = box(np.zeros(3), np.ones(3))


def _moved(shape: Shape, scale: float, by: float) -> Shape:
    return shape[0] * scale + by, shape[1]


@cache
def _sphere(level: int = 4) -> Shape:
    vertices, faces = ball(level)
    return np.asarray(vertices, float), faces


def _holed() -> Shape:
    return _sphere()[0], _sphere()[1][7:]


def _overlapping() -> Shape:
    return join(_sphere(), _moved(_sphere(), 0.5, 0.7))


def _hollow() -> Shape:
    inner = _moved(_sphere(), 0.5, 0.0)
    return join(_sphere(), (inner[0], inner[1][:, ::-1]))


def _plate() -> Shape:
    return UNIT[0] * (1, 1, 0.01), UNIT[1]


VOXELS = {  # a shape, its dim, and what is asked for
    "cube": (lambda: UNIT, 64, {}),
    "large-cube": (lambda: UNIT, 512, {}),
    "octahedron": (lambda: octahedron(np.zeros(3), 1), 256, {"mode": "surface26"}),
    "ball": (_sphere, 128, {}),
    "ball-surface": (_sphere, 256, {"mode": "surface6"}),
    "ball-with-hole": (_holed, 128, {}),
    "flooded-ball": (_sphere, 64, {"fill": "flood"}),
    "balls": (_overlapping, 128, {}),
    "hollow-ball": (_hollow, 128, {}),
    "needles": (lambda: needles(4000), 256, {"mode": "surface26"}),
}
FIELDS = {  # a shape, and what is asked for
    "cube": (lambda: UNIT, {}),
    "octahedron": (lambda: octahedron(np.zeros(3), 1), {"tolerance": 1e-4}),
    "ball": (_sphere, {}),
    "band-of-ball": (_sphere, {"band": 0.02}),
    "ball-with-cracks": (_sphere, {"continuous": False}),
    "coarse-ball": (lambda: _sphere(6), {"tolerance": 0.1}),
    "ball-with-hole": (_holed, {}),
    "balls": (_overlapping, {}),
    "hollow-ball": (_hollow, {}),
    "plate": (_plate, {}),
}
VOLUMES = {  # cubes a side, what is shown of the distances from a corner, and what is asked for
    "whole": (24, (0.0, 1.0), {}),
    "outer-half": (24, (0.5, 1.0), {}),
    "slab": (24, (0.45, 0.55), {}),
    "corner": (24, (0.0, 0.1), {}),
    "fine-corner": (48, (0.0, 0.05), {}),
    "steep-slab": (24, (0.45, 0.46), {}),
    "projected-whole": (24, (0.0, 1.0), {"method": "projection"}),
    "projected-slab": (24, (0.45, 0.55), {"method": "projection"}),
    "corner-behind-surface": (24, (0.0, 0.1), {"isovalues": [0.3]}),
    "six-cells": (1, (0.0, 1.0), {}),
}
PIXELS = 256  # along a side of their pictures
KINDS = (
    *(f"voxels-{name}" for name in VOXELS),
    *(f"field-{name}" for name in FIELDS),
    *(f"volume-{name}" for name in VOLUMES),
)


def check_kind(name: str) -> None:
    """Raise VoxtoolError if no scene has the name."""
    if name not in KINDS:
        raise VoxtoolError(f"no scene is {name!r}: choose {', '.join(KINDS)}")


def measure(bench: Bench) -> Iterator[Ablation]:
    """Yield the ablations of a scene, which the model names."""
    wing, _, name = bench.model.partition("-")
    if wing == "voxels":
        shape, dim, request = VOXELS[name]
        yield from _of_voxels(mesh_from_arrays(*shape()), dim, request, bench)
    elif wing == "volume":
        cubes, shown, request = VOLUMES[name]
        yield from _of_volume(cubes, shown, request, bench)
    else:
        shape, request = FIELDS[name]
        yield from _of_field(mesh_from_arrays(*shape()), {**FIELD, **request}, bench)


def _of_voxels(mesh: Mesh, dim: int, request: dict[str, Any], bench: Bench) -> Iterator[Ablation]:
    job = plan_voxelize(mesh, Grid.fit(mesh, dim), device=bench.timed, **request)
    octree = job.run()
    job.settle()
    yield from ablation.of_left_out_voxels(job, bench, f"{job.plan.mode}, dim {dim}")
    if job.plan.solid:
        surface = plan_extract(octree, style=MARCHING_CUBES, device=bench.timed)
        yield from ablation.of_cubes(surface, bench, f"{MARCHING_CUBES}, dim {dim}")


def _of_field(mesh: Mesh, request: dict[str, Any], bench: Bench) -> Iterator[Ablation]:
    job = plan_field(mesh, device=bench.timed, **request)
    limits = f"levels to {request['max_level']}, tolerance {request['tolerance']:g}"
    yield from ablation.of_field(job, bench, f"mesh to field, {limits}")
    field = replace(job.run())
    points = np.array(field.origin) + field.side * sample_cube(POINTS)
    yield from ablation.of_queries(field, points, bench, f"{POINTS:,} distances, {limits}")


def _of_volume(
    cubes: int, shown: tuple[float, float], request: dict[str, Any], bench: Bench
) -> Iterator[Ablation]:
    planes = np.linspace(0, 1, cubes + 1)
    points, cells = tetrahedra(planes, planes, planes)
    scalars = length(points) / np.sqrt(3)
    volume = build_tet(
        UnstructuredMesh(points, [("tetra", cells)], scalars, "s"),
        request.get("method", "raycast"),
        device=bench.timed,
    )
    low, high = shown
    transfer = TransferFunction(
        np.array([low, (low + high) / 2, high]), np.ones((3, 3)), np.array([0, 1 / (high - low), 0])
    )
    rays = Camera.fit(np.zeros(3), np.ones(3), bench.request.view, fov=None).rays(PIXELS, PIXELS)
    job = plan_render(volume, rays, transfer=transfer, device=bench.timed, **request)
    yield from ablation.of_picture(job, bench, f"frames of {len(cells):,} cells")
