"""Tables 7.1 to 7.3 of [voCCeL], with our figures beside its own.

Solids are filled by parity, as there. Stages are times on the device; totals include Python.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench.text_rows import MISPRINT, Row
from voxtool.bench.voccel_tables import (
    DIMS,
    MISPRINTS,
    QUICK_DIMS,
    STAGES,
    SURFACES,
    TOTALS,
    TRIANGLES,
    UNEVEN,
    UNEVEN_CUBES,
)
from voxtool.bench.voxels import visited_cubes
from voxtool.choices import MARCHING_CUBES
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree.octree import Octree

SUM = "sum of the stages on the device without reading back"
# The columns of STAGES that are times: our stages, and what these do.
SHARED = {
    "active nodes": (
        0,
        ("active nodes",),
        "stage active nodes: level-1 nodes that a triangle touches",
    ),
    "building the octree": (1, ("octree",), "stage octree: the levels above, from shortened codes"),
}
LEVEL_0 = {
    "surface26": (2, ("surface26",), "stage surface26: voxels of the surface, in the bricks"),
    "surface6": (3, ("surface6",), "stage surface6: voxels of the surface, in the bricks"),
    "solid": (4, ("crossings",), "stage crossings: flips where rows cross the mesh"),
}
PROPAGATION = (5, ("rows", "fill"), "stages rows and fill: states carried along rows, then voxels "
               "between flips set")  # fmt: skip
BESIDE = {"survey": "vertices rounded to the lattice, and the mesh summed up for the plan",
          "read back": "octree copied to the host"}  # fmt: skip
CUBE_STAGES = (  # columns of SURFACES
    ("finding the cubes", ("tiles", "samples"), "stages tiles and samples: tiles of 4 x 4 x 4 "
     "cubes that may be cut, and their coverages"),
    ("extraction", ("classify", "triangles"), "stages classify and triangles"),
)  # fmt: skip
SIZE = 6  # column of STAGES
CUBES = "cubes visited"
FEWER = "in high resolutions up to 98 % fewer cubes"
NOTES = {
    **dict.fromkeys(MISPRINTS, MISPRINT),
    **{(model, dim, CUBES): UNEVEN for model, dim in UNEVEN_CUBES},
}


def beside(triangles: dict[str, int]) -> dict[str, list[str]]:
    """Return the models of [voCCeL] that stand beside each mesh, from the triangles of each file.

    Each of its models stands beside the mesh of its name, or else the nearest by triangles; a
    mesh that is the nearest to none stands beside the model that is nearest to it.
    """
    found: dict[str, list[str]] = {path: [] for path in triangles}
    for model, count in TRIANGLES.items():
        named = [path for path in triangles if model in Path(path).name.lower()]
        found[_nearest(count, {path: triangles[path] for path in named or triangles})].append(model)
    return {
        path: models or [_nearest(triangles[path], TRIANGLES)] for path, models in found.items()
    }


def _nearest(count: int, counts: dict[str, int]) -> str:
    return min(counts, key=lambda name: abs(math.log(max(counts[name], 1) / max(count, 1))))


def rows_of(bench: Bench, quick: bool, models: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of a mesh, beside those of models of [voCCeL]."""
    mesh = load_mesh(bench.model)
    n, name = len(mesh.faces), Path(bench.model).name
    dims = DIMS[:QUICK_DIMS] if quick else DIMS
    found = [(dim, sorted(_figures(bench, mesh, dim), key=Figure.place)) for dim in dims]
    for model in models:
        theirs = TRIANGLES[model]
        more = 100 * (n / theirs - 1)
        far = f" ({abs(more):.2g} % {'more' if more > 0 else 'fewer'})" if n != theirs else ""
        ours = f"{name}, {n:,} triangles{far}"
        for dim, figures in found:
            for f in figures:
                text, note = f.text(model, dim), ""
                if text is not None:
                    note = NOTES.get((model, dim, f.what), "")
                yield Row(
                    f"[voCCeL] table 7.{f.table}", ours, f.what, f"dim {dim}", f.unit, f.voxtool,
                    f.ours, f.way, text=text, text_model=f"{model}, {theirs:,} triangles",
                    statement=f.statement, note=note,
                )  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """A figure of voxtool, and where that of [voCCeL] is: the table and its column."""

    table: int
    column: int | str | None
    what: str
    unit: str
    voxtool: float
    ours: str
    statement: str = ""
    way: str = ""

    def place(self) -> tuple[int, int]:
        """Return the table, and the place in it: by columns, then what [voCCeL] does not have."""
        return self.table, self.column if isinstance(self.column, int) else SIZE + 1

    def text(self, model: str, dim: int) -> float | None:
        """Return the figure of [voCCeL]; None if it has none."""
        if self.column is None:
            return None
        if isinstance(self.column, str):
            return TOTALS[self.column][model][DIMS.index(dim)]
        if self.table == 3:
            return SURFACES[model][dim][self.column]
        return STAGES[model][dim][self.column]


def _figures(bench: Bench, mesh: Mesh, dim: int) -> Iterator[Figure]:
    """Yield the figures of a mesh at a dim."""
    grid, octree = Grid.fit(mesh, dim, fit="stretch"), None
    for mode in TOTALS:
        plan = partial(plan_voxelize, mesh, grid, mode, fill="parity")
        measured, octree = _measured(bench, plan)
        stages: dict[str, tuple[int | None, tuple[str, ...], str]] = {
            f"level 0, {mode}": LEVEL_0[mode]
        }
        if mode == "solid":  # the others are the same in every mode
            stages = {**SHARED, **stages, "propagation along x": PROPAGATION}
            stages |= {name: (None, (name,), f"{words}; not in [voCCeL]")
                       for name, words in BESIDE.items()}  # fmt: skip
        for what, (column, names, words) in stages.items():
            yield Figure(1, column, what, "ms", _sum(measured, names), words)
        yield from _totals(2, mode, mode, measured)
    assert octree is not None
    yield Figure(1, SIZE, "size", "kB", octree.nbytes / 1000, "the solid octree in memory")
    if dim not in SURFACES["bunny"]:  # nor any other
        return
    plan = partial(plan_extract, octree, style=MARCHING_CUBES, level=0)
    measured, _ = _measured(bench, plan)
    for column, (what, names, words) in enumerate(CUBE_STAGES):
        yield Figure(3, column, what, "ms", _sum(measured, names), words)
    yield from _totals(3, 2, "in total", measured)
    cubes = visited_cubes(octree)
    yield Figure(3, 3, CUBES, "", cubes, "with a corner in a level 0 node")
    share = 100 * cubes / (dim // BRICK_SIDE) ** 3
    yield Figure(3, 4, "of all cubes", "%", share, "of the grid's", FEWER)


def _totals(table: int, column: int | str, what: str, measured: dict[str, Any]) -> Iterator[Figure]:
    """Yield the sum of the stages, and the time of a call."""
    names = list(on_device(measured["stages"]))
    yield Figure(table, column, what, "ms", _sum(measured, names), SUM, way="stages")
    whole = 1000 * statistics.median(measured["runs"])
    yield Figure(table, column, what, "ms", whole, "Python included", way="a call")


def on_device(stages: Mapping[str, float]) -> dict[str, float]:
    """Return the stages of a result that stays on the device."""
    return {name: seconds for name, seconds in stages.items() if name != "read back"}


def _sum(measured: dict[str, Any], names: Sequence[str]) -> float:
    """Return the milliseconds of stages."""
    return 1000 * sum(measured["stages"].get(name, 0.0) for name in names)


def _measured(bench: Bench, plan: partial[Any]) -> tuple[dict[str, Any], Octree]:
    """Return the runs and the stages of a job, and its result."""

    def run(device: Device) -> Any:
        return plan(device=device).run()

    return bench.measured(run), run(bench.timed)
