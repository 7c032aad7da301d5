"""Floods in windows: the same nodes and bricks as in one piece, however the grid is divided."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import run, told
from helpers.meshes import UNIT
from svo.voxelization.test_voxelize import lattice_grid, lattice_mesh

from voxtool.files import write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.octrees.windows import Windows
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.svo.voxelization.flood_window import FloodWindowJob
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.tiles.plan import plan_windows
from voxtool.tiles.windows import WindowsJob

DIVISIONS = {
    "halves": lambda key: key[3] <= 128,
    "least": lambda key: key[3] <= 64,
    "mixed": lambda key: key[3] <= (64 if sum(key[:3]) // 128 % 2 else 128),
}


def divided(monkeypatch: pytest.MonkeyPatch, division: str) -> None:
    """Make windows as a division says, whatever memory they take."""

    def shortage(_: Any, job: FloodWindowJob) -> str:
        frame = job.frame
        key = *(frame.low - frame.corner).tolist(), frame.window
        return "" if DIVISIONS[division](key) else "would not fit"

    monkeypatch.setattr(WindowsJob, "_shortage", shortage)


def corridor() -> tuple[np.ndarray, np.ndarray]:
    """A closed hull but for one opening, with a corridor that leads to and fro through it, past
    closed chambers: what is outside in a window depends on windows far away."""
    boxes = [
        ((4, 4, 4), (180, 60, 296)),
        ((9, 9, 20), (13, 15, 280)),
        ((170, 9, 30), (174, 55, 290)),
    ]
    parts = [meshes.box(*(np.array(pair) * UNIT + 9).tolist()) for pair in boxes]
    hull = np.delete(parts[0][1], (0, 1), axis=0)
    walls = [sheet((60, 4, 4), (60, 60, 250)), sheet((120, 4, 50), (120, 60, 296))]
    return meshes.join((parts[0][0], hull), *parts[1:], *walls)


def sheet(low, high) -> tuple[np.ndarray, np.ndarray]:
    """A rectangle of one x."""
    corners = np.array([low, (low[0], high[1], low[2]), high, (low[0], low[1], high[2])])
    return corners * UNIT + 9, np.array([[0, 1, 2], [0, 2, 3]])


def scraps(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and boxes, some across the whole grid, some beyond it."""
    random = np.random.default_rng(seed)
    corners = random.integers(-20, 220, (24, 1, 3)) + random.integers(-60, 60, (24, 3, 3))
    loose = corners.reshape(-1, 3) * UNIT + 9, np.arange(72).reshape(-1, 3)
    lows = random.integers(0, 140, (6, 3))
    ends = [(low, low + random.integers(5, 80, 3)) for low in lows]
    boxes = [meshes.box(*((np.array(pair) * UNIT + 9).tolist())) for pair in ends]
    return meshes.join(loose, *boxes)


@pytest.mark.parametrize("division", DIVISIONS)
@pytest.mark.parametrize(
    ("mesh", "shape", "gap"),
    [
        (corridor(), (184, 64, 300), 0),
        (corridor(), (184, 64, 300), 4),
        (scraps(1), (200, 170, 190), 0),
        (scraps(2), (129, 200, 60), 5),
    ],
    ids=["corridor", "corridor-4", "scraps", "scraps-5"],
)
def test_windows_give_the_flood_of_one_piece(
    mesh, shape, gap: int, division: str, tmp_path, device: Device, monkeypatch
) -> None:
    divided(monkeypatch, division)
    given = lattice_mesh(*mesh), lattice_grid(shape)
    whole = plan_voxelize(*given, fill="flood", gap=gap, device=device)
    octree = whole.run()
    job, target = plan_windows(whole), tmp_path / "octree.svo.h5"
    assert job.plan.count > 1
    with Windows(str(target), job.request) as job.store:
        made = job.run()
        write_svo(made, target)
    assert (made.digest(), made.count) == (octree.digest(), octree.count)


def test_an_inside_without_faces_is_full(tmp_path, device: Device, monkeypatch) -> None:
    divided(monkeypatch, "halves")
    box, grid = lattice_mesh(*meshes.box(20 * UNIT, 364 * UNIT)), lattice_grid((384,) * 3)
    whole = plan_voxelize(box, grid, fill="flood", device=device)
    octree, job = whole.run(), plan_windows(whole, merged=True)
    assert not job.plan.root.parts[0].parts[7].window
    assert job.run().digest() == octree.digest()


@pytest.mark.parametrize("gap", [0, 3])
def test_the_grid_may_cut_the_mesh(
    gap: int, models: Path, tmp_path, device: Device, monkeypatch
) -> None:
    divided(monkeypatch, "mixed")
    mesh = load_mesh(models / "open.obj")
    grid = Grid.fit(mesh, 300).window((40, 6, 0), (260, 202, 280))
    whole = plan_voxelize(mesh, grid, fill="flood", gap=gap, device=device)
    octree = whole.run()
    assert plan_windows(whole, merged=True).run().digest() == octree.digest()


def test_floods_of_the_command_line(here: Path) -> None:
    command = "voxelize open.obj --dim 600 --fill flood --gap 2 --json"
    whole, cost = told(f"{command} -o whole.svo.h5"), told(f"{command} --plan")
    limit = cost["predicted_device_bytes"] * 6 // 10
    less = f"{command} --max-memory {limit}"
    plan: dict = told(f"{less} -o parts.svo.h5 --plan")
    assert plan["windows"] > 1
    assert plan["predicted_device_bytes"] <= limit
    for more in ("-o parts.svo.h5", "-o merged.svo.h5 --dag"):
        assert told(f"{less} {more}")["digest"] == whole["digest"]
    run("svo-info parts.svo.h5 --check")
