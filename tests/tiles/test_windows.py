"""Octrees made in windows: the same nodes, bricks and digests as in one piece, and what a killed
run leaves."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from helpers_cli import fail, run, told

from voxtool.errors import FileError
from voxtool.files import read_svo
from voxtool.files.mesh import load_mesh
from voxtool.files.windows import Window, Windows, write_beside
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.attributes import Attribute
from voxtool.svo.links import nodes_of, offsets_of
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import VoxelizeJob, plan_voxelize
from voxtool.tiles.subtree import empty_subtree, joined, subtree_of
from voxtool.tiles.windows import WindowsJob


def limit_of(job: VoxelizeJob, parts: float) -> int:
    """Return a limit of memory that makes windows of a job."""
    return int(job.plan.cost.device / parts)


def in_windows(mesh, grid: Grid, target: Path, device: Device, parts: float = 1.6, **request):
    """Return an octree made in windows, and how many there were."""
    whole = plan_voxelize(mesh, grid, device=device, **request)
    limit = limit_of(whole, parts)
    job = WindowsJob(plan_voxelize(mesh, grid, device=device, max_memory=limit, **request))
    from voxtool.files import write_svo

    with Windows(str(target), job.request) as job.store:
        octree = job.run()
        write_svo(octree, target)
        assert len(job.store) == len(job.plan.plans)
    assert not job.store.folder.exists()
    return octree, len(job.plan.plans)


@pytest.mark.parametrize("mode", ["solid", "surface26"])
@pytest.mark.parametrize("seed", range(6))
def test_subtrees_join_to_the_octree(seed: int, mode: str) -> None:
    random = np.random.default_rng(seed)
    shape = random.integers(9, 33, 3)
    coarse = random.random(-(-shape // 4)) < random.choice([0.1, 0.5, 0.9])
    dense = np.kron(coarse, np.ones((4, 4, 4), bool))[tuple(slice(n) for n in shape)]
    dense ^= random.random(tuple(shape)) < random.choice([0, 0.01])
    whole = Octree.from_dense(dense, mode=mode)
    side, parts, bricks = 8, [], []
    cells = morton_decode(np.arange((whole.grid.side // side) ** 3, dtype=np.uint64))
    for low in cells * side:
        part = dense[tuple(slice(a, a + side) for a in low)]
        if not part.size:
            parts.append(empty_subtree(side))
            continue
        octree = Octree.from_dense(np.pad(part, [(0, side - n) for n in part.shape]), mode=mode)
        parts.append(subtree_of(octree, side))
        bricks.append(octree.bricks)
    while len(parts) > 1:
        parts = [joined(parts[i : i + 8]) for i in range(0, len(parts), 8)]
    tree = parts[0]
    np.testing.assert_array_equal(offsets_of(tree.levels, tree.bricks), whole.offsets)
    np.testing.assert_array_equal(np.concatenate(list(nodes_of(tree.levels))), whole.nodes)
    np.testing.assert_array_equal(np.concatenate(bricks), whole.bricks)


Case = namedtuple("Case", "name request")
CASES = [
    Case("bunny.obj", {"mode": "surface26"}),
    Case("bunny.obj", {"mode": "surface6"}),
    Case("bunny.obj", {}),
    Case("bunny.obj", {"fill": "nonzero", "with_surface": True}),
    Case("open.obj", {}),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_digest_is_that_of_one_piece(case: Case, models: Path, tmp_path, device) -> None:
    mesh = load_mesh(models / case.name)
    # neither a power of two nor a cube; for a solid, rows enter the grid inside
    grid = Grid.fit(mesh, 300).window((40, 6, 0), (260, 202, 280))
    whole = plan_voxelize(mesh, grid, device=device, **case.request).run()
    target = tmp_path / "windows.svo.h5"
    made, count = in_windows(mesh, grid, target, device, **case.request)
    assert count > 1
    assert made.digest() == whole.digest() == read_svo(target).digest()
    assert (made.count, made.nbytes) == (whole.count, whole.nbytes)
    assert read_svo(target).plan["fill"] == whole.fill


def test_windows_of_the_command_line(here: Path) -> None:
    whole = told("voxelize bunny.obj --dim 400 -o whole.svo.h5 --json")
    command = "voxelize bunny.obj --dim 400 -o parts.svo.h5 --max-memory 500k --json"
    plan: dict = told(f"{command} --plan")
    assert plan["windows"] > 1
    assert plan["predicted_device_bytes"] <= 500 << 10
    assert not Path("parts.svo.h5.windows").exists()
    parts = told(command)
    for name in ("digest", "voxels", "nodes", "bricks", "bytes", "grid", "fill"):
        assert parts[name] == whole[name]
    run("svo-info parts.svo.h5 --check")
    assert f"{plan['windows']} windows of " in run(f"{command.replace('--json', '')} --plan").stdout


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        ("--max-memory 500k --windows never", 4, "is the largest that fits (see --max-memory)"),
        ("--max-memory 500k -o x.npy", 4, "is the largest that fits (see --max-memory)"),
        ("--max-memory 500k --fill flood", 4, "is the largest that fits (see --max-memory)"),
        ("--max-memory 500k -o -", 2, "windows wait beside the output: name a file with -o"),
        ("--max-memory 20k", 4, "no dim fits (see --max-memory)"),
    ],
)
def test_refusals(command: str, code: int, message: str, here: Path) -> None:
    assert message in fail(f"voxelize bunny.obj --dim 400 {command}", code)


class Killed(Exception):
    """Stands for a kill."""


@pytest.fixture
def dying(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of windows after which a run dies; counts those that were made."""
    left, run = [3], VoxelizeJob._run

    def dies(job: VoxelizeJob) -> Octree:
        if not left[0]:
            raise Killed
        left[0] -= 1
        return run(job)

    monkeypatch.setattr(VoxelizeJob, "_run", dies)
    return left


def test_a_killed_run_goes_on(dying: list[int], here: Path) -> None:
    command = "voxelize bunny.obj --dim 400 -o parts.svo.h5 --max-memory 500k --json"
    windows = told(f"{command} --plan")["windows"]
    folder = Path("parts.svo.h5.windows")
    with pytest.raises(Killed):
        run(command)
    assert not Path("parts.svo.h5").exists()
    (own,) = (path for path in folder.iterdir() if path.name != ".owner")
    made = [path for path in own.iterdir() if path.name != "windows.jsonl"]
    assert len(made) == 6  # states and bricks
    made[1].write_bytes(made[1].read_bytes()[:-1])  # cut off
    with open(own / "windows.jsonl", "a") as journal:
        journal.write('{"window": [0, 0')
    other = command.replace("400", "401")
    dying[0] = 100
    assert "is of another mesh, grid or options" in fail(f"{other} --resume", 3)
    assert (
        told(f"{command} --resume")["digest"]
        == told("voxelize bunny.obj --dim 400 -o whole.svo.h5 --json")["digest"]
    )
    assert 100 - dying[0] == windows - 2 + 1  # two were kept; one is the whole
    assert not folder.exists()


def test_a_failed_run_leaves_what_it_is_told_to(dying: list[int], here: Path) -> None:
    command = "voxelize bunny.obj --dim 400 -o parts.svo.h5 --max-memory 500k"
    with pytest.raises(Killed):
        run(f"{command} --no-keep")
    assert not Path("parts.svo.h5.windows").exists()
    dying[0] = 1
    with pytest.raises(Killed):
        run(command)
    assert Path("parts.svo.h5.windows").exists()
    dying[0] = 100
    run(command)  # without --resume from the start
    assert not Path("parts.svo.h5.windows").exists()


def test_a_folder_that_is_something_else(tmp_path: Path) -> None:
    folder = tmp_path / "x.svo.h5.windows"
    folder.mkdir()
    (folder / "mine").write_text("")
    with pytest.raises(FileError, match="is in the way: rename it"):
        Windows(str(tmp_path / "x.svo.h5"), {})
    assert (folder / "mine").exists()


def test_a_disk_without_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 9, 1000))
    target = str(tmp_path / "x.svo.h5")
    with pytest.raises(FileError, match=r"x.svo.h5 needs about 2 kB of disk, of 1 kB free"):
        Windows(target, {}, needed=2000)
    assert not (tmp_path / "x.svo.h5.windows").exists()
    with Windows(target, {}, needed=900) as store:
        assert json.loads((store.folder / "windows.jsonl").read_text())["request"] == {}


def test_what_another_process_wrote_counts_if_it_is_whole(tmp_path: Path) -> None:
    masks, values = np.array([5, 1], np.uint64), np.zeros((3, 3), "f4")
    normal = Attribute("normal", values, values[:0], masks, (0, 0, 0))
    window = Window([np.zeros(1, np.uint8)], masks, 3, [normal])
    with Windows(str(tmp_path / "a"), {}) as store:
        line = write_beside(store.place, (0, 0, 0, 8), window)
        assert line
        assert store.take_note(line)
        file = store.folder / "0-0-0-8.normal.values"
        file.write_bytes(file.read_bytes()[:-4])
        assert not store.take_note(line)
