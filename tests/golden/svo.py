"""The golden digests of octrees: which there are, and (run as a script) writing them anew.

Digests change only together with a line in CHANGELOG.md that says why:
    make golden KIND=svo
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from helpers import meshes

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import make_bunny

import voxtool
from voxtool.choices import FRACTION_TYPES
from voxtool.mesh.appearance import Appearance, Parts

GOLDEN = Path(__file__).parent / "svo.json"
MODELS = Path(__file__).parents[3] / "shared" / "models"
MODES = ("surface26", "surface6", "solid", "solid+surface26")  # solid by parity
FILLS = (("nonzero", 0), ("winding", 0), ("flood", 0), ("flood", 3))
FILL_DIM = 128  # the largest
OWN = ("bunny", "sphere", "torus", "open-box", "needles", "helix")
MORPHS = {50: ("dilate", 2.5), 128: ("close", 4.0)}  # of the solid, by dim
FRACTION_DIM = 200  # the largest with fractions
ATTRIBUTES_DIM = 50  # of octrees with labels, colours and normals
CONNECTED_DIMS = (64, 128)  # of solids whose thin parts are connected
POINTS_DIM = 50  # of the octree that is queried at points
DIMS = (8, 50, 64, 200, 512)
REAL = ("stanford-bunny", "armadillo", "dragon", "nefertiti", "fandisk", "rocker-arm", "spot",
        "suzanne", "teapot")  # fmt: skip
REAL_DIMS = (128, 512)


@cache
def own_mesh(name: str) -> voxtool.Mesh:
    """A mesh of the project's own making, made once."""
    if name == "bunny":
        return voxtool.mesh_from_arrays(*make_bunny.make_bunny())
    if name == "sphere":
        return voxtool.mesh_from_arrays(*lattice_points(meshes.icosphere(4, 0.0, 1.0)))
    if name == "torus":
        return voxtool.mesh_from_arrays(*lattice_points(meshes.torus()))
    if name == "open-box":
        return voxtool.mesh_from_arrays(*meshes.open_box((0, 0, 0), (7, 9, 8)))
    if name == "helix":
        turns = np.linspace(0, 4 * np.pi, 200)
        points = np.stack([np.cos(turns), np.sin(turns), turns / 5], axis=1)
        return voxtool.mesh_from_arrays(*lattice_points(meshes.tube(points, 0.01)))
    rng = np.random.default_rng(11)
    vertices, faces = meshes.random_triangles(rng, 300, (64, 64, 64), margin=0)
    vertices[2::3] = vertices[1::3] + rng.integers(-1, 2, (300, 3))
    return voxtool.mesh_from_arrays(vertices, faces)


def lattice_points(mesh: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Rounded to 2**-20, so that no sine or cosine of this machine's shows."""
    return np.rint(mesh[0] * 2**20) / 2**20, mesh[1]


def digests(mesh: voxtool.Mesh, dims: tuple[int, ...], device: object) -> Iterator[tuple[str, str]]:
    """Name and digest of the octree of every mode and fill rule at every dim."""
    for dim in dims:
        grid = voxtool.Grid.fit(mesh, dim)
        for mode in MODES:
            base, _, surface = mode.partition("+")
            more: dict[str, Any] = {"with_surface": bool(surface), "fill": "parity"}
            octree = voxtool.voxelize(mesh, grid, base, device=device, **more)
            yield f"{mode} {dim}", octree.digest()
        for kind in FRACTION_TYPES if dim <= FRACTION_DIM else ():
            more = {"fraction_type": kind, "fill": "parity", "device": device}
            octree = voxtool.voxelize(mesh, grid, "fraction", **more)
            yield f"fraction {kind} {dim}", octree.digest()
        if dim <= FRACTION_DIM:
            more = {"face_fractions": True, "fill": "parity", "device": device}
            octree = voxtool.voxelize(mesh, grid, "fraction", **more)
            yield f"faces {dim}", octree.digest()
        for fill, gap in FILLS if dim <= FILL_DIM else ():
            octree = voxtool.voxelize(mesh, grid, fill=fill, gap=gap, device=device)
            yield f"{octree.fill} {dim}", octree.digest()
        if dim in CONNECTED_DIMS:
            more = {"fill": "nonzero", "connected": True, "device": device}
            yield f"connected {dim}", voxtool.voxelize(mesh, grid, **more).digest()
        if dim == ATTRIBUTES_DIM:
            yield from attributed(mesh, grid, device)
        if dim == POINTS_DIM:
            answers = voxtool.query_svo(
                octree, points_of(mesh), level=0, nearest=True, device=device
            )
            yield f"points {dim}", golden_of(answers)
        if dim in MORPHS:
            solid = voxtool.voxelize(mesh, grid, fill="parity", device=device)
            changed = voxtool.morph(solid, *MORPHS[dim], device=device)
            yield f"{' '.join(map(str, MORPHS[dim]))} {dim}", changed.digest()


def attributed(mesh: voxtool.Mesh, grid: voxtool.Grid, device: Any) -> Iterator[tuple[str, str]]:
    """Digests of octrees with labels of three parts, each every third face or a shell, and with
    colours and normals, also of exposed voxels of solids, and with areas."""
    thirds = Parts(np.arange(len(mesh.faces), dtype=np.int32) % 3, ("a", "b", "c"))
    for mode, labels in (("surface26", thirds), ("surface6", thirds), ("solid", "shell")):
        octree = voxtool.voxelize(mesh, grid, mode, labels=labels, fill="parity", device=device)
        yield f"labels {mode} {grid.dim}", octree.digest()
    more = {"labels": thirds, "fill": "nonzero", "device": device}
    octree = voxtool.voxelize(mesh, grid, "fraction", **more)
    yield f"labels fraction {grid.dim}", octree.digest()
    colours = np.mod(np.arange(4 * len(mesh.vertices)), 7).reshape(-1, 4) / 8
    look = Appearance((), np.full(len(mesh.faces), -1, np.int32), colours=colours)
    coloured = replace(mesh, appearance=look)
    request: dict[str, Any] = {"attributes": ("colour", "normal"), "device": device}
    octree = voxtool.voxelize(coloured, grid, "surface26", **request)
    yield f"colours {grid.dim}", octree.digest()
    octree = voxtool.voxelize(coloured, grid, fill="parity", **request)
    yield f"colours solid {grid.dim}", octree.digest()
    request["attributes"] = ("area",)
    yield f"areas {grid.dim}", voxtool.voxelize(mesh, grid, "surface26", **request).digest()


def points_of(mesh: voxtool.Mesh) -> np.ndarray:
    """Points in the mesh's box and around it, on a lattice that is skew to its axes, (1000, 3)."""
    places = np.arange(1000)[:, None] * np.array([0.618, 0.414, 0.236]) % 1
    low, high = mesh.bounds
    return low + (high - low) * (1.25 * places - 0.125)


def golden_of(answers: voxtool.OctreeAnswers) -> str:
    """The SHA-256 of answers at points."""
    parts = (answers.contains, answers.outside, answers.coverage, answers.nearest, answers.distance)
    table = np.column_stack([part for part in parts if part is not None])
    return hashlib.sha256(table.astype("<f8").tobytes()).hexdigest()


def main() -> None:
    device = voxtool.open_device()
    golden = {name: dict(digests(own_mesh(name), DIMS, device)) for name in OWN}
    for name in REAL:
        mesh = voxtool.load_mesh(MODELS / f"{name}.obj")
        golden[f"{name}.obj"] = dict(digests(mesh, REAL_DIMS, device))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
