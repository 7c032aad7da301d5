"""The last level of a field in windows: the same field as in one piece, in less memory."""

from __future__ import annotations

from dataclasses import replace

import pytest

import voxtool
from voxtool.adf import build, plan
from voxtool.adf.plan import FieldPlan
from voxtool.opencl import Device


@pytest.mark.parametrize(
    "request_",
    [
        {},
        {"sign": "winding", "continuous": False},
        {"sign": "none", "bounds": False},
        {"max_bytes": 600_000},
        {"max_level": 1},
    ],
)
def test_windows_make_the_field(
    request_: dict, models, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = voxtool.load_mesh(models / "bunny.obj")
    request = {"tolerance": 1e-3, "max_level": 6, "measure": False, "device": device, **request_}
    whole = voxtool.build_adf(mesh, **request)
    counts = []

    def counted(level, size):
        found = list(windows_of(level, size))
        counts.append(len(found))
        return found

    windows_of = build.windows_of
    monkeypatch.setattr(build, "WINDOW", 100)
    monkeypatch.setattr(build, "windows_of", counted)
    field = voxtool.build_adf(mesh, **request)
    assert field.digest() == whole.digest()
    assert field.reached == whole.reached
    assert len(counts) == 1
    assert counts[0] > 1 or request["max_level"] == 1


def test_windows_take_less(monkeypatch: pytest.MonkeyPatch) -> None:
    last = FieldPlan(1, "none", max_level=4, refined=(1, 8, 64, 100_000))
    further = replace(last, max_level=5)
    saved = further._cost(further.refined, 0).device - last._cost(last.refined, 0).device
    assert saved == plan.CELL_BYTES * (100_000 - plan.WINDOW - 8)
