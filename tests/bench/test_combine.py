"""Benchmarks of set operations: a row for each operation, and what is counted as an error."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import combine
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench
from voxtool.choices import OPERATIONS
from voxtool.svo.sets.compare import COMPARE


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    write_obj(tmp_path / "ball.obj", *meshes.tetrahedron())
    device = opened(usable_devices()[0][0])
    request = Request(dims=(16,), repeat=1, seconds=0)
    return Bench(request, device, device, "combine", str(tmp_path / "ball.obj"))


def test_every_operation_is_right(bench: Bench) -> None:
    ours = {p.method: p for p in combine.measure(bench) if not p.peer}
    assert tuple(ours) == (*OPERATIONS, COMPARE)
    assert {p.errors["wrong"] for p in ours.values()} == {0}
    sizes = {name: int(p.size or 0) for name, p in ours.items()}
    assert sizes["xor"] == sizes["union"] - sizes["intersection"] > 0


def test_wrong_voxels_are_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(combine.FUNCTIONS, "union", combine.FUNCTIONS["intersection"])
    sizes = {p.method: int(p.size or 0) for p in combine.measure(bench)}
    assert sizes[COMPARE] == sizes["union"] + sizes["intersection"]
    union = next(combine.measure(bench))
    assert union.errors["wrong"] == (sizes["union"] - sizes["intersection"]) / 16**3 > 0


def test_large_dims_have_no_error(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(combine, "DENSE_DIM", 15)
    points = list(combine.measure(bench))
    assert [p.method for p in points] == [*OPERATIONS, COMPARE]
    assert all(p.absent == combine.WITHOUT and not p.errors for p in points)
