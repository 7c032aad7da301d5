"""Sets of voxels, and surfaces of them: error against run time."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation as forced
from voxtool.bench import extract as bench_extract
from voxtool.bench import peers, timing, voxels
from voxtool.bench import voxelize as bench_voxelize
from voxtool.bench.points import MEASURES, Point
from voxtool.bench.sweep.request import command
from voxtool.choices import MARCHING_CUBES, VOXEL_FACES
from voxtool.errors import count_of
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import volume
from voxtool.spatial.deviation import deviation
from voxtool.svo.fill.caps import find_caps
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.voxelize import voxelize
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Saving
    from voxtool.bench.sweep.request import Sweep
    from voxtool.opencl import Device

CAPPED_DIM = 4096  # of the lattice on which the boundary of a model is found
NO_AREA = {"area": "faces of voxels do not tend to the area"}
NO_SOLID = {"volume": "a set of voxels that a surface touches is no solid"}


def of_voxelize(
    model: str, asked: Sweep, timed: Device, profiled: Device
) -> Iterator[Point | Saving]:
    """Sets of voxels; the error is of their boundary."""
    mesh, name, others = load_mesh(model), Path(model).name, timing.Peers(asked.repeat)
    solid = Reference(*capped(mesh), asked.samples, timed, NO_AREA)
    surface = Reference(mesh, 0, asked.samples, timed, NO_AREA | NO_SOLID)
    for dim, mode in product(asked.dims, asked.modes):
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        against = solid if mode == "solid" else surface
        row = partial(
            Point, "voxelize", name, work_of(mode), label=f"dim {dim}", size=dim, size_of="dim"
        )
        request = {"dims": dim, "modes": mode, "fit": asked.fit, "samples": asked.samples}
        setting = {**request, "against": against.words}
        found: dict[str, Point] = {}
        for rule in asked.fills if mode == "solid" else ("auto",):
            work = partial(voxelize, mesh, grid, mode, fill=rule)
            octree = work(device=timed)
            method, rules = mode, {}
            if mode == "solid":
                method, rules = f"solid, {octree.fill}", {"fills": octree.fill}
            if method in found:
                continue  # auto chose what is asked for, too
            boundary = extract(octree, style=VOXEL_FACES, device=timed).mesh()
            point = row(
                method=method,
                setting={**setting, **rules},
                runs=asked.runs.times(partial(work, device=timed)),
                command=command("voxelize", model, asked, **request, **rules),
                **against.errors_of(boundary),
                stages=timing.stage_times(partial(work, device=profiled), profiled, 1)[0],
                left_out=octree.plan["left_out"],
                bytes=octree.nbytes,
            )
            if asked.commands:
                _, peak = bench_voxelize.whole_command(
                    model, dim, mode, rule, asked.fit, timed.info.index
                )
                point = replace(point, peak=peak)
            found[method] = point
        yield from found.values()
        for peer, run in peers.of(mesh, grid, mode).items() if asked.peers else ():
            runs, made = others.times(f"{peer}, {mode}", run)
            if runs:
                yield row(
                    method=f"{peer}, {mode}", setting=setting, runs=runs, peer=True,
                    command=command("voxelize", model, asked, **request),
                    **against.errors_of(voxels.of_peer(made, grid)),
                )  # fmt: skip
    if asked.forced:
        dim = max(asked.dims)
        for mode in asked.modes:
            about = {"bench": "voxelize", "model": name, "work": f"{mode}, dim {dim}"}
            grid = Grid.fit(mesh, dim, fit=asked.fit)
            yield from forced.of_voxelize(mesh, grid, mode, timed, asked.runs, about)


def of_extract(model: str, asked: Sweep, timed: Device, profiled: Device) -> Iterator[Point]:
    """Surfaces of solid octrees."""
    mesh, others = load_mesh(model), timing.Peers(asked.repeat)
    against = Reference(*capped(mesh), asked.samples, timed)
    for dim in asked.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), "solid", device=timed)
        for style in asked.styles:
            work = partial(extract, octree, style=style, isovalue=asked.isovalue)
            made = work(device=timed)
            request = {"dims": dim, "styles": style, "isovalue": asked.isovalue,
                       "samples": asked.samples}  # fmt: skip
            point = Point(
                "extract", Path(model).name, "solid voxels to surface", style, f"dim {dim}",
                setting={"dim": dim, "style": style, "isovalue": asked.isovalue,
                         "fill": octree.fill, "samples": asked.samples, "against": against.words},
                runs=asked.runs.times(partial(work, device=timed)),
                command=command("extract", model, asked, **request),
                size=dim, size_of="dim",
                **against.errors_of(made.mesh()),
                stages=timing.stage_times(partial(work, device=profiled), profiled, 1)[0],
                left_out=plan_extract(octree, style=style, device=timed).left_out,
                bytes=made.points.nbytes + made.faces.nbytes,
            )  # fmt: skip
            if asked.commands:
                _, peak = bench_extract.whole_command(
                    octree, style, asked.isovalue, timed.info.index
                )
                point = replace(point, peak=peak)
            yield point
            if asked.peers and style == MARCHING_CUBES:
                for peer, run in peers.of_octree(octree, asked.isovalue).items():
                    runs, made = others.times(peer, run)
                    if runs:
                        found = against.errors_of(voxels.of_peer_surface(made, octree))
                        yield replace(point, method=peer, runs=runs, peer=True, stages={},
                                      left_out={}, bytes=None, peak=None, **found)  # fmt: skip


def work_of(mode: str) -> str:
    """What is timed: a solid is other work than a surface."""
    return "mesh to solid voxels" if mode == "solid" else "mesh to voxels of the surface"


def capped(mesh: Mesh) -> tuple[Mesh, int]:
    """A mesh whose holes are closed by fans, as those of `fill="winding"`, and how many it had."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices, faces = mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)
    caps = find_caps(Grid.fit(mesh, CAPPED_DIM).to_fixed(vertices), faces)
    return Mesh(vertices, np.concatenate([faces, caps.faces]), name=mesh.name), caps.holes


class Reference:
    """A mesh that surfaces are held against.

    words : what it is; absent : measures that make no sense, and why.
    """

    def __init__(
        self,
        mesh: Mesh,
        holes: int,
        samples: int,
        device: Device,
        absent: dict[str, str] | None = None,
    ) -> None:
        self.mesh, self.samples, self.device = mesh, samples, device
        self.words = f"the model, {count_of(holes, 'hole')} capped" if holes else "the model"
        self.absent = absent or {}
        low, high = mesh.bounds
        self.diagonal = math.sqrt(float(((high - low) ** 2).sum()))
        self.volume, self.area = abs(volume(mesh)), area(mesh)

    def errors_of(self, surface: Mesh) -> Any:
        """A dict of "errors" and "absent", as of a Point."""
        if not len(surface.faces):
            return {"errors": {}, "absent": dict.fromkeys(MEASURES["extract"], "it is empty")}
        found = deviation(surface, self.mesh, self.samples, device=self.device)
        ways = found["surface_to_reference"], found["reference_to_surface"]
        errors = {
            "rms": max(way["rms"] for way in ways) / self.diagonal,
            "hausdorff": found["hausdorff"] / self.diagonal,
            "volume": abs(abs(volume(surface)) / self.volume - 1) if self.volume else math.inf,
            "area": abs(area(surface) / self.area - 1),
        }
        return {
            "errors": {name: value for name, value in errors.items() if name not in self.absent},
            "absent": self.absent,
        }


def area(mesh: Mesh) -> float:
    """Of a mesh, in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return math.fsum(length(cross(b - a, c - a)).tolist()) / 2
