"""Errors against time of voxelization, and of surfaces of solid octrees.

Voxels are compared with the model by their boundary, and solids of every fill rule by the share of
the outer surface that they keep (svo/voxelization/kept_share.py). The figures "nodes", "looked at"
and "cut" of a surface are shares of the grid's samples: the cubes that the algorithm of [voCCeL]
visits, those that are examined 64 at once here, and those that the surface cuts.
"""

from __future__ import annotations

import math
import tempfile
import warnings
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation, timing
from voxtool.bench.points import MEASURES
from voxtool.bench.references import (
    NO_AREA,
    NO_SOLID,
    Reference,
    capped,
    surface_of_peer,
    voxels_of_peer,
)
from voxtool.choices import MARCHING_CUBES, SHARP, SURFACE_NETS, VOXEL_FACES, VOXEL_LEVEL
from voxtool.errors import VoxtoolWarning, human
from voxtool.files import write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.memory import available_memory
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.attribution.fraction import plan_fractions
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.sets.compare import count_differences
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.voxelization.kept_share import outer_surface, share_of
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.bench.points import Ablation, Point
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.surface.isosurface import Isosurface

ADAPTIVE_DIM, ADAPTIVE = 256, 0.5  # up to which dim cells of different size; tolerance in voxels
DENSE_BYTES = 2  # a voxel of another tool, whose grid is made dense to be measured
SOLID, SURFACE = "mesh to solid voxels", "mesh to voxels of the surface"


# --- voxelization --------------------------------------------------------------------------------


def measure_voxelize(bench: Bench) -> Iterator[Point | Ablation]:
    """Yield the points and ablations of voxelizing a model."""
    asked, mesh, others = bench.request, load_mesh(bench.model), timing.Peers(bench.request.repeat)
    solid = Reference(*capped(mesh), asked.samples, bench.timed, NO_AREA)
    surface = Reference(mesh, 0, asked.samples, bench.timed, NO_AREA | NO_SOLID)
    for dim, mode in product(asked.dims, asked.modes):
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        work, against = (SOLID, solid) if mode == "solid" else (SURFACE, surface)
        row = partial(bench.point, work, label=f"dim {dim}", size=dim, size_of="dim")
        settings = {"dims": dim, "modes": mode, "fit": asked.fit, "samples": asked.samples}
        yield from _fills(mesh, grid, row, against, bench, settings)
        peers = asked.peers and dense_fits(grid, dim, mode)
        for peer, run in bench.tools.of(mesh, grid, mode).items() if peers else ():
            method = f"{peer}, {mode}"
            runs, made = others.times(method, run)
            if runs:
                yield row(
                    method=method, runs=runs, peer=True, asked=settings,
                    setting={"against": against.words},
                    **_errors(against, partial(voxels_of_peer, made, grid), bench.timed),
                )  # fmt: skip
    for mode in asked.modes if asked.ablations else ():
        dim = max(asked.dims)
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        job = plan_voxelize(mesh, grid, mode, device=bench.timed)
        yield from ablation.of_voxelize(job, bench, f"{mode}, dim {dim}")


def dense_fits(grid: Grid, dim: int, mode: str) -> bool:
    """Return whether other tools' voxels fit in free memory as a dense grid, and warn if not."""
    needed, free = DENSE_BYTES * math.prod(grid.shape), available_memory()
    if needed > free:
        warnings.warn(
            f"dim {dim}, {mode}: other tools are left out, as their voxels as a dense grid need "
            f"{human(needed)} and {human(free)} are free",
            VoxtoolWarning,
            stacklevel=2,
        )
    return needed <= free


def _fills(
    mesh: Mesh, grid: Grid, row: partial[Point], against: Reference, bench: Bench, settings: dict
) -> Iterator[Point]:
    """Yield a point for each fill rule; the rule that "auto" chose is measured once, unless it
    fills another mesh. Its comparison of rules is kept with the mesh, and is part of a first
    run."""
    asked, mode, chosen = bench.request, settings["modes"], None
    solid = mode == "solid"
    outer = _outer_surface(mesh, grid, bench.timed) if solid and against.samples else None
    for fill in sorted(asked.fills, key="auto".__ne__) if solid else ["auto"]:
        if fill == chosen:
            continue
        plan = partial(plan_voxelize, mesh, grid, mode, fill=fill)
        job = plan(device=bench.timed)
        octree = job.run()
        method, rule = mode, {}
        figures = {"triangles": float(len(mesh.faces)), "voxels": float(octree.count)}
        if solid:
            method = f"solid, {fill}" + (f" ({octree.fill})" if fill == "auto" else "")
            rule, chosen = {"fills": fill}, octree.fill if job.mesh is mesh else chosen
        elif against.samples:
            figures["by the lattice"] = lattice_share(mesh, grid, octree, bench.timed)
        if outer is not None:
            figures["outer surface"] = share_of(outer, octree, bench.timed).permille / 1000
        point = row(
            method=method,
            run=lambda device, plan=plan: plan(device=device).run(),
            asked={**settings, **rule},
            setting={"against": against.words, "rule": octree.fill},
            first=_first_run(mesh, grid, mode, fill, bench.timed) if job.plan.choice else None,
            figures=figures,
            left_out=job.left_out,
            bytes=octree.nbytes,
            **_errors(against, lambda octree=octree: octree, bench.timed),
        )
        options = {"--dim": settings["dims"], "--mode": mode, "--fit": asked.fit, "--fill": fill}
        words = [str(word) for option in options.items() for word in option]
        yield _with_command(point, bench, "voxelize", bench.model, *words, output="out.svo.h5")


def lattice_share(mesh: Mesh, grid: Grid, octree: Octree, device: Device) -> float:
    """Return the share of the voxels of a surface that rounding to 1/256 voxel changes: those that
    differ from the set of the mesh on the finest lattice."""
    bits = grid.finest_bits(mesh.bounds)
    fine = plan_voxelize(mesh, grid, octree.mode, bits=bits, device=device).run()
    return sum(count_differences(octree, fine)) / max(fine.count, 1)


def _first_run(mesh: Mesh, grid: Grid, mode: str, fill: str, device: Device) -> float:
    """Return the seconds of voxelizing a mesh of which nothing is known yet."""
    plan = partial(plan_voxelize, replace(mesh), grid, mode, fill=fill, device=device)
    return timing.timed(lambda: plan().run())[0]


def _outer_surface(mesh: Mesh, grid: Grid, device: Device) -> Octree:
    """Return the voxels of the outer surface of a mesh."""
    surface = voxelize(mesh, grid, "surface26", device=device)
    return outer_surface(surface, voxelize(mesh, grid, fill="flood", device=device), device)


def _errors(against: Reference, made: Callable[[], Octree], device: Device) -> Any:
    """Return the `errors` and `absent` of a Point of voxels; without samples nothing is made of
    them."""
    if not against.samples:
        absent = dict.fromkeys(MEASURES["voxelize"], "errors are left out with --samples 0")
        return {"errors": {}, "absent": absent}
    return against.errors_of(boundary(made(), device))


def boundary(octree: Octree, device: Device) -> Mesh:
    """Return the faces between set and empty voxels."""
    return extract(octree, style=VOXEL_FACES, device=device).mesh()


def _with_command(point: Point, bench: Bench, *words: str, output: str) -> Point:
    """Return the point with the time and the peak memory of a whole command, if these are asked
    for."""
    if not bench.request.commands:
        return point
    seconds, peak = timing.command(*words, output=output, device=bench.timed)
    return replace(point, figures={**point.figures, "command": seconds}, peak=peak)


# --- surfaces ------------------------------------------------------------------------------------


def measure_extract(bench: Bench) -> Iterator[Point | Ablation]:
    """Yield the points and ablations of extracting surfaces from solid octrees of a model."""
    asked, mesh, others = bench.request, load_mesh(bench.model), timing.Peers(bench.request.repeat)
    against = Reference(*capped(mesh), asked.samples, bench.timed)
    for dim, style in product(asked.dims, asked.styles):
        grid, fill = Grid.fit(mesh, dim), asked.fills[0]
        octree = voxelize(mesh, grid, "solid", fill=fill, device=bench.timed)
        source = mesh if style == SHARP else None
        level = 0 if style == MARCHING_CUBES else VOXEL_LEVEL  # 0: as its peers take them
        plan = partial(
            plan_extract, octree, style=style, level=level, isovalue=asked.isovalue, source=source
        )
        job = plan(device=bench.timed)
        made = job.run()
        found = against.errors_of(made.mesh())
        settings = {"dims": dim, "fills": fill, "styles": style, "isovalue": asked.isovalue,
                    "samples": asked.samples}  # fmt: skip
        rule = {"rule": octree.fill, "level": made.level, "against": against.words}
        row = partial(
            bench.point, "solid voxels to surface", label=f"dim {dim}", size=dim, size_of="dim",
            asked=settings, setting=rule,
        )  # fmt: skip
        point = row(
            method=style,
            run=lambda device, plan=plan: plan(device=device).run(),
            figures={**_cubes(octree, made), **against.in_voxels(found, max(grid.pitch))},
            left_out=job.left_out,
            bytes=made.points.nbytes + made.faces.nbytes,
            **found,
        )
        with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
            voxels = str(Path(folder, "in.svo.h5"))
            write_svo(octree, voxels)
            options = ["--style", style, "--level", str(level), "--isovalue", str(asked.isovalue)]
            options += ["--source", str(bench.model)] if source else []
            yield _with_command(point, bench, "extract", voxels, *options, output="out.ply")
        if not asked.peers or style != MARCHING_CUBES:
            continue
        side = BRICK_SIDE * np.array(grid.pitch)
        dense, value = partial(coverage_grid, octree), BRICK_SIDE**3 * asked.isovalue
        for peer, run in bench.tools.of_grid(dense, value).items():
            runs, result = others.times(peer, run)
            if runs:
                centre = np.array(grid.origin) + side / 2  # of a brick
                found = against.errors_of(surface_of_peer(result, centre, side))
                figures = against.in_voxels(found, max(grid.pitch))
                yield row(method=peer, runs=runs, peer=True, figures=figures, **found)
    for dim, style in product(asked.dims, asked.styles):
        if style in (MARCHING_CUBES, SURFACE_NETS):
            yield _of_fractions(mesh, dim, style, against, bench)
        if style == SURFACE_NETS and dim <= ADAPTIVE_DIM:
            yield _adaptive(mesh, dim, against, bench)
    if asked.ablations and MARCHING_CUBES in asked.styles:
        for dim in asked.dims:
            octree = voxelize(mesh, Grid.fit(mesh, dim), fill=asked.fills[0], device=bench.timed)
            job = plan_extract(
                octree, style=MARCHING_CUBES, level=0, isovalue=asked.isovalue, device=bench.timed
            )
            yield from ablation.of_extract(job, bench, f"{MARCHING_CUBES}, dim {dim}")


def _of_fractions(mesh: Mesh, dim: int, style: str, against: Reference, bench: Bench) -> Point:
    """Return the point of a surface of the fractions of voxels."""
    grid, fill = Grid.fit(mesh, dim), bench.request.fills[0]
    octree = plan_fractions(mesh, grid, fill=fill, device=bench.timed).run()
    return _of_voxels(octree, dim, style, f"{style}, fractions", against, bench)


def _adaptive(mesh: Mesh, dim: int, against: Reference, bench: Bench) -> Point:
    """Return the point of surface nets with cells of different size."""
    grid, fill = Grid.fit(mesh, dim), bench.request.fills[0]
    octree = voxelize(mesh, grid, "solid", fill=fill, device=bench.timed)
    method, tolerance = f"{SURFACE_NETS}, adaptive {ADAPTIVE:g} voxel", ADAPTIVE * max(grid.pitch)
    return _of_voxels(octree, dim, SURFACE_NETS, method, against, bench, adaptive=tolerance)


def _of_voxels(
    octree: Octree, dim: int, style: str, method: str, against: Reference, bench: Bench, **more: Any
) -> Point:
    """Return the point of a surface whose samples are voxels; `more`: further options of
    plan_extract."""
    asked, pitch = bench.request, max(octree.grid.pitch)
    plan = partial(plan_extract, octree, style=style, isovalue=asked.isovalue, **more)
    job = plan(device=bench.timed)
    made = job.run()
    found = against.errors_of(made.mesh())
    saved: dict[str, float] = {}
    if told := made.adaptive:
        saved["triangles saved"] = 1 - len(made.faces) / told.uniform
        saved["from uniform"] = told.furthest / pitch
    return bench.point(
        "solid voxels to surface", method, f"dim {dim}", size=dim, size_of="dim",
        run=lambda device: plan(device=device).run(),
        asked={"dims": dim, "fills": asked.fills[0], "styles": style, "isovalue": asked.isovalue,
               "samples": asked.samples},
        setting={"rule": octree.fill, "level": made.level, "against": against.words},
        figures={**_cubes(octree, made), **saved, **against.in_voxels(found, pitch)},
        left_out=job.left_out, bytes=made.points.nbytes + made.faces.nbytes, **found,
    )  # fmt: skip


def coverage_grid(octree: Octree) -> np.ndarray:
    """Return (nz, ny, nx) uint8: the set voxels of each brick of the octree's cube."""
    n = octree.grid.side // BRICK_SIDE
    grid = np.zeros((n, n, n), np.uint8)
    for level in octree.levels():
        if level.number:
            s = level.side // BRICK_SIDE
            blocks = grid.reshape(n // s, s, n // s, s, n // s, s).transpose(0, 2, 4, 1, 3, 5)
            x, y, z = morton_decode(level.codes[level.inside]).T
            blocks[z, y, x] = BRICK_SIDE**3
        else:
            x, y, z = morton_decode(level.codes).T
            grid[z, y, x] = np.bitwise_count(octree.bricks)
    return grid


def _cubes(octree: Octree, surface: Isosurface) -> dict[str, float]:
    """Return the size of a surface, and the shares of the grid's samples that were visited."""
    samples = -(-max(octree.grid.shape) // surface.side)
    found: dict[str, float] = {
        "vertices": len(surface.points),
        "triangles": len(surface.faces),
        "samples a side": samples,
        "looked at": BRICK_SIDE**3 * surface.tiles / samples**3,
        "cut": surface.cubes / samples**3,
    }
    if surface.level == 0:
        found["nodes"] = visited_cubes(octree) / samples**3
    return found


def visited_cubes(octree: Octree) -> int:
    """Return the number of cubes with a corner in a level 0 node: the nodes and the NullCubes of
    [voCCeL], section 4.1, all of which its algorithm visits."""
    cells = octree.levels()[-1].cells // BRICK_SIDE
    for axis in range(3):
        below = cells[cells[:, axis] > 0]
        below[:, axis] -= 1
        cells = np.concatenate([cells, below])
        cells = cells[np.unique(morton_encode(cells), return_index=True)[1]]
    return len(cells)
