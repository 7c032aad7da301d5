"""The model of `python -m tests.cluster_gain`: its limits, and that the table is measured."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import cluster_gain
from tests.cluster_gain import Run, modelled

ONE = Run(whole=5.0, rest=1.0, work=4.0, size=1000, windows=8)


def test_the_limits_of_the_model() -> None:
    assert modelled(ONE, 0.0, 1) == ONE.work + ONE.rest
    assert modelled(ONE, 0.0, 4) == 2.0
    assert modelled(ONE, 0.0, 1 << 40) == pytest.approx(ONE.rest)
    assert modelled(ONE, 0.1, 1 << 40) == pytest.approx(ONE.rest + 0.8)  # eight windows each
    assert modelled(ONE, 0.0, 256, rate=500.0) == ONE.rest + 2.0  # they arrive one by one


def test_the_table_is_measured(here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_gain, "MODES", ("surface26",))
    monkeypatch.setattr(cluster_gain, "WORKERS", (1,))
    monkeypatch.setattr(cluster_gain, "RUNS", 1)
    measured = cluster_gain.cost_of_window  # of few, short windows it is noise
    monkeypatch.setattr(cluster_gain, "cost_of_window", lambda *given: 0 * measured(*given))
    head, *rows = cluster_gain.rows(Path("bunny.obj"), 200)
    assert [row[1] for row in rows] == ["1", "16", "256"]
    assert all(len(row) == len(head) for row in rows)
    one, many = (float(row[3]) for row in rows[:2])
    assert float(rows[0][2]) > 0
    assert 0 < many < one
