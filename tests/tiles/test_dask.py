"""Windows of one mesh, and many meshes, by the workers of a Dask cluster of two processes: the same
digests as without one, whatever happens to a worker."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from distributed import Client, LocalCluster
from helpers.cli import fail, run, told
from tiles.test_attributes import warned

import voxtool
import voxtool.tiles
from voxtool.errors import DeviceError, MemoryLimitError
from voxtool.files import read_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.svo.attribution.request import plan_octree
from voxtool.svo.octree.layout import MAX_LINK
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tiles import cluster
from voxtool.tiles.attributed import EXPOSED
from voxtool.tiles.cluster import connected, results
from voxtool.tiles.make import in_memory
from voxtool.tiles.plan import plan_spread
from voxtool.tiles.windows import Part, WindowsJob, WindowsPlan


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
    "normals": ("bunny.obj", {"mode": "surface26", "attributes": ("normal", "area")}),
    "colours": ("parts.glb", {"with_surface": True, "attributes": ("colour",)}),
    "normals of a flood": ("bunny.obj", {"fill": "flood", "attributes": ("normal",)}),
    "labels and colours": ("parts.glb", {"labels": "part", "attributes": ("colour",)}),
    "labels of surfaces": ("parts.glb", {"labels": "part", "mode": "surface6"}),
    "labels by winding": ("open.obj", {"labels": "shell", "attributes": ("normal",)}),
    "fractions": ("bunny.obj", {"mode": "fraction", "fraction_type": "u2"}),
    "fractions of faces": ("open.obj", {"mode": "fraction", "face_fractions": True}),
    "fractions of parts": ("parts.glb", {"mode": "fraction", "labels": "part"}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_octree_is_that_of_one_process(case, client, models: Path, tmp_path) -> None:
    name, request = CASES[case]
    mesh = load_mesh(models / name, keep=("parts", "appearance"))
    grid = Grid.fit(mesh, 300).window((40, 6, 0), (260, 202, 280))  # neither a cube nor aligned
    whole, said = warned(lambda: voxtool.voxelize(mesh, grid, **request))
    target = tmp_path / "a.svo.h5"
    call = partial(voxtool.tiles.voxelize, mesh, grid, client=client, file=target, **request)
    made, said_of_parts = warned(call)
    assert said_of_parts == said
    assert made.digest() == whole.digest() == read_svo(target).digest()
    assert os.listdir(tmp_path) == ["a.svo.h5"]


def test_the_octree_in_memory(client, models: Path, surface: Octree) -> None:
    mesh = models / "bunny.obj"
    assert voxtool.tiles.voxelize(mesh, None, "surface26", client=client, dim=300) == surface


@pytest.fixture
def spread(client: Client, models: Path, tmp_path) -> Iterator[Callable[..., WindowsJob]]:
    """A function that returns the job of the bunny's surface in windows."""
    mesh = load_mesh(models / "bunny.obj")
    grid = Grid.fit(mesh, 300)
    with ExitStack() as stack:

        def job_of(max_memory: int | None = None) -> WindowsJob:
            whole = plan_voxelize(mesh, grid, "surface26", max_memory=max_memory)
            job = plan_spread(whole, client)
            job.store = stack.enter_context(Windows(str(tmp_path / "a"), job.request))
            return job

        yield job_of


@pytest.fixture(scope="module")
def surface(models: Path) -> Octree:
    return voxtool.voxelize(models / "bunny.obj", None, "surface26", dim=300)


def test_windows_that_do_not_fit_are_halved(spread, surface: Octree, monkeypatch) -> None:
    monkeypatch.setattr("voxtool.tiles.windows.SHARE", 1)  # few windows, at first
    job = spread(max_memory=130_000)
    made = job.run()
    assert {key[3] for key in job._divided} == {128, 256}
    assert in_memory(made) == surface


WITH_VALUES = {
    "labels": {"labels": "part", "attributes": ("normal",)},
    "fractions": {"mode": "fraction", "face_fractions": True},
}


def planner(models: Path, name: str) -> Callable[..., Any]:
    """Return a function that plans one of WITH_VALUES in one piece."""
    mesh = load_mesh(models / "parts.glb", keep=("parts",))
    request: dict[str, Any] = {"mode": "solid", **WITH_VALUES[name]}
    return partial(plan_octree, mesh, Grid.fit(mesh, 300), **request)


def test_windows_with_values_that_do_not_fit_are_halved(
    client, models, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("voxtool.tiles.windows.SHARE", 1)
    whole = planner(models, "labels")
    octree, _ = warned(whole().run)
    job = plan_spread(whole(max_memory=2_500_000), client)
    with Windows(str(tmp_path / "a"), job.request) as job.store:
        made, _ = warned(job.run)
        assert in_memory(made) == octree
    assert job._divided


@pytest.mark.parametrize("name", WITH_VALUES)
def test_values_of_voxels_that_workers_lose_or_send(
    name: str, client: Client, models: Path, tmp_path, monkeypatch
) -> None:
    """A worker is killed, and none sees the folder of windows, or writes into another one."""
    whole = planner(models, name)
    octree, _ = warned(whole().run)
    reports: list[int] = []

    def kill(_: WindowsJob, what: str = "") -> None:
        if what == EXPOSED:  # which this process finds, once all windows are made
            return
        reports.append(1)
        if len(reports) == 3 and place == "seen":
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)

    for place in ("seen", "elsewhere", "nowhere"):
        reports.clear()
        job = plan_spread(whole(), client)
        with monkeypatch.context() as patch, Windows(str(tmp_path / "a"), job.request) as job.store:
            patch.setattr(WindowsJob, "_report", kill)
            if place == "elsewhere":
                patch.setattr(Windows, "take_note", lambda *_: False)
            if place == "nowhere":
                job.store.place = "/nowhere", ""
            made, _ = warned(job.run)
            assert in_memory(made) == octree
            assert len(reports) == job.plan.count


@pytest.mark.parametrize("name", WITH_VALUES)
def test_a_killed_run_goes_on(
    name: str, client: Client, models: Path, tmp_path, monkeypatch
) -> None:
    whole = planner(models, name)
    octree, _ = warned(whole().run)
    reports: list[int] = []

    def die(_: WindowsJob, what: str = "") -> None:
        if what == EXPOSED:
            return
        reports.append(1)
        if len(reports) == 20:
            raise KeyboardInterrupt

    monkeypatch.setattr(WindowsJob, "_report", die)
    for _ in range(2):
        job = plan_spread(whole(), client)
        store = Windows(str(tmp_path / "a"), job.request, resume=True)
        with suppress(KeyboardInterrupt), store as job.store:
            made, _ = warned(job.run)
            assert in_memory(made) == octree
    assert job.plan.count <= len(reports) <= job.plan.count + 1


def test_more_nodes_than_links_reach_are_refused() -> None:
    whole, part = SimpleNamespace(nodes=MAX_LINK, bricks=0), Part((0, 0, 0, 8))
    WindowsPlan(whole, part, workers=1, merged=True).refuse_beyond(0, 0)
    with pytest.raises(MemoryLimitError, match="nodes exceeds links of 30 bits"):
        WindowsPlan(whole, part, workers=1).refuse_beyond(0, 0)


@pytest.mark.parametrize("seen", [True, False], ids=["seen", "elsewhere"])
def test_workers_write_windows_where_they_see_the_folder(
    seen: bool, spread, surface: Octree, monkeypatch
) -> None:
    """A folder of the same name that is another one costs a second call."""
    job, sent = spread(), []
    put, note = job.store.put, job.store.take_note
    monkeypatch.setattr(job.store, "put", lambda *given: (sent.append(given[0]), put(*given)))
    if not seen:
        other = {"files": {"0": (1 << 40, "")}}
        monkeypatch.setattr(job.store, "take_note", lambda line: note({**line, **other}))
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


def test_files_become_labels_on_the_command_line(here: Path) -> None:
    command = "voxelize bunny.obj open.obj --dim 150 --labels file --attributes normal --json"
    whole = told(f"{command} -o whole.svo.h5")
    parts = told(f"{command} -o parts.svo.h5 --dask local --workers 1")
    same = {*whole} - {"output", "stages", "seconds"}
    assert {key: parts[key] for key in same} == {key: whole[key] for key in same}
    assert Path("parts.svo.h5").read_bytes() == Path("whole.svo.h5").read_bytes()


def test_bars_on_the_command_line(here: Path) -> None:
    command = "voxelize bunny.obj --dim 200 --mode fraction --face-fractions"
    command += " -o parts.svo.h5 --dask local --workers 2"
    assert "64 x 64 voxels across, made by 2 workers of Dask" in run(f"{command} --plan").stdout
    plan: dict = told(f"{command} --plan --json")
    assert plan["workers"] == 2 < plan["windows"]
    assert "--labels makes one octree: drop --workers" in fail(
        "voxelize bunny.obj open.obj --labels file --workers 2", 2
    )


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
