"""Work that is large or many: octrees written in windows and with merged subtrees, beside those of
one piece; and many meshes by one command, beside trimesh in one process.

Windows are forced by a quarter of the memory that the whole octree takes on the device.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from voxtool.bench.peers import of as voxelizers
from voxtool.bench.timing import Peers, by_turns
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.files import read_svo, write_svo
from voxtool.files.mesh import load_mesh
from voxtool.files.windows import Windows
from voxtool.grid import Grid
from voxtool.svo.merged import MergedOctree
from voxtool.svo.voxelize import plan_voxelize
from voxtool.tiles.merging import MergingJob
from voxtool.tiles.windows import WindowsJob

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.svo.octree import Octree
    from voxtool.svo.voxelize import VoxelizeJob

FILE, MANY = "mesh to file of an octree", "{} meshes to files of octrees"
MODE = "surface26"
SHARE = 4  # the octree takes so many times the memory that windows may
MESHES = 16
OTHER = {"different": "it makes a dense array"}
PEER_DIM = 64  # up to which trimesh, which takes a second a mesh, is beside


def measure(bench: Bench) -> Iterator[Point]:
    """The points of a model."""
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        for dim in bench.request.dims:
            yield from _large(bench, dim, Path(folder))
        yield from _many(bench, min(bench.request.dims), Path(folder))


def _large(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """The points of one octree: in one piece and in windows, with all nodes and merged."""
    mesh, target = load_mesh(bench.model), folder / "octree.svo.h5"
    plan = partial(plan_voxelize, mesh, Grid.fit(mesh, dim), MODE, device=bench.timed)
    whole = plan()
    part = partial(plan, max_memory=whole.plan.cost.device // SHARE)
    digest = whole.run().digest()
    ways: dict[str, Any] = {
        "in one piece": lambda: write_svo(plan().run(), target),
        "in one piece, merged": lambda: write_svo(MergedOctree.of(plan().run()), target),
        "in windows": lambda: _in_windows(part(), target),
        "in windows, merged": lambda: write_svo(
            cast("MergedOctree", MergingJob(part()).run()), target
        ),
    }
    for method, write in ways.items():
        row = partial(bench.point, FILE, method, f"dim {dim}", asked={"dims": dim})
        row = partial(row, setting={"mode": MODE}, size=dim, size_of="dim")
        try:
            write()
        except MemoryLimitError:  # the mesh alone takes more than a quarter
            continue
        runs = by_turns(bench.request, write)[0]
        errors = {"different": float(read_svo(target).digest() != digest)}
        yield row(runs=runs, errors=errors, bytes=target.stat().st_size)


def _in_windows(part: VoxelizeJob, target: Path) -> None:
    """Write the octree of a job in windows."""
    job = WindowsJob(part)
    with Windows(str(target), job.request, job.plan.disk) as job.store:
        write_svo(cast("Octree", job.run()), target)


def _many(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """The points of copies of the model, by the command line."""
    mesh = load_mesh(bench.model)
    grid = Grid.fit(mesh, dim)
    digest = plan_voxelize(mesh, grid, device=bench.timed).run().digest()
    ending = "".join(Path(bench.model).suffixes[-2:])
    names = [folder / f"{number}{ending}" for number in range(MESHES)]
    for name in names:
        shutil.copy(bench.model, name)
    row = partial(
        bench.point, MANY.format(MESHES), label=f"dim {dim}", asked={"dims": dim},
        size=MESHES, size_of="meshes",
    )  # fmt: skip
    made = folder / "made"
    command = [sys.executable, "-m", "voxtool", "voxelize", *map(str, names), "-q", "-o", str(made)]
    command += ["--dim", str(dim), "--device", str(bench.timed.info.index)]

    def run() -> None:
        shutil.rmtree(made, ignore_errors=True)
        ended = subprocess.run(command, capture_output=True, check=False)
        if ended.returncode:
            raise VoxtoolError(f"bench: voxtool voxelize of {MESHES} meshes failed: {ended.stderr}")

    run()
    runs = by_turns(bench.request, run)[0]
    octrees = [read_svo(path).digest() for path in sorted(made.glob("*.svo.h5"))]
    wrong = MESHES - octrees.count(digest)
    yield row(method="one command", runs=runs, errors={"different": wrong / MESHES})
    if bench.request.peers and dim <= PEER_DIM:
        peers = Peers(bench.request.repeat)
        for name, work in voxelizers(mesh, grid, "solid").items():
            if name.startswith("trimesh"):
                runs, _ = peers.times(name, lambda work=work: [work() for _ in names])
                yield row(method=name, runs=runs, absent=OTHER, peer=True)
