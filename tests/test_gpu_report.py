"""The report of a device: stages are run, kept, stopped and resumed; digests are compared."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from gpu_report import LIMIT, Result, page_of, run_stages, stages
from helpers.cli import ENVIRONMENT, ROOT

from voxtool.opencl import list_devices

COUNT = "python -c \"open('ran', 'a').write('x'); print('counted | once')\""
FAIL = "python -c 'raise SystemExit(1)'"
SLEEP = "python -c 'import time; print(1, flush=True); time.sleep(60)'"


def test_stages_are_kept_until_the_source_changes(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = run_stages([COUNT, FAIL], tmp_path / "kept", LIMIT)
    again = run_stages([COUNT, FAIL], tmp_path / "kept", LIMIT)
    assert again == first
    assert Path("ran").read_text() == "x"
    for path in Path("kept").iterdir():
        path.write_text(json.dumps(json.loads(path.read_text()) | {"source": "another"}))
    run_stages([COUNT, FAIL], tmp_path / "kept", LIMIT)
    assert Path("ran").read_text() == "xx"
    page = page_of(list_devices()[0], first)
    assert f"| `{COUNT}` | passed, " in page
    assert f"| `{FAIL}` | FAILED (1), " in page
    assert "```\ncounted | once\n```" in page


def test_a_stage_that_is_stopped_is_run_again(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    stopped = run_stages([SLEEP, COUNT], tmp_path, 0.5)
    assert stopped[COUNT] is None
    page = page_of(list_devices()[0], stopped)
    assert "stopped after " in page
    assert f"| `{COUNT}` | not run |" in page
    assert run_stages([SLEEP, COUNT], tmp_path, LIMIT, "counted")[SLEEP] is None


@pytest.mark.parametrize("wing", ["adf", "distance", "mesh", "picture", "svo"])
def test_every_golden_digest_is_a_stage(wing: str, monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    assert f"python -m tests.golden.report {wing} --device 0" in stages("0")


def test_a_digest_that_differs_is_shown(tmp_path: Path) -> None:
    golden = tmp_path / "golden"
    golden.mkdir()
    stored = json.loads((ROOT / "tests/golden/distance.json").read_text())
    stored["torus"]["grid"] = "another"
    (golden / "distance.json").write_text(json.dumps(stored))
    words = [sys.executable, "-m", "tests.golden.report", "distance", "--golden", golden]
    done = subprocess.run(
        words, env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "sphere: 5 of 5 digests are equal" in done.stdout
    assert "torus: 4 of 5 digests are equal\n    differs: grid\n" in done.stdout


def test_results_say_how_they_ended() -> None:
    assert Result("c", "", None, 450.2, "").verdict == "stopped after 450 s"
    assert Result("c", "", 0, 2.4, "").verdict == "passed, 2 s"
