"""Benchmarks of large and many work: every way gives the octree, and one that does not shows."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

import voxtool
from voxtool.bench import scale
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench
from voxtool.files import write_svo

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(2))
    device = opened(usable_devices()[0][0])
    request = Request(dims=(512,), repeat=1, seconds=0)
    return Bench(request, device, device, "scale", str(tmp_path / "ball.obj"))


def test_every_way_gives_the_octree(bench: Bench) -> None:
    points = list(scale.measure(bench))
    ways = ["in one piece", "in one piece, merged", "in windows", "in windows, merged"]
    read = ["in one piece", "in windows"] * 3  # the first two are of the flood
    assert [point.method for point in points] == [*ways, *read, "one command"]
    assert all(point.errors == {"different": 0} for point in points)
    plain, merged, windows, both = (point.bytes or 0 for point in points[:4])
    assert merged == both < plain / 2
    assert windows == plain


def test_another_octree_is_an_error(bench: Bench, monkeypatch) -> None:
    wrong = voxtool.voxelize(bench.model, dim=16)
    monkeypatch.setattr(scale, "_in_windows", lambda job, target: write_svo(wrong, target))
    written = itertools.islice(scale.measure(bench), 6)  # those of a mesh to a file
    found = [point for point in written if point.errors["different"]]
    wrong = [(work, "in windows") for work in (scale.FILE, scale.FLOOD)]
    assert [(point.work, point.method) for point in found] == wrong
