"""Levels of a field in windows, in memory and on the disk: the same field, in less memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.cli import fail, run, told

import voxtool
from voxtool.adf.construction import build, plan
from voxtool.adf.construction.plan import FieldPlan
from voxtool.adf.construction.waiting_levels import Store
from voxtool.distances import plan_field
from voxtool.files.storage.spool import Spool
from voxtool.opencl import Device

REQUESTS: list[dict[str, Any]] = [
    {},
    {"fill": "winding", "continuous": False},
    {"fill": "none", "bounds": False},
    {"max_bytes": 600_000},
    {"max_level": 1},
]


def windows_counted(monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """Return the windows of each level that builds examine from here on."""
    counts: Counter[int] = Counter()
    examined = build._Build._examined

    def counted(self, level):
        counts[level.number] += 1
        return examined(self, level)

    monkeypatch.setattr(build._Build, "_examined", counted)
    return counts


@pytest.mark.parametrize("stored", [False, True], ids=["memory", "disk"])
@pytest.mark.parametrize("request_", REQUESTS)
def test_windows_make_the_field(
    request_: dict, stored: bool, models, device: Device, tmp_path: Path, monkeypatch
) -> None:
    mesh = voxtool.load_mesh(models / "bunny.obj")
    request = {"tolerance": 1e-3, "max_level": 6, "measure": False, "device": device, **request_}
    whole = voxtool.build_adf(mesh, **request)
    counts = windows_counted(monkeypatch)
    stores: Callable[[], Store] | None = partial(Spool, tmp_path / "a") if stored else None
    job = plan_field(mesh, stores=stores, **request).with_(window=100, stored=stored)
    field = job.run()
    assert field.digest() == whole.digest()
    assert field.reached == whole.reached
    assert not list(tmp_path.iterdir())
    if request_.keys() & {"max_bytes", "max_level"}:
        assert set(counts.values()) == {1}
    else:
        assert min(counts[level] for level in (3, 4, 5)) > 3
    assert job.plan.stored is stored


def test_what_exceeds_memory_waits_on_the_disk(here: Path) -> None:
    command = "adf-build bunny.obj --tolerance 1e-3 --max-level 7"
    whole = told(f"{command} -o whole.adf.h5 --json")
    limited = f"{command} -o part.adf.h5 --max-memory 24M"
    planned = told(f"{limited} --plan --json")
    assert planned["predicted_disk_bytes"] > 10_000_000
    assert "disk" in run(f"{limited} --plan").stdout
    assert "waited on the disk" in run(f"{limited} -v").stderr
    before = sorted(path.name for path in here.iterdir())
    assert told(f"{limited} --json")["digest"] == whole["digest"]
    assert sorted(path.name for path in here.iterdir()) == before
    assert (here / "part.adf.h5").read_bytes() == (here / "whole.adf.h5").read_bytes()
    for refused in ("--max-memory 1M", "--max-memory 24M --windows never"):
        assert "--max-level" in fail(f"{command} {refused} -o no.adf.h5", 4)
    assert not (here / "no.adf.h5").exists()


def test_the_plan_takes_the_window_that_fits() -> None:
    large = FieldPlan(1, "none", max_level=9, refined=(1, 8, 64, 512, 4096, 32768), items=10**6)
    assert large.fitting(10**12, 10**12) == large
    needed = large.cost.device
    stored = large.fitting(needed - 1, 10**12)
    assert stored.stored
    assert stored.window == plan.WINDOW
    assert stored.cost.device < needed / 2
    least = large.fitting(1, 10**12)
    assert least.window == plan.LEAST_WINDOW
    between = (stored.cost.device + least.cost.device) // 2
    fitting = large.fitting(between, 10**12)
    assert plan.LEAST_WINDOW < fitting.window < plan.WINDOW
    assert fitting.cost.device <= between
