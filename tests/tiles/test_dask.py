"""Windows of one mesh, and many meshes, by the workers of a Dask cluster of two processes: the same
digests as without one, whatever happens to a worker."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import cast

import pytest
from distributed import Client, LocalCluster
from helpers_cli import fail, run, told

import voxtool
import voxtool.tiles
from voxtool.errors import DeviceError
from voxtool.files import read_svo
from voxtool.files.mesh import load_mesh
from voxtool.files.windows import Windows
from voxtool.grid import Grid
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import plan_voxelize
from voxtool.tiles import cluster
from voxtool.tiles.cluster import connected, results
from voxtool.tiles.make import in_memory
from voxtool.tiles.spread import SpreadJob


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with connected("local", 2) as found:
        yield found


@pytest.fixture
def scheduler(client: Client) -> str:
    """The address of the cluster that tests share, for commands."""
    return client.scheduler_info()["address"]


CASES = {
    "surface": ("bunny.obj", {"mode": "surface26"}),
    "parity": ("bunny.obj", {"with_surface": True}),
    "winding": ("open.obj", {}),
    "flood": ("bunny.obj", {"fill": "flood"}),
    "flood of gaps": ("open.obj", {"fill": "flood", "gap": 2}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_octree_is_that_of_one_process(case, client, models: Path, tmp_path) -> None:
    name, request = CASES[case]
    mesh = load_mesh(models / name)
    grid = Grid.fit(mesh, 300).window((40, 6, 0), (260, 202, 280))  # neither a cube nor aligned
    whole = voxtool.voxelize(mesh, grid, **request)
    target = tmp_path / "a.svo.h5"
    made = voxtool.tiles.voxelize(mesh, grid, client=client, file=target, **request)
    assert made.digest() == whole.digest() == read_svo(target).digest()
    assert os.listdir(tmp_path) == ["a.svo.h5"]


def test_the_octree_in_memory(client, models: Path, surface: Octree) -> None:
    mesh = models / "bunny.obj"
    assert voxtool.tiles.voxelize(mesh, None, "surface26", client=client, dim=300) == surface


@pytest.fixture
def spread(client: Client, models: Path, tmp_path) -> Iterator[Callable[..., SpreadJob]]:
    """A function that returns the job of the bunny's surface in windows."""
    mesh = load_mesh(models / "bunny.obj")
    grid = Grid.fit(mesh, 300)
    with ExitStack() as stack:

        def job_of(max_memory: int | None = None) -> SpreadJob:
            whole = plan_voxelize(mesh, grid, "surface26", max_memory=max_memory)
            job = SpreadJob(whole, client)
            job.store = stack.enter_context(Windows(str(tmp_path / "a"), job.request))
            return job

        yield job_of


@pytest.fixture(scope="module")
def surface(models: Path) -> Octree:
    return voxtool.voxelize(models / "bunny.obj", None, "surface26", dim=300)


def test_windows_that_do_not_fit_are_halved(spread, surface: Octree, monkeypatch) -> None:
    monkeypatch.setattr("voxtool.tiles.spread.SHARE", 1)  # few windows, at first
    job = spread(max_memory=130_000)
    made = job.run()
    assert {key[3] for key in job._divided} == {128, 256}
    assert in_memory(made) == surface


@pytest.mark.parametrize("seen", [True, False], ids=["seen", "elsewhere"])
def test_workers_write_windows_where_they_see_the_folder(
    seen: bool, spread, surface: Octree, monkeypatch
) -> None:
    """A folder of the same name that is another one costs a second call."""
    job, sent = spread(), []
    put, note = job.store.put, job.store.take_note
    monkeypatch.setattr(job.store, "put", lambda *given: (sent.append(given[0]), put(*given)))
    if not seen:
        monkeypatch.setattr(job.store, "take_note", lambda line: note({**line, "bricks": 1 << 40}))
    assert in_memory(job.run()) == surface
    assert bool(sent) != seen
    assert len(job.store) == job._done


def test_a_killed_worker_costs_nothing(client, spread, surface, monkeypatch) -> None:
    job, killed = spread(), []

    def kill() -> None:
        if not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr(job, "_report", kill)
    assert in_memory(job.run()) == surface
    assert killed


def test_a_call_that_ends_its_workers_is_one_line(client: Client) -> None:
    calls = results(client, lambda _: client.submit(os._exit, 1), [0])
    with pytest.raises(DeviceError, match="workers of Dask ended again and again"):
        next(calls)


def test_a_lost_scheduler_is_one_line() -> None:
    with connected("local", 1) as client:
        calls = results(client, lambda n: client.submit(abs, n), range(-9, 0))
        assert next(calls) == (-9, 9)
        cast("LocalCluster", client.cluster).close()
        with pytest.raises(DeviceError, match="the scheduler of Dask has gone"):
            list(calls)


def test_the_command_line(here: Path) -> None:
    whole = told("voxelize bunny.obj --dim 200 -o whole.svo.h5 --json")
    command = "voxelize bunny.obj --dim 200 -o parts.svo.h5 --dask local --workers 2"
    assert "windows, made by 2 workers of Dask" in run(f"{command} --plan").stdout
    parts = told(f"{command} --json")
    assert not Path("parts.svo.h5.windows").exists()
    for name in ("digest", "voxels", "nodes", "bricks", "bytes", "grid", "fill"):
        assert parts[name] == whole[name]


@pytest.mark.parametrize("more", ["--mode surface26", "--fill parity", "--fill flood"])
def test_workers_merge_their_windows(more: str, here: Path, scheduler: str) -> None:
    command = f"voxelize bunny.obj --dim 200 --dag {more} --json"
    whole, parts = (
        told(f"{command} -o whole.svo.h5"),
        told(f"{command} -o parts.svo.h5 --dask {scheduler}"),
    )
    for name in ("digest", "voxels", "nodes", "bricks", "bytes", "grid", "fill", "version"):
        assert parts.get(name) == whole.get(name), name
    assert not Path("parts.svo.h5.windows").exists()
    plan = run(f"voxelize bunny.obj --dag {more} --dask {scheduler} --plan").stdout
    assert "merge subtrees" in plan


def test_many_meshes(here: Path, scheduler: str) -> None:
    models = "bunny.obj open.obj"
    told(f"voxelize {models} --dim 32 -o here/ --json")
    done = told(f"voxelize {models} --dim 32 -o there/ --dask {scheduler} --json")
    assert (done["made"], done["failed"]) == (2, 0)
    for name in ("bunny.svo.h5", "open.svo.h5"):
        assert read_svo(f"here/{name}").digest() == read_svo(f"there/{name}").digest()


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        ("--dask local -o x.npy", 2, "--dask writes .svo.h5"),
        ("--dask tcp://127.0.0.1:9", 4, "no scheduler of Dask at tcp://127.0.0.1:9"),
        ("--dask nowhere", 4, "no scheduler of Dask at nowhere"),
        ("open.obj --dask nowhere -o out/", 4, "no scheduler of Dask at nowhere"),
        ("--dask local --workers 1 --dag -o x.npy", 2, "--dask writes .svo.h5"),
        ("--dask local --workers 1 --dag -o -", 2, "windows wait beside the output"),
    ],
)
def test_refusals(command: str, code: int, message: str, here: Path, monkeypatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 1)
    before = sorted(here.iterdir())
    assert message in fail(f"voxelize bunny.obj --dim 32 {command}", code)
    assert sorted(here.iterdir()) == before


def test_without_dask_a_line_names_the_extra(here: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'voxtool[dask]'" in fail("voxelize bunny.obj --dim 32 --dask local", 3)
