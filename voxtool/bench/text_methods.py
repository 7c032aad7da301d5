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
from voxtool.bench.text_peers import decoding_rows
from voxtool.bench.text_rows import Row
from voxtool.bench.text_voxels import SUM, on_device
from voxtool.bench.timing import WHOLE
from voxtool.bench.voccel_tables import DIMS, QUICK_DIMS
from voxtool.choices import MARCHING_CUBES
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.opencl.histopyramid import MOST_STORED, level_groups
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.surface.plan import COMPACTIONS, SCAN
from voxtool.svo.voxelization.scan_conversion import MORTON_TABLE
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.svo.octree.octree import Octree

    Runs = list[dict[str, float]]  # the seconds of the stages of each run

LARGEST_NAIVE = 1024  # dim, of which figure 7.2 has a quarter along each axis
FASTER = 85.0
RUNS = 9  # of each method, as they differ little
PLOT = "a plot, of which no numbers survive"
PYRAMID = (
    "a histogram pyramid has work-items for outputs alone; the more a level sums, the less memory "
    "and steps it takes; 2 N - 1 numbers for N values at 2:1; no times"
)
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
_OVERLAP = (
    "a plot, whose axes survive, to dim 250 of level 1 and 40 ms; depth intervals matter for level "
    "0 most, and for active nodes considerably"
)
_TABLE = (
    "by table almost no improvement over the loop on its GPU, no figure; some 15 times as fast by "
    "the author of libmorton"
)
_ADDRESS = (
    "from the common ancestor with the last node, where it is in the lower half of the octree, is "
    "better than from the root; no figure"
)
_FOUND = {"descent from the root": {"addressing": "descent"},
          "jumps to the common ancestor": {"addressing": "jumps"}}  # fmt: skip
_TILES = "4 x 4 tiles {}; no figure"


def _overlaps(mode: str) -> tuple[Method, ...]:
    return tuple(
        Method("figure 7.1", _OVERLAP, what, "depth intervals",
               {"every box": {"overlap": "base"}}, (stage,))
        for what, stage in (("active nodes", "active nodes"), ("level 0", mode))
    )  # fmt: skip


METHODS = {
    "surface26": (
        *_overlaps("surface26"),
        Method("section 7.1", _TABLE, "Morton codes", "by bits",
               {"by table": {"morton": "table"}}, _SURFACE),
        Method("section 7.1", _TILES.format("give surfaces no gain, and take longer at low dims"),
               "columns", "by rows", {"by tiles of 4 x 4": {"plane_tiles": True}}, _SURFACE),
        Method("algorithm 2", _ADDRESS, "brick of a voxel", "ranks", _FOUND, ("surface26",)),
    ),
    "surface6": _overlaps("surface6"),
    "solid": (
        Method("section 7.1", _TABLE, "Morton codes", "by bits",
               {"by table": {"morton": "table"}}, _SOLID),
        Method("section 7.1", _TILES.format("pay off for solids"), "columns", "by rows",
               {"by tiles of 4 x 4": {"plane_tiles": True}}, _SOLID),
        Method("section 7.1", "by levels alone, mostly no longer than finding active nodes",
               "propagation", "rows that walk the octree",
               {"levels, x-neighbours linked": {"propagation": "levels"}},
               ("levels", "rows", "fill")),
        Method("algorithm 2", _ADDRESS, "brick of a voxel", "ranks", _FOUND, ("crossings",)),
    ),
}  # fmt: skip


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """Yield the rows of a mesh."""
    bench = replace(bench, request=replace(bench.request, repeat=RUNS))
    mesh = load_mesh(bench.model)
    model = f"{Path(bench.model).name}, {len(mesh.faces):,} triangles"
    yield from _tables(model)
    yield from decoding_rows(partial(Row, model=model, setting=""), bench)
    for dim in DIMS[:QUICK_DIMS] if quick else DIMS:
        grid = Grid.fit(mesh, dim, fit="stretch")
        for mode, methods in METHODS.items():
            job = plan_voxelize(mesh, grid, mode, fill="parity", device=bench.profiled)
            octree, runs, words = _run(bench, job, methods)
            for m in methods:
                row = partial(Row, f"[voCCeL] {m.table}", model, f"{m.what}, {mode}", f"dim {dim}",
                              "ms", statement=m.statement)  # fmt: skip
                for way in (m.planned, *m.ways):
                    found = runs[way if way in m.ways else ""]
                    named = [name for name in m.stages if name in found[-1]]
                    yield row(way=way, **_milliseconds(found, named),
                              ours=f"{_stages(named)}{words.get(way, '')}")  # fmt: skip
            if mode == "solid":
                yield from _compactions(bench, octree, model, dim)
            if mode == "solid" and dim <= LARGEST_NAIVE:
                yield from _cubes(bench, octree, model, dim)


def _run(
    bench: Bench, job: Job[Octree], methods: Sequence[Method]
) -> tuple[Octree, dict[str, Runs], dict[str, str]]:
    """Return the octree of a job, and by way, "" as planned, the seconds of its stages in each run;
    and for each way that is forced, words on its octree."""
    jobs = {way: job.with_(**forced) for m in methods for way, forced in m.ways.items()}
    octree = job.run()
    same = {way: other.run().digest() == octree.digest() for way, other in jobs.items()}
    every = bench.stage_runs(job.run, *(other.run for other in jobs.values()))
    runs = dict(zip(("", *jobs), every, strict=True))
    return octree, runs, {way: _compared(equal, "octree") for way, equal in same.items()}


def _compared(same: bool, what: str) -> str:
    return f": {'the same' if same else 'another'} {what}"


def _compactions(bench: Bench, octree: Octree, model: str, dim: int) -> Iterator[Row]:
    """Yield rows of marching cubes by the scan and by histogram pyramids."""
    scan = plan_extract(octree, style=MARCHING_CUBES, level=0, device=bench.profiled)
    jobs = {name: scan.with_(compaction=name) for name in COMPACTIONS}
    surfaces = {name: job.run().digest() for name, job in jobs.items()}
    every = bench.stage_runs(*(job.run for job in jobs.values()))
    row = partial(Row, "[voCCeL] section 4.1", model, setting=f"dim {dim}", statement=PYRAMID)
    for name, runs in zip(jobs, every, strict=True):
        words = "" if name == SCAN else _compared(surfaces[name] == surfaces[SCAN], "surface")
        way = name.replace("pyramid-", "pyramid ") + ":1" * (name != SCAN)
        yield row("marching cubes", unit="ms", way=way, ours=f"{_stages(MARCHING)}{words}",
                  **_milliseconds(runs, MARCHING))  # fmt: skip
        values, arity = jobs[name].plan.visited, COMPACTIONS[name]
        if arity is not None:
            stored = min(arity, MOST_STORED) * sum(level_groups(values, arity))
            yield row("size", unit="numbers a value", way=way, voxtool=stored / values,
                      ours="numbers that its levels hold, of a value a tile")  # fmt: skip


def _cubes(bench: Bench, octree: Octree, model: str, dim: int) -> Iterator[Row]:
    """Yield rows of marching cubes on the cubes that an octree needs, and on all."""
    sparse = plan_extract(octree, style=MARCHING_CUBES, level=0, device=bench.profiled)
    naive = sparse.with_(naive=True)
    if not naive.plan.fits(naive.limit, bench.profiled.info.max_allocation):
        return
    same = sparse.run().digest() == naive.run().digest()
    found = [_milliseconds(runs, [name for name in on_device(runs[-1]) if name != WHOLE])
             for runs in bench.stage_runs(sparse.run, naive.run)]  # fmt: skip
    spent, whole = (one["voxtool"] for one in found)
    row = partial(Row, "[voCCeL] figure 7.2", model, setting=f"dim {dim}")
    for way, one in zip(("cubes at nodes", "every cube"), found, strict=True):
        yield row("marching cubes", unit="ms", way=way, **one, ours=SUM, statement=PLOT)
    yield row("time saved", unit="%", voxtool=100 * (1 - spent / whole),
              ours=f"by visiting cubes at nodes alone{_compared(same, 'surface')}", text=FASTER,
              statement="some 85 % or more, where finding the cubes is counted")  # fmt: skip


def _tables(model: str) -> Iterator[Row]:
    """Yield rows of the tables of Morton codes."""
    row = partial(Row, "[voCCeL] section 5.1", model, setting="", unit="bytes")
    yield row("table for encoding", voxtool=MORTON_TABLE.nbytes, text=3 * 256 * 4,
              ours="numbers of 4 bytes, by axis and byte",
              statement="some 3 kB: 3 x 256 x 4")  # fmt: skip


def _milliseconds(runs: Runs, names: Sequence[str]) -> dict[str, Any]:
    """Return the median of the sums of stages, and its spread, as fields of a Row."""
    seconds = [sum(run.get(name, 0.0) for name in names) for run in runs]
    return {"voxtool": 1000 * statistics.median(seconds), "spread": timing.spread(seconds)}


def _stages(names: Sequence[str]) -> str:
    return f"stage{'s' * (len(names) > 1)} {' and '.join(names)}"
