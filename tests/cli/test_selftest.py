"""voxtool selftest: the table, the verdict, JSON and exit codes; what the cases measure is in
test_selftest.py."""

from __future__ import annotations

import json
import math

import pytest
from helpers_cli import invoke, run

from voxtool.errors import DeviceError
from voxtool.selftest.case import Case


def broken(device, full: bool) -> float:
    raise DeviceError("kernels/x.cl does not build")


GOOD = Case("good", "what is right", "values", 1e-6, lambda device, full: 2e-7 if full else 1e-7)
EXACT = Case("exact", "what is the same", "digests", 0, lambda device, full: 0)
BAD = Case("bad", "what is wrong", "values", 0, lambda device, full: 3)
BROKEN = Case("broken", "what does not build", "values", 0, broken)
LOST = Case("lost", "what is no number", "values", 1, lambda device, full: math.nan)


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch):
    def choose(*chosen: Case) -> None:
        monkeypatch.setattr("voxtool.selftest.CASES", chosen)

    return choose


def test_all_within_their_bounds(device_index: int, cases) -> None:
    cases(GOOD, EXACT)
    result = run(f"selftest --device {device_index}")
    assert result.stderr == ""
    head, blank, columns, good, exact, again, verdict = result.stdout.splitlines()
    assert head.startswith("voxtool ")
    assert (blank, again) == ("", "")
    assert columns.split() == ["case", "error", "bound", "unit", "verdict", "s"]
    assert good.split()[:5] == ["good", "1e-07", "1e-06", "values", "ok"]
    assert exact.split()[:5] == ["exact", "0", "0", "digests", "ok"]
    assert [row.index("ok") for row in (good, exact)] == [columns.index("verdict")] * 2
    assert verdict.startswith("2 of 2 cases within their bounds, ")
    assert verdict.endswith(" can be trusted")


def test_full(device_index: int, cases) -> None:
    cases(GOOD)
    assert " 2e-07 " in run(f"selftest --device {device_index} --full").stdout


def test_failures(device_index: int, cases) -> None:
    cases(GOOD, BAD, BROKEN, LOST)
    result = invoke(f"selftest --device {device_index}")
    assert result.exit_code == 1
    rows = result.stdout.splitlines()[3:]
    assert [row.split()[:5] for row in rows] == [
        ["good", "1e-07", "1e-06", "values", "ok"],
        ["bad", "3", "0", "values", "FAILED"],
        ["broken", "-", "0", "values", "FAILED"],
        ["kernels/x.cl", "does", "not", "build"],
        ["lost", "nan", "1", "values", "FAILED"],
    ]
    assert "trusted" not in result.output
    assert result.stderr.startswith("voxtool: error: 3 of 4 cases failed on ")
    assert result.stderr.endswith(
        ": bad, broken, lost: update its driver, or choose another device: see docs/devices.md\n"
    )
    assert result.stderr.count("\n") == 1


def test_quiet(device_index: int, cases) -> None:
    cases(GOOD, EXACT)
    (verdict,) = run(f"selftest --device {device_index} -q").stdout.splitlines()
    assert verdict.startswith("2 of 2 cases within their bounds")
    cases(GOOD, BAD)
    result = invoke(f"selftest --device {device_index} -q")
    assert result.exit_code == 1
    (row,) = result.stdout.splitlines()
    assert row.startswith("bad ")
    assert result.stderr.startswith("voxtool: error: 1 of 2 cases failed on ")


def test_json(device_index: int, cases) -> None:
    cases(GOOD, EXACT)
    result = run(f"selftest --device {device_index} --json")
    told = json.loads(result.stdout)
    assert (told["verdict"], told["full"], told["device"]["index"]) == ("ok", False, device_index)
    seconds = told["cases"][0].pop("seconds")
    assert 0 <= seconds < 1
    assert told["cases"][0] == {
        "name": "good",
        "what": "what is right",
        "error": 1e-7,
        "bound": 1e-6,
        "unit": "values",
        "verdict": "ok",
        "message": "",
    }
    cases(GOOD, BROKEN, LOST)
    result = invoke(f"selftest --device {device_index} --json --full")
    assert result.exit_code == 1
    told = json.loads(result.stdout)
    assert (told["verdict"], told["full"]) == ("failed", True)
    assert [(c["error"], c["verdict"], c["message"]) for c in told["cases"]] == [
        (2e-7, "ok", ""),
        (None, "failed", "kernels/x.cl does not build"),
        (None, "failed", ""),
    ]


def test_no_such_device() -> None:
    result = invoke("selftest --device nobody")
    assert (result.exit_code, result.stdout) == (4, "")
    assert "no OpenCL device matches" in result.stderr
