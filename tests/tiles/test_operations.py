"""Combinations and morphology in windows: the same nodes and bricks as in one piece, which other
tests compare with dense arrays; and how windows are read, divided, kept and refused."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, run, told
from helpers.files import memory_below
from helpers.meshes import icosphere
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
import voxtool.tiles
from voxtool.choices import ELEMENTS, MORPHOLOGY, OPERATIONS
from voxtool.errors import MemoryLimitError
from voxtool.files import open_svo, read_svo, write_svo
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.svo.cells.subtrees import Cells
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine, plan_combine
from voxtool.svo.sets.morphology import plan_morph
from voxtool.svo.sets.placing import placed_octree
from voxtool.tiles.combining import CombineWindowsJob
from voxtool.tiles.make import in_memory
from voxtool.tiles.morphing import MorphWindowsJob, plan_unread
from voxtool.tiles.operations import Operand, OperationJob

PITCH = (0.5, 0.25, 1.0)


def blocky(random: np.random.Generator, shape: np.ndarray | None = None) -> np.ndarray:
    """Return voxels with full and empty blocks of many sizes, and some single ones."""
    shape = random.integers(9, 70, 3) if shape is None else shape
    block = random.choice([4, 8, 16])
    coarse = random.random(-(-shape // block)) < random.choice([0.1, 0.5, 0.9])
    dense = np.kron(coarse, np.ones((block,) * 3, bool))[tuple(slice(n) for n in shape)]
    return dense ^ (random.random(tuple(shape)) < random.choice([0, 0.002]))


def cut(dense: np.ndarray, begin: np.ndarray, side: int) -> np.ndarray:
    """Return the voxels of a cube from a voxel on, which may lie beyond all voxels."""
    found = np.zeros((side,) * 3, bool)
    low, high = np.maximum(begin, 0), np.minimum(begin + side, dense.shape)
    if (low < high).all():
        inside = tuple(map(slice, low, high))
        found[tuple(map(slice, low - begin, high - begin))] = dense[inside]
    return found


def made(job: OperationJob, folder: Path, side: int) -> tuple[Octree, int]:
    """Return what a job makes in windows of a side, and how many these were."""
    job = job.with_(side=side)
    with Windows(str(folder / "x"), job.request) as job.store:
        octree = in_memory(job.run())
        return octree, len(job.store)


def assert_same(octree: Octree, expected: Octree) -> None:
    """Assert that two octrees have the same grid, nodes, bricks, units and place."""
    assert octree.digest() == expected.digest()
    assert (octree.units, octree.transform) == (expected.units, expected.transform)


@given(seed=st.integers(0, 1 << 32), spread=st.sampled_from([0, 0, 16, 5, 90]))
@settings(max_examples=20)
def test_combinations(device: Device, tmp_path_factory, seed: int, spread: int) -> None:
    random = np.random.default_rng(seed)
    octrees = []
    for _ in range(random.integers(1, 4)):
        low = random.integers(-spread, spread + 1, 3) * PITCH
        octrees.append(Octree.from_dense(blocky(random), tuple(low), PITCH, units="mm"))
    operation = random.choice(OPERATIONS)
    whole = plan_combine(octrees, operation, device=device)
    job = CombineWindowsJob(whole, octrees)
    octree, _ = made(job, tmp_path_factory.mktemp("w"), int(random.choice([16, 32, 64])))
    assert_same(octree, whole.run())
    octree.validate()


@given(seed=st.integers(0, 1 << 32))
@settings(max_examples=20)
def test_morphology(device: Device, tmp_path_factory, seed: int) -> None:
    random = np.random.default_rng(seed)
    octree = Octree.from_dense(blocky(random), (1, 2, 3), PITCH, units="mm")
    operation, shape = random.choice(MORPHOLOGY), random.choice(ELEMENTS)
    request = {"world": bool(random.random() < 0.5), "shape": shape}
    radius = float(random.choice([1, 2.5, 7, 20]) * (0.25 if request["world"] else 1))
    whole = plan_unread(octree, operation, radius, *request.values(), None)
    job = MorphWindowsJob(whole, octree, device, None)
    found, _ = made(job, tmp_path_factory.mktemp("w"), int(random.choice([16, 32, 64])))
    assert_same(found, plan_morph(octree, operation, radius, device=device, **request).run())
    found.validate()


@pytest.mark.parametrize("seed", range(6))
def test_an_octree_placed_in_a_smaller_grid(seed: int) -> None:
    random = np.random.default_rng(seed)
    dense = blocky(random)
    low, shape = random.integers(-40, 60, 3), random.choice([8, 32, 64])
    grid = Grid((shape,) * 3, (0, 0, 0), (1, 1, 1))
    wide = np.pad(dense, 100)[tuple(slice(100 - a, 100 - a + shape) for a in low)]
    found = placed_octree(Octree.from_dense(dense), grid, low)
    assert_same(found, Octree.from_dense(wide))


@pytest.mark.parametrize("seed", range(4))
def test_states_and_parts_of_an_operand(seed: int) -> None:
    random = np.random.default_rng(seed)
    dense, low = blocky(random), random.integers(-20, 21, 3)
    operand, margin = Operand(Octree.from_dense(dense), low), 3
    found = set()
    for _ in range(60):
        side = int(random.choice([8, 16, 32, 128]))
        key = (*(random.integers(-3, 4, 3) * side).tolist(), side)
        begin = np.array(key[:3]) - low
        around = cut(dense, begin - margin, side + 2 * margin)
        state = operand.state(key, margin)
        found.add(state)
        assert state == REFINED or (around == (state == FULL)).all()
        part, corner = operand.part(key, margin, np.inf)
        own = placed_octree(part, Grid((side,) * 3, (0, 0, 0), (1, 1, 1)), corner)
        assert np.array_equal(own.to_dense(), cut(dense, begin, side))
    assert found >= {EMPTY, REFINED}


def test_the_box_around_the_voxels() -> None:
    random = np.random.default_rng(1)
    for dense in (blocky(random), blocky(random), np.pad(np.ones((5, 9, 30), bool), 7)):
        held = np.argwhere(dense)
        octree = Octree.from_dense(dense)
        for bounds in (octree.bounds(), MergedOctree.of(octree).bounds()):
            assert bounds is not None
            assert np.array_equal(bounds, [held.min(axis=0), held.max(axis=0) + 1])
    for dense, full in ((np.zeros((8, 8, 8)), None), (np.ones((16, 16, 16)), [[0] * 3, [16] * 3])):
        octree = Octree.from_dense(dense)
        for bounds in (octree.bounds(), MergedOctree.of(octree).bounds()):
            assert bounds is full or np.array_equal(bounds, full)


def test_windows_that_do_not_fit_are_divided(device: Device, tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    dense = np.zeros((256, 256, 256), bool)
    dense[:126, :126, :126] = random.random((126,) * 3) < 0.5  # all bricks in one place
    octrees = [Octree.from_dense(dense), Octree.from_dense(dense[::-1])]
    whole = plan_combine(octrees, device=device)
    job = CombineWindowsJob(whole, octrees)
    job.max_memory = whole.cost.device // 3
    octree, windows = made(job, tmp_path, 256)
    assert windows > 8
    assert_same(octree, whole.run())
    job.max_memory = 1000
    with pytest.raises(MemoryLimitError, match="a window of 64 voxels a side does not fit in 1 kB"):
        made(job, tmp_path, 256)


def test_morphology_takes_no_more_memory_than_it_may(device: Device, tmp_path: Path) -> None:
    limit = 16_000_000
    octree = voxtool.voxelize(icosphere(3), dim=512, device=device)
    job = MorphWindowsJob(plan_unread(octree, "close", 4, False, "ball", limit), octree, device,
                          limit)  # fmt: skip
    assert job.plan.cost.device + job.plan.cost.host < limit
    with Windows(str(tmp_path / "x"), job.request) as job.store, memory_below(limit):
        job.run()


def test_large_empty_and_full_space_is_not_read(
    device: Device, tmp_path: Path, monkeypatch
) -> None:
    grid = Grid((4096, 4096, 4096), (0, 0, 0), (1, 1, 1))
    one = Octree.from_voxels([(0, 0, 0), (4095, 4095, 4095)], grid)
    every = Octree.from_dense(np.ones((8, 8, 8)), pitch=512)
    full = Octree(grid, "solid", "none", np.minimum(np.arange(12), 1).astype(np.uint32),
                  every.nodes, every.bricks)  # fmt: skip
    whole = plan_combine([full, one], "difference", device=device)
    cut = functools.partialmethod(Cells.cut)
    asked: list[np.ndarray] = []
    monkeypatch.setattr(Cells, "cut", lambda *a: asked.append(a[1]) or cut.__get__(a[0])(*a[1:]))
    octree, windows = made(CombineWindowsJob(whole, [full, one]), tmp_path, 64)
    assert (windows, len(asked)) == (2, 4)
    assert_same(octree, whole.run())


@pytest.fixture
def two(here: Path) -> list[str]:
    """Two octrees of 200 voxels, in files; the second is moved by whole voxels."""
    octree = voxtool.voxelize("bunny.obj", dim=200)
    x, y, z = octree.grid.pitch
    low = np.add(octree.grid.origin, (3 * x, -17 * y, 8 * z))
    write_svo(octree, "a.svo.h5")
    write_svo(Octree.from_dense(octree.to_dense(), tuple(low), (x, y, z)), "b.svo.h5")
    write_svo(MergedOctree.of(octree), "a.dag.svo.h5")
    return ["a.svo.h5", "b.svo.h5"]


def test_commands_make_the_same_files_in_windows(two: list[str]) -> None:
    for command, limit in (
        ("combine a.svo.h5 b.svo.h5", "1M"),
        ("morph a.svo.h5 --close 3", "500k"),
    ):
        whole = told(f"{command} --json -o whole.svo.h5")
        plan = told(f"{command} --max-memory {limit} --plan --json -o parts.svo.h5")
        assert plan["windows"] > 1
        parts = told(f"{command} --max-memory {limit} --json -o parts.svo.h5")
        assert Path("parts.svo.h5").read_bytes() == Path("whole.svo.h5").read_bytes()
        for name in ("digest", "voxels", "volume"):
            assert parts[name] == whole[name]
        merged = told(f"{command.replace('a.svo', 'a.dag.svo')} --max-memory {limit} --json "
                      "-o merged.svo.h5")  # fmt: skip
        assert merged["digest"] == whole["digest"]
        text = run(f"{command} --max-memory {limit} --plan -o parts.svo.h5").stdout
        assert f"about {plan['windows']} windows of {plan['window_side']} voxels a side" in text
        assert not Path("parts.svo.h5.windows").exists()


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        ("combine a.svo.h5 b.svo.h5 --max-memory 1M --windows never", 4, "combine fewer at once"),
        ("combine a.svo.h5 b.svo.h5 --max-memory 1M -o x.npy", 4, "combine fewer at once"),
        ("combine a.svo.h5 b.svo.h5 --max-memory 1M -o -", 2, "windows wait beside the output"),
        ("combine a.svo.h5 b.svo.h5 --max-memory 1k", 4, "combine fewer at once"),
        ("morph a.svo.h5 --open 3 --max-memory 200k --windows never", 4, "choose a smaller radius"),
        ("morph a.svo.h5 --keep largest --max-memory 1k", 4, "make it coarser by --resample"),
    ],
)
def test_refusals(command: str, code: int, message: str, two: list[str]) -> None:
    assert message in fail(command, code)


class Killed(Exception):
    """Stands for a kill."""


def test_a_killed_combination_goes_on(two: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    command = "combine a.svo.h5 b.svo.h5 --max-memory 1M --json -o parts.svo.h5"
    left, window = [3], CombineWindowsJob._window

    def dies(job: CombineWindowsJob, *args) -> Octree:
        if not left[0]:
            raise Killed
        left[0] -= 1
        return window(job, *args)

    monkeypatch.setattr(CombineWindowsJob, "_window", dies)
    with pytest.raises(Killed):
        run(command)
    assert Path("parts.svo.h5.windows").exists()
    left[0] = 100
    assert "is of another" in fail(f"{command} --resume --op xor", 3)
    digest = told(f"{command} --resume")["digest"]
    resumed = 100 - left[0]
    left[0] = 100
    assert told(command)["digest"] == digest
    assert 100 - left[0] == resumed + 3
    assert digest == combine(list(map(read_svo, two))).digest()


def test_in_python(two: list[str], device: Device) -> None:
    with open_svo(two[0]) as a, open_svo(two[1]) as b:
        both = voxtool.tiles.combine(
            [a, b], "intersection", file="both.svo.h5", device=device, max_memory=1 << 20
        )  # pyright: ignore[reportArgumentType]
        wide = voxtool.tiles.morph(a, "dilate", 4, file="wide.svo.h5", device=device)
    assert both.digest() == read_svo("both.svo.h5").digest()
    assert read_svo("both.svo.h5") == read_svo(two[0]) & read_svo(two[1])
    assert wide.digest() == voxtool.morph(read_svo(two[0]), "dilate", 4).digest()
