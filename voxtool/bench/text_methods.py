"""Rows of the methods that [voCCeL] compares, or has in place of ours, with our times of both.

[voCCeL] shows the comparisons as plots and in words: the rows quote the words. Times are of
stages on the device, in turns. Rows of a forced method say whether its result is that of the plan.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.bench import timing
from voxtool.bench.text_rows import Row
from voxtool.bench.voccel_tables import DIMS, QUICK_DIMS
from voxtool.choices import MARCHING_CUBES
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.surface.plan import COMPACTIONS, SCAN
from voxtool.svo.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.svo.octree import Octree

LARGEST_NAIVE = 1024  # dim, of which figure 7.2 has a quarter along each axis
FASTER = 85.0
RUNS = 9  # of each method, as they differ little
PLOT = "a plot without numbers"
PYRAMID = "a histogram pyramid takes less memory and fewer steps the more a level sums; no figure"
MARCHING = ("classify", "triangles")  # the stages that a compaction changes


@dataclass(frozen=True)
class Method:
    """A comparison of [voCCeL].

    Attributes
    ----------
    table, statement : where it is, and its words.
    what, planned : the decision, and what the plan takes.
    ways : what is forced instead, by name.
    stages : the stages of either that are compared.
    """

    table: str
    statement: str
    what: str
    planned: str
    ways: dict[str, dict[str, Any]]
    stages: tuple[str, ...]


_SURFACE, _SOLID = ("active nodes", "surface26"), ("active nodes", "crossings")
_OVERLAP = f"{PLOT}; the depth interval matters for level 0 most, and for active nodes considerably"
_TABLE = "by table almost no improvement over the loop on its GPU; no figure"
_ADDRESS = (
    "from the common ancestor with the last node, where it is in the lower half of the octree, is "
    "better than from the root; no figure"
)
_FOUND = {"descent from the root": {"addressing": "descent"},
          "jumps to the common ancestor": {"addressing": "jumps"}}  # fmt: skip
_TILES = "4 x 4 tiles {}; no figure"
METHODS = {
    "surface26": (
        *(Method("figure 7.1", _OVERLAP, f"overlap test, {stage}", "depth intervals",
                 {"every box of the bounding box": {"overlap": "base"}}, (stage,))
          for stage in _SURFACE),
        Method("section 7.1", _TABLE, "Morton codes", "by bits",
               {"by table": {"morton": "table"}}, _SURFACE),
        Method("section 7.1", _TILES.format("give surfaces no gain, and take longer at low dims"),
               "columns", "by rows", {"by tiles of 4 x 4": {"plane_tiles": True}}, _SURFACE),
        Method("algorithm 2", _ADDRESS, "brick of a voxel", "ranks", _FOUND, ("surface26",)),
    ),
    "solid": (
        Method("section 7.1", _TABLE, "Morton codes", "by bits",
               {"by table": {"morton": "table"}}, _SOLID),
        Method("section 7.1", _TILES.format("pay off for solids"), "columns", "by rows",
               {"by tiles of 4 x 4": {"plane_tiles": True}}, _SOLID),
        Method("section 7.1", "propagation mostly takes no longer than active nodes; no comparison",
               "propagation", "rows that walk the octree",
               {"levels, x-neighbours linked": {"propagation": "levels"}},
               ("levels", "rows", "fill")),
        Method("algorithm 2", _ADDRESS, "brick of a voxel", "ranks", _FOUND, ("crossings",)),
    ),
}  # fmt: skip


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """The rows of a mesh."""
    bench = replace(bench, request=replace(bench.request, repeat=RUNS))
    mesh = load_mesh(bench.model)
    model = f"{Path(bench.model).name} ({len(mesh.faces):,} triangles)"
    for dim in DIMS[:QUICK_DIMS] if quick else DIMS:
        grid = Grid.fit(mesh, dim, fit="stretch")
        for mode, methods in METHODS.items():
            job = plan_voxelize(mesh, grid, mode, fill="parity", device=bench.profiled)
            octree, spent, words = _run(bench, job, methods)
            for m in methods:
                row = partial(Row, f"[voCCeL] {m.table}", model, setting=f"dim {dim}, {mode}",
                              unit="ms", text=None, statement=m.statement)  # fmt: skip
                for way in (m.planned, *m.ways):
                    stages = spent[way if way in m.ways else ""]
                    named = [name for name in m.stages if name in stages]
                    yield row(what=f"{m.what}: {way}",
                              voxtool=1000 * sum(stages[name] for name in named),
                              ours=f"stage {' + '.join(named)}{words.get(way, '')}")  # fmt: skip
            if mode == "solid":
                yield from _compactions(bench, octree, model, dim)
            if mode == "solid" and dim <= LARGEST_NAIVE:
                yield from _cubes(bench, octree, model, dim)


def _run(
    bench: Bench, job: Job[Octree], methods: Sequence[Method]
) -> tuple[Octree, dict[str, dict[str, float]], dict[str, str]]:
    """The octree of a job, and by way, "" as planned, the seconds of its stages; and for each way
    that is forced, words on its octree."""
    jobs = {way: job.with_(**forced) for m in methods for way, forced in m.ways.items()}
    octree = job.run()
    same = {way: other.run().digest() == octree.digest() for way, other in jobs.items()}
    profiles = bench.profile(job.run, *(other.run for other in jobs.values()))
    spent = {way: stages for way, (stages, _) in zip(("", *jobs), profiles, strict=True)}
    return octree, spent, {way: _compared(equal, "octree") for way, equal in same.items()}


def _compared(same: bool, what: str) -> str:
    return f": {'the same' if same else 'another'} {what}"


def _compactions(bench: Bench, octree: Octree, model: str, dim: int) -> Iterator[Row]:
    """Rows of marching cubes by the scan and by histogram pyramids."""
    scan = plan_extract(octree, style=MARCHING_CUBES, device=bench.profiled)
    jobs = {name: scan.with_(compaction=name) for name in COMPACTIONS}
    surfaces = {name: job.run().digest() for name, job in jobs.items()}
    profiles = bench.profile(*(job.run for job in jobs.values()))
    for name, (stages, _) in zip(jobs, profiles, strict=True):
        words = "" if name == SCAN else _compared(surfaces[name] == surfaces[SCAN], "surface")
        yield Row("[voCCeL] section 4.1", model, f"marching cubes: {name}",
                  f"dim {dim}, marching cubes", "ms", None, PYRAMID,
                  1000 * sum(stages[stage] for stage in MARCHING),
                  f"stage {' + '.join(MARCHING)}{words}")  # fmt: skip


def _cubes(bench: Bench, octree: Octree, model: str, dim: int) -> Iterator[Row]:
    """Rows of marching cubes on the cubes that an octree needs, and on all."""
    sparse = plan_extract(octree, style=MARCHING_CUBES, device=bench.timed)
    naive = sparse.with_(naive=True)
    if not naive.plan.fits(naive.limit, bench.timed.info.max_allocation):
        return
    same = sparse.run().digest() == naive.run().digest()
    runs = timing.by_turns(bench.request, sparse.run, naive.run)
    spent, whole = (1000 * statistics.median(some) for some in runs)
    row = partial(Row, "[voCCeL] figure 7.2", model, setting=f"dim {dim}")
    for what, time in (("those at nodes", spent), ("all of the grid", whole)):
        yield row(what=f"marching cubes: {what}", unit="ms", text=None, statement=PLOT,
                  voxtool=time, ours="a call, Python included")  # fmt: skip
    words = f"of the time{_compared(same, 'surface')}"
    yield row(what="marching cubes: saved", unit="%", text=FASTER,
              statement="some 85 % faster or more, with finding the cubes",
              voxtool=100 * (1 - spent / whole), ours=words)  # fmt: skip
