"""Tables 7.1 to 7.3 of [voCCeL], with our figures beside its own.

Solids are filled by parity, as there. Stages are times on the device; totals include Python.
"""

from __future__ import annotations

import statistics
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench.text_rows import MISPRINT, NO_COUNTERPART, Row
from voxtool.bench.voccel_tables import (
    DIMS,
    MISPRINTS,
    QUICK_DIMS,
    STAGES,
    SURFACES,
    TOTALS,
    TRIANGLES,
)
from voxtool.bench.voxels import visited_cubes
from voxtool.choices import MARCHING_CUBES
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.timing import Bench
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree

WHOLE = "a call, Python included"
# The columns of STAGES that are times: our stages, and what these do.
SHARED = {
    "active nodes": (0, ("active nodes",), "level-1 nodes that a triangle touches"),
    "building the octree": (1, ("octree",), "levels above, from shortened codes"),
}
LEVEL_0 = {
    "surface26": (2, ("surface26",), "voxels of the surface, in the bricks"),
    "surface6": (3, ("surface6",), "voxels of the surface, in the bricks"),
    "solid": (4, ("crossings",), "flips where rows cross the mesh"),
}
PROPAGATION = (5, ("rows", "fill"), "states carried along rows, then voxels between flips set")
BESIDE = {"survey": "vertices rounded to the lattice, and the mesh summed up for the plan",
          "read back": "octree copied to the host"}  # fmt: skip


def nearest(path: str, triangles: int) -> str:
    """The model of [voCCeL] that the name of a file has, or else the nearest by its triangles."""
    name = Path(path).name.lower()
    named = [model for model in TRIANGLES if model in name]
    return named[0] if named else min(TRIANGLES, key=lambda m: abs(TRIANGLES[m] - triangles))


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """The rows of a mesh."""
    mesh = load_mesh(bench.model)
    model = nearest(bench.model, len(mesh.faces))
    ours = f"{Path(bench.model).name} ({len(mesh.faces):,} triangles)"
    for dim in DIMS[:QUICK_DIMS] if quick else DIMS:
        grid, column = Grid.fit(mesh, dim, fit="stretch"), DIMS.index(dim)
        row = partial(_row, ours, model, dim)
        octree = None
        for mode, totals in TOTALS.items():
            plan = partial(plan_voxelize, mesh, grid, mode, fill="parity")
            measured, octree = _measured(bench, plan)
            stages: dict[str, tuple[int, tuple[str, ...], str]] = {
                **SHARED,
                f"level 0, {mode}": LEVEL_0[mode],
            }
            if mode == "solid":
                stages["propagation along x"] = PROPAGATION
            for what, (at, names, about) in stages.items():
                if what in SHARED and mode != "solid":
                    continue  # the same in every mode
                spent = sum(measured["stages"].get(name, 0.0) for name in names)
                words = f"stage {' + '.join(names)}: {about}"
                yield row("7.1", what, "ms", STAGES[model][dim][at], 1000 * spent, words)
            for name, about in BESIDE.items() if mode == "solid" else ():
                spent = measured["stages"].get(name, 0.0)
                yield row("7.1", name, "ms", None, 1000 * spent, f"stage {name}: {about}")
            total = 1000 * statistics.median(measured["runs"])
            yield row("7.2", mode, "ms", totals[model][column], total, WHOLE)
        assert octree is not None
        size = octree.nbytes / 1000
        yield row("7.1", "size", "kB", STAGES[model][dim][-1], size, "solid octree in memory")
        if dim in SURFACES[model]:
            text = SURFACES[model][dim]
            plan = partial(plan_extract, octree, style=MARCHING_CUBES)
            measured, _ = _measured(bench, plan)
            total = 1000 * statistics.median(measured["runs"])
            yield row("7.3", "surface", "ms", text[2], total, WHOLE)
            share = 100 * visited_cubes(octree) / (dim // BRICK_SIDE) ** 3
            words = "cubes with a corner in a level 0 node, of the grid's"
            yield row("7.3", "cubes", "%", text[4], share, words)


def _measured(bench: Bench, plan: partial[Any]) -> tuple[dict[str, Any], Octree]:
    """The runs and the stages of a job, and its result."""

    def run(device: Device) -> Any:
        return plan(device=device).run()

    return bench.measured(run), run(bench.timed)


def _row(
    ours: str, model: str, dim: int, table: str, what: str, unit: str, text: float | None,
    voxtool: float, words: str,
) -> Row:  # fmt: skip
    said = NO_COUNTERPART if text is None else f"{model} ({TRIANGLES[model]:,} triangles)"
    note = MISPRINT if (model, dim, what) in MISPRINTS else ""
    table = f"[voCCeL] table {table}"
    return Row(table, ours, what, f"dim {dim}", unit, text, said, voxtool, words, note)
