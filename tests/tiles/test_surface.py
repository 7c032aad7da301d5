"""Surfaces extracted in windows: the same points and faces, in the same order, as in one piece."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli import fail, told

from voxtool.files import read_svo, write_svo
from voxtool.files.storage.spool import Spool
from voxtool.opencl import Device
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import extract, plan_unread
from voxtool.tiles.surface import SurfaceWindowsJob

STYLES = [
    ("voxel-faces", "voxel", 16),
    ("surface-nets", "voxel", 32),
    ("marching-cubes", "voxel", 16),
    ("marching-cubes", 0, 64),
    ("surface-nets", 0, 64),
]


def octree_of(seed: int, size: tuple[int, int, int] = (7, 5, 3)) -> Octree:
    """Return an octree with large full and empty leaves, also at the low sides of the grid."""
    random = np.random.default_rng(seed)
    coarse = random.random(size) < (0.1, 0.5, 0.95)[seed]
    dense = np.kron(coarse, np.ones((8, 8, 8), bool))[:-3]
    return Octree.from_dense(dense ^ (random.random(dense.shape) < (0, 0.02, 0.001)[seed]))


def windows_of(octree: Octree, side: int, device: Device, **request) -> SurfaceWindowsJob:
    """Return the job in windows of `side` voxels."""
    job = SurfaceWindowsJob(octree, plan_unread(octree, **request), device, None)
    job.plan = replace(job.plan, side=side)
    return job


@pytest.mark.parametrize(("style", "level", "side"), STYLES)
@pytest.mark.parametrize("seed", [1, 2])
def test_windows_make_the_surface(
    seed: int, style: str, level: int | str, side: int, device: Device, tmp_path: Path
) -> None:
    octree = octree_of(seed, (7, 5, 3) if level == "voxel" else (13, 9, 5))
    request: dict[str, Any] = {
        "style": style,
        "level": level,
        "isovalue": 0.3 if seed == 1 else 0.5,
    }
    whole = extract(octree, device=device, **request)
    job = windows_of(octree, side, device, **request)
    messages: list[str] = []
    with Spool(tmp_path / "a") as job.store:
        found = job.run(messages.append)
        points, faces = (np.concatenate(list(x.blocks)) for x in (found.points, found.faces))
        np.testing.assert_array_equal(points, whole.points)
        np.testing.assert_array_equal(faces, whole.faces)
        assert found.digest() == whole.digest()
        vertices = np.concatenate(list(found.vertices.blocks))
    np.testing.assert_array_equal(vertices, whole.vertices)
    assert (found.cubes, found.lost, found.text) == (whole.cubes, whole.lost, whole.text)
    assert found.volume == whole.volume
    assert found.sizes == (len(points), len(faces))
    assert len(messages) > 7


def test_windows_of_voxels_without_an_inside(device: Device, tmp_path: Path) -> None:
    octree = Octree.from_dense(octree_of(1).to_dense(), mode="surface26")
    request: dict[str, Any] = {"style": "voxel-faces", "level": "voxel"}
    job = windows_of(octree, 32, device, **request)
    with Spool(tmp_path / "a") as job.store:
        assert job.run().digest() == extract(octree, device=device, **request).digest()


def test_windows_that_do_not_fit_are_halved(device: Device, tmp_path: Path) -> None:
    octree = octree_of(1)
    job = windows_of(octree, 64, device, style="voxel-faces", level="voxel")
    job.max_memory = 750_000
    with Spool(tmp_path / "a") as job.store:
        found = job.run()
        assert found.digest() == extract(octree, style="voxel-faces", device=device).digest()
    assert job.plan.side < 64


def test_an_empty_octree_has_no_surface(device: Device, tmp_path: Path) -> None:
    octree = Octree.from_dense(np.zeros((64, 64, 64), bool))
    job = windows_of(octree, 16, device, style="voxel-faces", level="voxel")
    with Spool(tmp_path / "a") as job.store:
        found = job.run()
        assert found.digest() == extract(octree, style="voxel-faces", device=device).digest()
    assert found.sizes == (0, 0)


def test_extract_in_windows(here: Path) -> None:
    command = "extract bunny.svo.h5 --style voxel-faces --json"
    whole = told(f"{command} -o whole.ply")
    limited = f"{command} --max-memory 1500K"
    assert told(f"{limited} -o parts.ply --plan")["windows"] > 8
    parts = told(f"{limited} -o parts.ply")
    assert Path("parts.ply").read_bytes() == Path("whole.ply").read_bytes()
    same = ("digest", "vertices", "triangles", "cubes_cut", "voxels", "dim", "style", "level")
    assert {name: parts[name] for name in same} == {name: whole[name] for name in same}
    write_svo(MergedOctree.of(read_svo("bunny.svo.h5")), "dag.svo.h5")
    merged = limited.replace("bunny.svo", "dag.svo")
    assert told(f"{merged} -o parts.ply")["digest"] == whole["digest"]
    assert Path("parts.ply").read_bytes() == Path("whole.ply").read_bytes()
    for refused in ("-o a.obj", "-o a.ply --windows never", "-o a.ply --check", "-o a.ply --merge"):
        message = fail(f"{limited} {refused}", 4)
        assert "allowed: choose level" in message
        hinted = "a .ply without other options is made in windows" in message
        assert hinted == (refused in ("-o a.obj", "-o a.ply --check"))
    assert sorted(path.name for path in here.glob("*.ply")) == ["parts.ply", "whole.ply"]
