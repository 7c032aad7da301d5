"""Benchmarks of attributes: a row with and without each, and what is an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.bench import attributes
from voxtool.bench.request import Request
from voxtool.bench.timing import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    two = meshes.join(meshes.icosphere(1, 0.0, 1.0), meshes.icosphere(1, (0.5, 0.2, 0.0), 1.0))
    write_obj(tmp_path / "balls.obj", *two)
    device = opened(usable_devices()[0][0])
    request = Request(dims=(16,), repeat=1, seconds=0)
    return Bench(request, device, device, "attributes", str(tmp_path / "balls.obj"))


def test_no_voxel_is_wrong_and_wrong_ones_are_found(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = {p.method: p for p in attributes.measure(bench)}
    made = [p for p in points.values() if p.work == attributes.WORK]
    assert len(made) == 9
    assert all(p.errors["wrong"] == 0 for p in made)
    assert 0 < points["surface26, areas"].errors["area"] < 1e-6
    assert points["meshes of labels, voxel-faces"].errors["volume"] < 1e-12
    nets = points["meshes of labels, surface-nets"].errors
    assert nets["wrong"] == 0
    assert 1e-4 < nets["volume"] < 0.3
    assert "surface with colours, voxel-faces" in points
    right = attributes.label_numbers
    monkeypatch.setattr(attributes, "label_numbers", lambda o: np.minimum(right(o), 1))
    points = {p.method: p for p in attributes.measure(bench)}
    assert points["solid, labels of shells"].errors["wrong"] > 0.01
