"""Benchmarks of fractions: a row for each type, points and the solid, and what is an error."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import fractions
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(2, 0.0, 1.0))
    device = opened(usable_devices()[0][0])
    request = Request(dims=(16,), repeat=1, seconds=0)
    return Bench(request, device, device, "fractions", str(tmp_path / "ball.obj"))


def test_errors_rise_from_fractions_to_points_to_the_solid(bench: Bench) -> None:
    points = {p.method: p for p in fractions.measure(bench)}
    order = ["fractions, u2", "fractions, u1", "1,000 points a voxel", "binary solid"]
    found = [points[name].errors["rms"] for name in order]
    assert found == sorted(found)
    assert 0.1 / 65535 < found[0] < 0.5 / 65535
    assert 0.1 < found[-1] < 0.5
    volumes = {name: point.errors["volume"] for name, point in points.items()}
    assert volumes["fractions, f4"] < 1e-6
    by_lattice = points["fractions, f4"].figures["by the lattice"]
    assert by_lattice is not None
    assert volumes["fractions, f4"] == pytest.approx(by_lattice, abs=1e-8)
    assert volumes["fractions and faces, f4"] == volumes["fractions, f4"]
    assert points["fractions and faces, f4"].bytes > points["fractions, f4"].bytes
    assert volumes["fractions, f4"] < volumes["1,000 points a voxel"] < volumes["binary solid"]


def test_large_dims_are_not_sampled(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fractions, "SAMPLED_DIM", 15)
    points = list(fractions.measure(bench))
    assert len(points) == 5
    assert all("rms" in p.absent and "rms" not in p.errors for p in points)
