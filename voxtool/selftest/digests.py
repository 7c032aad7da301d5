"""Digests of small octrees, surfaces, fields and pictures, the same on every device.

tests/golden/selftest.py writes digests.json.
"""

from __future__ import annotations

import hashlib
import json
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.camera import Camera
from voxtool.choices import FILLS, MARCHING_CUBES, METHODS, SHARP, STYLES
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device
from voxtool.pictures.rendering import render
from voxtool.selftest import shapes
from voxtool.selftest.case import Case
from voxtool.svo.surface.extract import extract
from voxtool.svo.voxelization.voxelize import voxelize
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import named
from voxtool.tets.volume.mesh import UnstructuredMesh

if TYPE_CHECKING:
    from collections.abc import Iterator

    Digests = Iterator[tuple[str, str]]

STORED = Path(__file__).with_name("digests.json")
SIZE = (48, 40)


def solid() -> Mesh:
    """Return a ball and a box that passes through it: closed, with self-intersections."""
    bar = shapes.box(np.array([-1.5, -0.25, -0.375]), np.array([1.25, 0.375, 0.125]))
    return mesh_from_arrays(*shapes.join(shapes.ball(2), bar))


def hollow() -> Mesh:
    """Return a box without a side."""
    vertices, faces = shapes.box(np.zeros(3), np.array([7.0, 9.0, 8.0]))
    return mesh_from_arrays(vertices, faces[2:])


def octrees(device: Device) -> Digests:
    modes = {"surface26": {"mode": "surface26"}, "surface6": {"mode": "surface6"}}
    options: dict[str, Any] = modes | {fill: {"fill": fill} for fill in FILLS}
    for (name, mesh), dim in product((("solid", solid()), ("hollow", hollow())), (8, 50, 200)):
        grid = Grid.fit(mesh, dim)
        for kind, given in options.items():
            yield f"{name} {kind} {dim}", voxelize(mesh, grid, device=device, **given).digest()


def surfaces(device: Device) -> Digests:
    octree = voxelize(solid(), Grid.fit(solid(), 50), device=device)
    for style in STYLES:
        more: dict[str, Any] = {"source": solid()} if style == SHARP else {}
        if style == MARCHING_CUBES:
            more["level"] = 0
        yield style, extract(octree, style=style, device=device, **more).digest()


def fields(device: Device) -> Digests:
    ball = mesh_from_arrays(*shapes.ball(2))
    for name, mesh in (("ball", ball), ("solid", solid()), ("hollow", hollow())):
        yield name, build_adf(mesh, device, tolerance=4e-3, max_level=5).digest()


def pictures(device: Device) -> Digests:
    mesh = solid()
    rays = Camera.fit(*mesh.bounds).rays(*SIZE)
    octree = voxelize(mesh, Grid.fit(mesh, 50), device=device)
    yield "octree", _digest(render(octree, rays, device=device))
    field = build_adf(mesh, device, tolerance=4e-3, max_level=5)
    yield "field", _digest(render(field, rays, device=device))
    points, cells = shapes.tetrahedra(*[np.linspace(-1, 1, 6)] * 3)
    x, y, z = points.T
    volume = build_tet(
        UnstructuredMesh(points, [("tetra", cells)], x * x + y * z, "s"), device=device
    )
    transfer = named("viridis", *volume.scalar_range, 2 / 24)
    rays = Camera.fit(*volume.bounds()).rays(*SIZE)
    for method in METHODS:
        picture = render(volume, rays, transfer=transfer, method=method, device=device)
        yield f"volume {method}", _digest(picture)


def _digest(picture: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(picture, "<f4").data).hexdigest()


KINDS = {make.__name__: make for make in (octrees, surfaces, fields, pictures)}


def stored() -> dict[str, dict[str, str]]:
    """Return the digests of digests.json, by kind and name."""
    return json.loads(STORED.read_text(encoding="utf-8"))


def differing(device: Device, kind: str, expected: dict[str, str]) -> int:
    """Return the number of digests of a kind that differ from the expected ones, or are missing."""
    found = dict(KINDS[kind](device))
    return sum(found.get(name) != expected.get(name) for name in found.keys() | expected.keys())


def _case(kind: str) -> Case:
    def measure(device: Device, full: bool) -> int:
        return differing(device, kind, stored()[kind])

    what = "the same bit for bit on every device"
    return Case(f"digests of {kind}", what, "digests wrong", 0, measure)


CASES = tuple(map(_case, KINDS))
