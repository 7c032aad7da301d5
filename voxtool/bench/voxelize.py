"""Voxelization: the error of the voxels' boundary against the time from mesh to octree."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from voxtool.bench import ablation, timing
from voxtool.bench.points import Point
from voxtool.bench.references import NO_AREA, NO_SOLID, Reference, capped, voxels_of_peer
from voxtool.choices import VOXEL_FACES
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.surface.extract import extract
from voxtool.svo.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Ablation
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh


def measure(model: str, bench: Bench) -> Iterator[Point | Ablation]:
    """The points and ablations of a model."""
    asked, mesh, others = bench.request, load_mesh(model), timing.Peers(bench.request.repeat)
    solid = Reference(*capped(mesh), asked.samples, bench.timed, NO_AREA)
    surface = Reference(mesh, 0, asked.samples, bench.timed, NO_AREA | NO_SOLID)
    for dim, mode in product(asked.dims, asked.modes):
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        against = solid if mode == "solid" else surface
        request = {"dims": dim, "modes": mode, "fit": asked.fit, "samples": asked.samples}
        row = partial(
            Point, "voxelize", Path(model).name, work_of(mode), label=f"dim {dim}", size=dim,
            size_of="dim", setting={**request, "against": against.words},
        )  # fmt: skip
        yield from _fills(mesh, grid, row, against, model, bench, **request)
        for peer, run in bench.tools.of(mesh, grid, mode).items() if asked.peers else ():
            runs, made = others.times(f"{peer}, {mode}", run)
            if runs:
                yield row(
                    method=f"{peer}, {mode}", runs=runs, peer=True,
                    command=asked.command("voxelize", model, **request),
                    **against.errors_of(voxels_of_peer(made, grid)),
                )  # fmt: skip
    dim = max(asked.dims)
    for mode in asked.modes if asked.ablations else ():
        about = {"bench": "voxelize", "model": Path(model).name, "work": f"{mode}, dim {dim}"}
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        job = plan_voxelize(mesh, grid, mode, device=bench.timed)
        yield from ablation.of_voxelize(job, bench, about)


def _fills(
    mesh: Mesh,
    grid: Grid,
    row: partial[Point],
    against: Reference,
    model: str,
    bench: Bench,
    **request: object,
) -> Iterator[Point]:
    """A point for each fill rule; the rule that "auto" chose is measured once."""
    asked, mode, chosen = bench.request, str(request["modes"]), None
    fills = sorted(asked.fills, key="auto".__ne__) if mode == "solid" else ["auto"]
    for fill in fills:
        if fill == chosen:
            continue
        plan = partial(plan_voxelize, mesh, grid, mode, fill=fill)
        job = plan(device=bench.timed)
        octree = job.run()
        method, rule = mode, {}
        if mode == "solid":
            method = f"solid, {fill}" + (f" ({octree.fill})" if fill == "auto" else "")
            rule, chosen = {"fills": fill}, octree.fill
        boundary = extract(octree, style=VOXEL_FACES, device=bench.timed).mesh()
        point = row(
            method=method,
            command=asked.command("voxelize", model, **request, **rule),
            left_out=job.left_out,
            bytes=octree.nbytes,
            **against.errors_of(boundary),
            **bench.measured(lambda device, plan=plan: plan(device=device).run()),
        )
        figures = {"triangles": len(mesh.faces), "voxels": octree.count, **point.figures}
        setting = {**point.setting, **rule, "rule": octree.fill}
        point = replace(point, figures=figures, setting=setting)
        yield _with_command(point, model, fill, bench) if asked.commands else point


def _with_command(point: Point, model: str, fill: str, bench: Bench) -> Point:
    """The point with the time and the peak of memory of `voxtool voxelize` in its own process."""
    dim, mode, fit = (str(point.setting[name]) for name in ("dims", "modes", "fit"))
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        seconds, peak = timing.command(
            *("voxelize", model, "-q", "--dim", dim, "--mode", mode, "--fit", fit),
            *("--fill", fill, "--device", str(bench.timed.info.index)),
            *("-o", str(Path(folder, "out.svo.h5"))),
        )
    return replace(point, figures={**point.figures, "command": seconds}, peak=peak)


def work_of(mode: str) -> str:
    """The name of the timed work: a solid is other work than a surface."""
    return "mesh to solid voxels" if mode == "solid" else "mesh to voxels of the surface"
