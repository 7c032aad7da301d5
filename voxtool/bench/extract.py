"""Surfaces of solid octrees: their error against the time from octree to surface.

The figures "nodes", "looked at" and "cut" are shares of the grid's samples: the cubes that the
algorithm of [voCCeL] visits, those that are examined 64 at once here, and those that are cut by
the surface and examined one by one.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from voxtool.bench import timing
from voxtool.bench.points import Point
from voxtool.bench.references import Reference, capped, surface_of_peer
from voxtool.choices import MARCHING_CUBES
from voxtool.files import write_svo
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.morton import morton_encode
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.timing import Bench
    from voxtool.svo.octree import Octree
    from voxtool.svo.surface.isosurface import Isosurface


def measure(model: str, bench: Bench) -> Iterator[Point]:
    """The points of a model."""
    asked, mesh, others = bench.request, load_mesh(model), timing.Peers(bench.request.repeat)
    against = Reference(*capped(mesh), asked.samples, bench.timed)
    for dim, style in product(asked.dims, asked.styles):
        grid, fill = Grid.fit(mesh, dim), asked.fills[0]
        octree = voxelize(mesh, grid, "solid", fill=fill, device=bench.timed)
        plan = partial(plan_extract, octree, style=style, isovalue=asked.isovalue)
        job = plan(device=bench.timed)
        made = job.run()
        request = {"dims": dim, "fills": fill, "styles": style, "isovalue": asked.isovalue,
                   "samples": asked.samples}  # fmt: skip
        point = Point(
            "extract", Path(model).name, "solid voxels to surface", style, f"dim {dim}",
            setting={**request, "rule": octree.fill, "level": made.level,
                     "against": against.words},
            command=asked.command("extract", model, **request),
            size=dim, size_of="dim",
            left_out=job.left_out,
            bytes=made.points.nbytes + made.faces.nbytes,
            **against.errors_of(made.mesh()),
            **bench.measured(lambda device, plan=plan: plan(device=device).run()),
        )  # fmt: skip
        figures = {**_cubes(octree, made), **_in_voxels(point, against, octree), **point.figures}
        point = replace(point, figures=figures)
        if asked.commands:
            seconds, peak = _command(octree, style, asked.isovalue, bench.timed.info.index)
            point = replace(point, figures={**figures, "command": seconds}, peak=peak)
        yield point
        if not asked.peers or style != MARCHING_CUBES:
            continue
        for peer, run in bench.tools.of_octree(octree, asked.isovalue).items():
            runs, result = others.times(peer, run)
            if runs:
                found = against.errors_of(surface_of_peer(result, octree))
                beside = replace(point, method=peer, runs=runs, peer=True, figures={}, stages={},
                                 left_out={}, bytes=None, peak=None, **found)  # fmt: skip
                yield replace(beside, figures=_in_voxels(beside, against, octree))


def _cubes(octree: Octree, surface: Isosurface) -> dict[str, float | None]:
    """The size of a surface, and the shares of the grid's samples that were visited."""
    samples = -(-max(octree.grid.shape) // surface.side)
    found: dict[str, float | None] = {
        "vertices": len(surface.points),
        "triangles": len(surface.faces),
        "samples a side": samples,
    }
    if surface.level == 0:
        found["nodes"] = visited_cubes(octree) / samples**3
    found["looked at"] = BRICK_SIDE**3 * surface.tiles / samples**3
    found["cut"] = surface.cubes / samples**3
    return found


def visited_cubes(octree: Octree) -> int:
    """The number of cubes with a corner in a level 0 node: the nodes and the NullCubes of
    [voCCeL], section 4.1, all of which its algorithm visits."""
    cells = octree.levels()[-1].cells // BRICK_SIDE
    for axis in range(3):
        below = cells[cells[:, axis] > 0]
        below[:, axis] -= 1
        cells = np.concatenate([cells, below])
        cells = cells[np.unique(morton_encode(cells), return_index=True)[1]]
    return len(cells)


def _in_voxels(point: Point, against: Reference, octree: Octree) -> dict[str, float]:
    """The distances between surface and model, in voxels."""
    unit = against.diagonal / max(octree.grid.pitch)
    names = {"rms": "rms in voxels", "hausdorff": "max in voxels"}
    return {
        name: unit * point.errors[measure]
        for measure, name in names.items()
        if measure in point.errors
    }


def _command(octree: Octree, style: str, isovalue: float, device: int) -> tuple[float, int]:
    """Seconds and peak resident bytes of `voxtool extract` in its own process, to a PLY."""
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        source = str(Path(folder, "in.svo.h5"))
        write_svo(octree, source)
        return timing.command(
            *("extract", source, "-q", "--style", style, "--isovalue", str(isovalue)),
            *("--device", str(device), "-o", str(Path(folder, "out.ply"))),
        )
