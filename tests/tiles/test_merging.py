"""Octrees merged window by window: the same subtrees as from all nodes, wherever windows end."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli import fail, run, told
from helpers.merged import OCTREES

from voxtool.errors import MemoryLimitError
from voxtool.files import open_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.opencl import Device
from voxtool.svo.dag.merge import Subtrees, join, merge, no_subtrees
from voxtool.svo.dag.merged import MERGE_BYTES, MergedOctree
from voxtool.svo.octree.links import level_states
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tiles import workers
from voxtool.tiles.plan import plan_windows
from voxtool.tiles.subtree import depth_of, subtree_of

TABLES = ("root", "starts", "masks", "links", "leaves")


def assert_same_tables(one: MergedOctree, other: MergedOctree) -> None:
    for name in TABLES:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for item in fields(one):
        if item.name not in TABLES:
            assert getattr(one, item.name) == getattr(other, item.name), item.name


def merged_in_cubes(dense: np.ndarray, mode: str, low: np.ndarray, side: int, least: int):
    """The subtrees of a cube, joined from cubes of `least` voxels, each merged by itself."""
    part = dense[tuple(slice(a, a + side) for a in low)]
    if not part.size:
        return no_subtrees(depth_of(side))
    if side == least:
        octree = Octree.from_dense(np.pad(part, [(0, side - n) for n in part.shape]), mode=mode)
        return merge(subtree_of(octree, side).levels[::-1], octree.bricks)
    halves = low + side // 2 * morton_decode(np.arange(8, dtype=np.uint64))
    return join([merged_in_cubes(dense, mode, half, side // 2, least) for half in halves])


@pytest.mark.parametrize("name", OCTREES)
def test_cubes_join_to_the_subtrees_of_the_whole(name: str) -> None:
    mode = "surface26" if name.startswith("surface") else "solid"
    dense = OCTREES[name]().to_dense()
    octree = Octree.from_dense(dense, mode=mode)
    expected = merge(level_states(octree.offsets, octree.nodes), octree.bricks)
    for least in 8, 16:
        found: Subtrees = merged_in_cubes(dense, mode, np.zeros(3, int), octree.grid.side, least)
        assert found.root == expected.root
        np.testing.assert_array_equal(found.leaves, expected.leaves)
        for one, other in zip(found.rows, expected.rows, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("mode", ["solid", "surface6"])
def test_windows_merge_to_the_octree_of_one_piece(mode: str, models: Path, device: Device) -> None:
    mesh = load_mesh(models / "bunny.obj")
    grid = Grid.fit(mesh, 400)
    whole = plan_voxelize(mesh, grid, mode, device=device)
    for parts in 1.6, 3.0:
        limit = int((whole.plan.cost.host + MERGE_BYTES * whole.plan.bricks) / parts)
        limit = max(limit, int(whole.plan.cost.device / parts))
        part = plan_voxelize(mesh, grid, mode, device=device, max_memory=limit)
        job = plan_windows(part, merged=True)
        assert job.plan.count > 3
        assert_same_tables(job.run(), MergedOctree.of(whole.run()))


def test_subtrees_beyond_the_limit_are_refused(models: Path, device: Device) -> None:
    mesh = load_mesh(models / "bunny.obj")
    whole = plan_voxelize(mesh, Grid.fit(mesh, 200), device=device, max_memory=400_000)
    job = plan_windows(whole, merged=True)
    job.whole.max_memory = 10_000
    with pytest.raises(MemoryLimitError, match=r"distinct subtrees of 256 voxels a side take"):
        job._run()


def test_the_command_merges_by_windows(here: Path) -> None:
    asked = "voxelize bunny.obj --dim 400 --dag --json"
    limited = f"{asked} --max-memory {told(f'{asked} --plan')['predicted_device_bytes'] // 2}"
    one, two = told(f"{asked} -o one.svo.h5"), told(f"{limited} -o two.svo.h5")
    assert told(f"{limited} --plan")["windows"] > 1
    assert two["digest"] == one["digest"]
    with open_svo("one.svo.h5") as first, open_svo("two.svo.h5") as second:
        assert isinstance(first, MergedOctree)
        assert isinstance(second, MergedOctree)
        assert_same_tables(first, second)
    assert not Path("two.svo.h5.windows").exists()
    assert "windows    " in run(limited.replace("--json", "--plan")).stdout
    assert "is the largest that fits" in fail(f"{limited} --windows never -o three.svo.h5")


def test_a_killed_run_goes_on(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = "voxelize bunny.obj --dim 400 --dag --json"
    whole = told(f"{asked} -o one.svo.h5")
    limit = told(f"{asked} --plan")["predicted_device_bytes"] // 3
    limited = f"{asked} --max-memory {limit} -o two.svo.h5"
    windows, left, merge = told(f"{limited} --plan")["windows"], [2], workers.merge

    def dies(*window: Any) -> Any:
        if not left[0]:
            raise Killed
        left[0] -= 1
        return merge(*window)

    monkeypatch.setattr(workers, "merge", dies)
    with pytest.raises(Killed):
        run(limited)
    folder, left[0] = Path("two.svo.h5.windows"), 100
    made = list(folder.rglob("*.1"))
    assert len(made) == 2  # the leaves of each window
    made[0].write_bytes(made[0].read_bytes()[:-1])  # cut off
    plain = limited.replace("--dag ", "")
    assert "is of another mesh, grid or options" in fail(f"{plain} --resume", 3)
    assert told(f"{limited} --resume")["digest"] == whole["digest"]
    assert 100 - left[0] == windows - 1
    assert Path("two.svo.h5").read_bytes() == Path("one.svo.h5").read_bytes()
    assert not folder.exists()


class Killed(Exception):
    """Stands for a kill."""
