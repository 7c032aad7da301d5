"""Benchmarks of morphology: a row for each operation, and what is counted as an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import morph
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench
from voxtool.choices import MORPHOLOGY


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    write_obj(tmp_path / "box.obj", *meshes.box(0, (4, 3, 2)))
    device = opened(usable_devices()[0][0])
    request = Request(dims=(24,), repeat=1, seconds=0)
    return Bench(request, device, device, "morph", str(tmp_path / "box.obj"))


def test_every_operation_is_right(bench: Bench) -> None:
    ours = {p.method: p for p in morph.measure(bench) if not p.peer}
    assert tuple(ours) == ("components", "resample", *MORPHOLOGY)
    assert {p.errors["wrong"] for p in ours.values()} == {0}
    sizes = {name: int(p.size or 0) for name, p in ours.items()}
    assert sizes["dilate"] > sizes["close"] >= sizes["open"] > sizes["erode"] > 0


def test_wrong_voxels_are_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(morph, "by_distances", lambda voxels, operation: np.zeros_like(voxels))
    for point in morph.measure(bench):
        if not point.peer and point.method in MORPHOLOGY:
            assert point.errors["wrong"] == int(point.size or 0) / 24**3 > 0


def test_wrong_components_and_shares_are_counted(bench: Bench, monkeypatch) -> None:
    monkeypatch.setattr(morph, "sizes_of", lambda dense: np.array([5, 2]))
    monkeypatch.setattr(morph, "HALF_OF_EIGHT", 9)
    labelled, halved = (p for p in morph.measure(bench) if p.method in ("components", "resample"))
    assert labelled.errors["wrong"] == (int(labelled.size or 0) - 5 + 2) / 24**3
    assert halved.errors["wrong"] > 0


def test_large_dims_have_no_error(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(morph, "DENSE_DIM", 23)
    points = list(morph.measure(bench))
    assert [p.method for p in points] == ["components", "resample", *MORPHOLOGY]
    assert all(p.absent == morph.TOO_LARGE and not p.errors for p in points)
