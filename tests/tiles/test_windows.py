"""Octrees made in windows: the same nodes, bricks and digests as in one piece, and what a killed
run leaves."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, run, told

from voxtool import claims
from voxtool.errors import FileError
from voxtool.files import read_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Key, Store, Window, Windows, write_beside
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.links import nodes_of, offsets_of
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.voxelize import VoxelizeJob, plan_voxelize
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
    (tmp_path / "y.windows").write_text("")
    for name in ("x.svo.h5", "y"):
        with pytest.raises(FileError, match="is in the way: rename it"):
            Windows(str(tmp_path / name), {})
    assert (folder / "mine").exists()
    with pytest.raises(FileError, match="cannot write"):
        Windows(str(tmp_path / "none" / "x"), {})


def test_a_disk_without_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 9, 1000))
    target = str(tmp_path / "x.svo.h5")
    with pytest.raises(FileError, match=r"x.svo.h5 needs about 2 kB of disk, of 1 kB free"):
        Windows(target, {}, needed=2000)
    assert not (tmp_path / "x.svo.h5.windows").exists()
    with Windows(target, {}, needed=900) as store:
        assert json.loads((store.folder / "windows.jsonl").read_text())["request"] == {}


def test_windows_of_an_older_version_are_removed(tmp_path: Path) -> None:
    folder = tmp_path / "a.windows"
    folder.mkdir()
    (folder / "windows.jsonl").write_text('{"voxtool": "windows", "version": 1, "request": {}}\n')
    (folder / "0-0-0-8.0").write_bytes(b"1")
    with pytest.raises(FileError, match="is of another mesh, grid or options"):
        Windows(str(tmp_path / "a"), {}, resume=True)
    with Windows(str(tmp_path / "a"), {}) as store:
        assert len(store) == 0
    assert not folder.exists()


def window_of(seed: int) -> Window:
    """Return a window with bricks and an attribute."""
    random = np.random.default_rng(seed)
    masks, values = random.integers(1, 99, 2, np.uint64), random.random((3, 3), np.float32)
    normal = Attribute("normal", values, values[:0], masks, (0, 0, 0))
    return Window([random.integers(0, 3, 8, np.uint8)], masks, 3, [normal])


KEYS = (0, 0, 0, 8), (8, 0, 0, 8)
FILES = ("0", "1", "normal.masks", "normal.values")


def content(store: Store, key: Key) -> list[np.ndarray]:
    """Return all that is read back of a window."""
    parts = (store.array(key, "normal", part) for part in ("masks", "values", "leaves"))
    return [*store.get(key)[0], *store.bricks(key), *(block for part in parts for block in part)]


@pytest.mark.parametrize("how", ["flip", "cut", "longer", "empty", "other", "gone"])
@pytest.mark.parametrize("name", FILES)
def test_whatever_is_read_back_is_what_was_written(name: str, how: str, tmp_path: Path) -> None:
    with Windows(str(tmp_path / "a"), {}) as store:
        for seed, key in enumerate(KEYS):
            store.put(key, window_of(seed))
        whole = content(store, KEYS[0])
        file, other = (store.folder / f"{'-'.join(map(str, key))}.{name}" for key in KEYS)
        data = file.read_bytes()
        changed = {
            "flip": data[:-1] + bytes([data[-1] ^ 1]),
            "cut": data[:-8],
            "longer": data + b"x",
            "empty": b"",
            "other": other.read_bytes(),
        }
        file.unlink() if how == "gone" else file.write_bytes(changed[how])
        with pytest.raises(
            FileError, match=r"is gone: another run|is not what this run wrote"
        ) as no:
            content(store, KEYS[0])
        assert "\n" not in str(no.value)
        again = Store(store.folder, {})  # as --resume reads it
        assert (KEYS[0] in again, KEYS[1] in again) == (False, True)
        file.write_bytes(data)
        np.testing.assert_equal(content(store, KEYS[0]), whole)


def test_a_run_owns_its_folder(tmp_path: Path) -> None:
    target = str(tmp_path / "a")
    with Windows(target, {"n": 1}) as store:
        store.put(KEYS[0], window_of(0))
        for resume in (False, True):
            for request in ({"n": 1}, {"n": 2}):
                with pytest.raises(FileError, match=r"another run .* is making"):
                    Windows(target, request, resume=resume, keep=not resume)
        with Windows(str(tmp_path / "b"), {"n": 1}):
            pass
        assert len(content(store, KEYS[0])) > 2
    assert not list(tmp_path.iterdir())


def test_runs_that_come_and_go_are_refused_or_own_the_folder(tmp_path: Path) -> None:
    said, errors, owned = set[str](), list[BaseException](), [0]

    def come_and_go(number: int) -> None:
        end = time.monotonic() + 1
        while time.monotonic() < end:
            try:
                with Windows(str(tmp_path / "a"), {"n": number}) as store:
                    store.put(KEYS[0], window_of(number))
                    assert len(content(store, KEYS[0])) > 2
                    owned[0] += 1
            except FileError as error:
                said.add(str(error).partition(" (process")[0])
            except BaseException as error:
                errors.append(error)

    threads = [threading.Thread(target=come_and_go, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert {text.split(" is making")[0] for text in said} <= {"another run"}
    assert owned[0]
    assert not list(tmp_path.iterdir())


def test_a_run_that_lost_its_folder_ends_in_one_line(tmp_path: Path, monkeypatch) -> None:
    """Locks are not known there, and the run was stopped for long."""
    target = str(tmp_path / "a")
    lost = Windows(target, {"n": 1})
    lost.put(KEYS[0], window_of(0))
    monkeypatch.setattr(claims.Claim, "_lock", lambda _: False)
    monkeypatch.setattr(claims, "machine", lambda: "another")
    monkeypatch.setattr(claims, "BEAT", 0.01)
    with Windows(target, {"n": 1}, resume=True) as store:
        assert KEYS[0] in store
        for call in (lambda: lost.put(KEYS[1], window_of(1)), lambda: content(lost, KEYS[0])):
            with pytest.raises(FileError, match=r"is gone: another run or program has taken"):
                call()
        lost.__exit__(None)
        assert len(content(store, KEYS[0])) > 2
    assert not list(tmp_path.iterdir())


def test_a_window_that_two_workers_make_is_whole(tmp_path: Path) -> None:
    with Windows(str(tmp_path / "a"), {}) as store:
        one, two = (write_beside(store.place, KEYS[0], window_of(0)) for _ in range(2))
        assert one == two
        assert one
        assert store.take_note(one)
        assert len(list(store.folder.iterdir())) == len(FILES) + 2  # leaves, and the journal
        assert write_beside((store.place[0], "{}"), KEYS[1], window_of(1)) is None
        assert len(content(store, KEYS[0])) > 2


def test_what_another_process_wrote_counts_if_it_is_whole(tmp_path: Path) -> None:
    with Windows(str(tmp_path / "a"), {}) as store:
        line = write_beside(store.place, KEYS[0], window_of(0))
        assert line
        assert store.take_note(line)
        file = store.folder / "0-0-0-8.normal.values"
        file.write_bytes(file.read_bytes()[:-4])
        assert not store.take_note(line)
