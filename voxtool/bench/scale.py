"""Work that is large or many: octrees made, combined and closed in windows, and with merged
subtrees, beside those of one piece; and many meshes by one command, beside trimesh in one process.

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

from voxtool import tiles
from voxtool.bench.combine import mirrored
from voxtool.bench.peers import of as voxelizers
from voxtool.bench.timing import Peers, by_turns
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.files import open_svo, read_svo, write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.sets.booleans import combine, plan_combine
from voxtool.svo.sets.morphology import plan_morph
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize
from voxtool.tiles.plan import plan_windows

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.voxelization.voxelize import VoxelizeJob

FILE, MANY = "mesh to file of an octree", "{} meshes to files of octrees"
FLOOD = "mesh to file of a flooded octree"
MODE = "surface26"
SHARE = 4  # the octree takes SHARE times the memory that windows may
FLOOD_SHARE = 2  # the same of a flood, whose windows need what lies around them
MESHES = 16
RADIUS = 4  # voxels
UNION, CLOSE = "two octrees to a file of their union", "octree to a file of it, closed"
OTHER = {"different": "it makes a dense array"}
PEER_DIM = 64  # up to which trimesh, which takes a second a mesh, is beside


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of a model."""
    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        for dim in bench.request.dims:
            yield from _large(bench, dim, Path(folder))
            yield from _flooded(bench, dim, Path(folder))
            yield from _read(bench, dim, Path(folder))
        yield from _many(bench, min(bench.request.dims), Path(folder))


def _large(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """Yield the points of one octree: in one piece and in windows, with all nodes and merged."""
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
            cast("MergedOctree", plan_windows(part(), merged=True).run()), target
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


def _flooded(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """Yield the points of a flood: in one piece and in windows."""
    mesh, target = load_mesh(bench.model), folder / "flooded.svo.h5"
    plan = partial(plan_voxelize, mesh, Grid.fit(mesh, dim), fill="flood", device=bench.timed)
    limit, digest = plan().plan.cost.device // FLOOD_SHARE, plan().run().digest()
    ways = {
        "in one piece": lambda: write_svo(plan().run(), target),
        "in windows": lambda: _in_windows(plan(max_memory=limit), target),
    }
    for method, write in ways.items():
        try:
            write()
        except MemoryLimitError:  # the least windows, with what lies around them, take more
            continue
        runs = by_turns(bench.request, write)[0]
        errors = {"different": float(read_svo(target).digest() != digest)}
        row = partial(bench.point, FLOOD, method, f"dim {dim}", asked={"dims": dim})
        yield row(size=dim, size_of="dim", runs=runs, errors=errors, bytes=target.stat().st_size)


def _read(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """Yield the points of operations on octrees in files: with the mirror image, and by a ball."""
    mesh, target = load_mesh(bench.model), folder / "made.svo.h5"
    grid, names = Grid.fit(mesh, dim), (folder / "one.svo.h5", folder / "other.svo.h5")
    for each, name in zip((mesh, mirrored(mesh)), names, strict=True):
        write_svo(voxelize(each, grid, device=bench.timed), name)

    def whole(work: str) -> None:
        octrees = [read_svo(name) for name in names]
        if work == UNION:
            made = combine(octrees, device=bench.timed)
        else:
            made = plan_morph(octrees[0], "close", RADIUS, device=bench.timed).run()
        write_svo(made, target)

    def in_windows(work: str, limit: int) -> None:
        with open_svo(names[0]) as one, open_svo(names[1]) as other:
            if work == UNION:
                tiles.combine([one, other], file=target, max_memory=limit, device=bench.timed)
            else:
                tiles.morph(one, "close", RADIUS, file=target, max_memory=limit, device=bench.timed)

    pair = [read_svo(name) for name in names]
    jobs = {
        UNION: plan_combine(pair, device=bench.timed),
        CLOSE: plan_morph(pair[0], "close", RADIUS, device=bench.timed),
    }
    for work, job in jobs.items():
        row = partial(bench.point, work, label=f"dim {dim}", asked={"dims": dim})
        row = partial(row, size=dim, size_of="dim")
        digest = job.run().digest()
        part = partial(in_windows, work, job.cost.device // SHARE)
        for method, write in {"in one piece": partial(whole, work), "in windows": part}.items():
            try:
                write()
            except MemoryLimitError:  # windows of the least size take more than a quarter
                continue
            runs = by_turns(bench.request, write)[0]
            different = float(read_svo(target).digest() != digest)
            yield row(method=method, runs=runs, errors={"different": different})


def _in_windows(part: VoxelizeJob, target: Path) -> None:
    """Write the octree of a job in windows."""
    job = plan_windows(part)
    with Windows(str(target), job.request, job.plan.disk) as job.store:
        write_svo(cast("Octree", job.run()), target)


def _many(bench: Bench, dim: int, folder: Path) -> Iterator[Point]:
    """Yield the points of copies of the model, by the command line."""
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
