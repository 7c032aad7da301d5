"""Measure what workers of Dask gain on this machine, and say by a model what more would: a table.

    python -m tests.cluster_gain armadillo.obj --dim 8192

Work is the time of the workers' processors; rest, what the command does alone, before the first
window and after the last one. A finer division says what a window costs beside its voxels, and an
array of 64 MB how fast a worker's answers arrive. Of n workers the model says
max((work + window * windows) / n, bytes / rate) + rest; where workers see the folder, no bytes are
sent. It knows nothing of a network, or of windows that take longer than others.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, cast

import numpy as np

from tests.performance_page import digits, markdown
from voxtool.files import write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tiles import windows
from voxtool.tiles.cluster import connected
from voxtool.tiles.plan import plan_spread

MODES = ("surface26", "solid")
WORKERS, MODELLED = (1, 2), (16, 256)
RUNS = 3
FINER = 8  # times as many windows
SENT = 8 << 20  # float64 numbers


class Run(NamedTuple):
    """One run: seconds, bytes of windows, and their number."""

    whole: float
    rest: float
    work: float
    size: int
    windows: int


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.cluster_gain", description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--dim", type=int, default=8192)
    given = parser.parse_args()
    print(markdown(rows(given.model, given.dim)))


def rows(model: Path, dim: int) -> Iterable[list[str]]:
    """The table of a model."""
    yield ["mode", "workers", "s", "model, s", "of n times as fast", "where bytes are sent, s"]
    mesh = load_mesh(model)
    for mode in MODES:
        found: dict[int, Run] = {}
        for n in WORKERS:
            with connected("local", n) as client:
                run(client, mesh, 256, mode)  # drivers are loaded, kernels are read
                runs = [run(client, mesh, dim, mode) for _ in range(RUNS)]
                found[n] = Run(*map(median, zip(*runs, strict=True)))
                if n == 1:
                    rate = sending(client)
                    window = cost_of_window(client, mesh, dim, mode, found[1])
        one = found[1]
        for n in (*WORKERS, *MODELLED):
            seconds = modelled(one, window, n)
            gain = (
                one.whole / (n * found[n].whole)
                if n in found
                else modelled(one, window, 1) / (n * seconds)
            )
            measured = digits(found[n].whole) if n in found else ""
            sent = digits(modelled(one, window, n, rate))
            yield [f"{mode} {dim}", str(n), measured, digits(seconds), f"{gain:.0%}", sent]


def run(client: Any, mesh: Any, dim: int, mode: str) -> Run:
    """Run a job once."""
    before = worked(client)
    begun = time.perf_counter()
    job = plan_spread(plan_voxelize(mesh, Grid.fit(mesh, dim), mode), client)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        target = Path(folder, "octree.svo.h5")
        with Windows(str(target), job.request, job.plan.disk) as job.store:
            planned = time.perf_counter()
            octree = job.run()
            made = time.perf_counter()
            size = sum(path.stat().st_size for path in job.store.folder.iterdir())
            write_svo(cast("Any", octree), target)
    ended = time.perf_counter()
    rest = planned - begun + ended - made
    return Run(ended - begun, rest, worked(client) - before, size, len(job.store))


def worked(client: Any) -> float:
    """The time of all workers' processors, in s."""
    return sum(client.run(time.process_time).values())


def sending(client: Any) -> float:
    """The bytes of an answer that arrive in a second."""
    seconds = []
    for _ in range(RUNS):
        future = client.submit(np.ones, SENT, pure=False)
        while not future.done():
            time.sleep(0.01)
        begun = time.perf_counter()
        future.result()
        seconds.append(time.perf_counter() - begun)
    return 8 * SENT / median(seconds)


def cost_of_window(client: Any, mesh: Any, dim: int, mode: str, coarse: Run) -> float:
    """The seconds that a window costs beside its voxels, at least 0."""
    share = windows.SHARE
    windows.SHARE = FINER * share
    try:
        runs = [run(client, mesh, dim, mode) for _ in range(RUNS)]
    finally:
        windows.SHARE = share
    more = runs[0].windows - coarse.windows
    return max(0.0, median(one.work for one in runs) - coarse.work) / max(more, 1)


def modelled(one: Run, window: float, n: int, rate: float | None = None) -> float:
    """The seconds of n workers, of a run with one worker."""
    work = one.work + window * one.windows * (n - 1)
    return max(work / n, one.size / rate if rate else 0.0) + one.rest


if __name__ == "__main__":
    main()
