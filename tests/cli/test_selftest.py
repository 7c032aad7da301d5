"""voxtool selftest: the table, the verdict, JSON and exit codes; what the cases measure is in
test_selftest.py."""

from __future__ import annotations

import json
import math

import pytest
from helpers.cli import invoke

from voxtool.cli.selftest import report
from voxtool.errors import CheckError, DeviceError
from voxtool.selftest.case import Case


def broken(device, full: bool) -> float:
    raise DeviceError("kernels/x.cl does not build")


GOOD = Case("good", "what is right", "values", 1e-6, lambda device, full: 2e-7 if full else 1e-7)
EXACT = Case("exact", "what is the same", "digests", 0, lambda device, full: 0)
BAD = Case("bad", "what is wrong", "values", 0, lambda device, full: 3)
BROKEN = Case("broken", "what does not build", "values", 0, broken)
LOST = Case("lost", "what is no number", "values", 1, lambda device, full: math.nan)


def printed(capsys, device, *cases: Case, full=False, as_json=False, quiet=False) -> str:
    """Return the output of the command for these cases."""
    report(device, cases, full, as_json, quiet)
    return capsys.readouterr().out


def failed(capsys, device, *cases: Case, **how) -> tuple[str, str]:
    """Return the output for cases of which one fails, and the message of the error."""
    with pytest.raises(CheckError) as error:
        printed(capsys, device, *cases, **how)
    return capsys.readouterr().out, str(error.value)


def test_all_within_their_bounds(device, capsys) -> None:
    lines = printed(capsys, device, GOOD, EXACT).splitlines()
    head, blank, columns, good, exact, again, verdict = lines
    assert head.startswith("voxtool ")
    assert (blank, again) == ("", "")
    assert columns.split() == ["case", "error", "bound", "unit", "verdict", "s"]
    assert good.split()[:5] == ["good", "1e-07", "1e-06", "values", "ok"]
    assert exact.split()[:5] == ["exact", "0", "0", "digests", "ok"]
    assert [row.index("ok") for row in (good, exact)] == [columns.index("verdict")] * 2
    assert verdict.startswith("2 of 2 cases within their bounds, ")
    assert verdict.endswith(" can be trusted")
    assert " 2e-07 " in printed(capsys, device, GOOD, full=True)


def test_failures(device, capsys) -> None:
    out, message = failed(capsys, device, GOOD, BAD, BROKEN, LOST)
    assert [row.split()[:5] for row in out.splitlines()[3:]] == [
        ["good", "1e-07", "1e-06", "values", "ok"],
        ["bad", "3", "0", "values", "FAILED"],
        ["broken", "-", "0", "values", "FAILED"],
        ["kernels/x.cl", "does", "not", "build"],
        ["lost", "nan", "1", "values", "FAILED"],
    ]
    assert "trusted" not in out
    assert message.startswith("3 of 4 cases failed on ")
    assert message.endswith(
        ": bad, broken, lost: update its driver, or choose another device: see docs/devices.md"
    )


def test_quiet(device, capsys) -> None:
    (verdict,) = printed(capsys, device, GOOD, EXACT, quiet=True).splitlines()
    assert verdict.startswith("2 of 2 cases within their bounds")
    out, message = failed(capsys, device, GOOD, BAD, quiet=True)
    (row,) = out.splitlines()
    assert row.startswith("bad ")
    assert message.startswith("1 of 2 cases failed on ")


def test_json(device, capsys) -> None:
    value = json.loads(printed(capsys, device, GOOD, EXACT, as_json=True))
    assert (value["verdict"], value["full"]) == ("ok", False)
    assert value["device"]["index"] == device.info.index
    seconds = value["cases"][0].pop("seconds")
    assert 0 <= seconds < 1
    assert value["cases"][0] == {
        "name": "good",
        "what": "what is right",
        "error": 1e-7,
        "bound": 1e-6,
        "unit": "values",
        "verdict": "ok",
        "message": "",
    }
    out, _ = failed(capsys, device, GOOD, BROKEN, LOST, as_json=True, full=True)
    value = json.loads(out)
    assert (value["verdict"], value["full"]) == ("failed", True)
    assert [(c["error"], c["verdict"], c["message"]) for c in value["cases"]] == [
        (2e-7, "ok", ""),
        (None, "failed", "kernels/x.cl does not build"),
        (None, "failed", ""),
    ]


def test_no_such_device() -> None:
    result = invoke("selftest --device nobody")
    assert (result.exit_code, result.stdout) == (4, "")
    assert "no OpenCL device matches" in result.stderr
