"""The tables of [voCCeL], chapter 7, with our figures beside its own."""

from __future__ import annotations

import statistics
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench import timing
from voxtool.bench.voccel_tables import DIMS, MISPRINTS, STAGES, SURFACES, TOTALS, TRIANGLES
from voxtool.bench.voxels import visited_cubes
from voxtool.choices import MARCHING_CUBES
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from voxtool.opencl import Device

REPEAT = 3
Row = dict[str, Any]


def nearest(path: str, triangles: int) -> str:
    """The model of [voCCeL] that the name of a file has, or else the nearest by its triangles."""
    name = Path(path).name.lower()
    named = [model for model in TRIANGLES if model in name]
    return named[0] if named else min(TRIANGLES, key=lambda m: abs(TRIANGLES[m] - triangles))


def rows_of(path: str, dims: Sequence[int], device: Device) -> Iterator[Row]:
    """The rows of a model: table, what is measured, dim, unit, and the figures of text and voxtool.

    A misprint has a reason in `note`, and is not to be compared.
    """
    mesh = load_mesh(path)
    model = nearest(path, len(mesh.faces))
    row = partial(_row, Path(path).name, len(mesh.faces), model)
    for dim in dims:
        grid, column = Grid.fit(mesh, dim, fit="stretch"), DIMS.index(dim)
        octree = None
        for mode, totals in TOTALS.items():
            plan = partial(plan_voxelize, mesh, grid, mode, device=device)
            octree, ours = _measured(lambda plan=plan: plan().run())
            yield row("7.2", mode, dim, "ms", totals[model][column], ours)
        assert octree is not None
        yield row("7.1", "size", dim, "kB", STAGES[model][dim][-1], octree.nbytes / 1000)
        if dim in SURFACES[model]:
            text = SURFACES[model][dim]
            plan = partial(plan_extract, octree, style=MARCHING_CUBES, device=device)
            ours = _measured(lambda plan=plan: plan().run())[1]
            yield row("7.3", "surface", dim, "ms", text[2], ours)
            share = 100 * visited_cubes(octree) / (dim // BRICK_SIDE) ** 3
            yield row("7.3", "cubes", dim, "%", text[4], share)


def _measured(run: Callable[[], Any]) -> tuple[Any, float]:
    """The result of work, and the median of its milliseconds after a warm-up."""
    made = run()
    return made, 1000 * statistics.median(timing.times(run, REPEAT))


def _row(
    name: str, triangles: int, model: str, table: str, what: str, dim: int, unit: str,
    text: float, ours: float,
) -> Row:  # fmt: skip
    return {
        "model": name, "triangles": triangles, "text_model": model,
        "text_triangles": TRIANGLES[model], "table": table, "what": what, "dim": dim,
        "unit": unit, "text": text, "voxtool": ours,
        "note": "misprint, not compared" if (model, dim, what) in MISPRINTS else None,
    }  # fmt: skip
