"""The examples with small grids: in processes of their own, as a user runs them, or, where a test
calls one several times, in this process."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import SHELL, write_obj

import voxtool

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).parents[2] / "examples"


def run(*command, cwd, status=0):
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=SHELL, capture_output=True, text=True)
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.fixture
def folder(tmp_path):
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(2))
    write_obj(tmp_path / "box.obj", *meshes.box((0, 0, 0), (3, 2, 1)))
    return tmp_path


# ---- pipeline.sh


def test_pipeline(folder):
    (folder / "out").mkdir()
    text = run("bash", EXAMPLES / "pipeline.sh", "ball.obj", 40, "out", cwd=folder)
    assert "check: ok" in text
    hdf5, xml = (line.split()[-1] for line in text.splitlines() if line.startswith("digest of"))
    octree = voxtool.read_svo(folder / "out" / "ball.svo.h5")
    assert hdf5 == xml == octree.digest()
    surface = np.load(folder / "out" / "ball.surface.npz")
    assert surface["shape"].tolist() == [40, 40, 40]
    assert len(surface["voxels"]) > 1000
    assert (folder / "out" / "ball.png").read_bytes().startswith(b"\x89PNG")
    assert len(list((folder / "out").iterdir())) == 3


def test_pipeline_stops_at_a_missing_mesh(folder):
    run("bash", EXAMPLES / "pipeline.sh", "none.obj", 40, cwd=folder, status=3)


# ---- regression.py

CASES = [
    {"mesh": "ball.obj", "dim": 32},
    {"mesh": "ball.obj", "dim": 20, "mode": "surface26"},
    {"mesh": "box.obj", "pitch": 0.25, "mode": "solid", "with_surface": True},
]


@pytest.fixture
def golden(folder):
    (folder / "golden.json").write_text(json.dumps(CASES))
    return folder / "golden.json"


def regression(*words, cwd, status=0):
    """What regression.py prints, run in this process."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.chdir(cwd)
        patch.setattr(sys, "argv", ["regression.py", *map(str, words)])
        try:
            runpy.run_path(str(EXAMPLES / "regression.py"), run_name="__main__")
            code = 0
        except SystemExit as end:
            code = int(bool(end.code))  # a message is a 1
    assert code == status
    return said.getvalue()


def test_regression_is_a_program(golden):
    script = EXAMPLES / "regression.py"
    assert "3 of 3 updated" in run(sys.executable, script, golden, "--update", cwd=golden.parent)
    run(sys.executable, script, golden.parent / "none.json", cwd=golden.parent, status=1)


def test_regression_accepts_what_it_wrote(golden, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    assert "3 of 3 updated" in regression(golden, "--update", cwd=elsewhere)
    text = golden.read_text()
    assert regression(golden, cwd=elsewhere).count("same ") == 3
    regression(golden, "--update", cwd=elsewhere)
    assert golden.read_text() == text
    case = json.loads(text)[0]
    mesh = voxtool.load_mesh(golden.parent / "ball.obj")
    octree = voxtool.voxelize(mesh, voxtool.Grid.fit(mesh, dim=32))
    assert case["result"]["digest"] == octree.digest()
    assert case["result"]["voxels"] == octree.count


def test_regression_shows_what_changed(golden):
    regression(golden, "--update", cwd=golden.parent)
    write_obj(golden.parent / "box.obj", *meshes.box((0, 0, 0), (3, 2, 1.25)))
    text = regression(golden, cwd=golden.parent, status=1)
    assert text.count("same ") == 2
    assert "changed box.obj pitch 0.25" in text
    assert "voxels: " in text
    assert " -> " in text
    assert text.splitlines()[-1].startswith("1 of 3 cases changed")


def test_regression_needs_a_golden_result(golden):
    assert "no golden result yet" in regression(golden, cwd=golden.parent, status=1)


@pytest.mark.parametrize(
    "text", ["", "{", '[{"mesh": "none.obj"}]', '[{"mesh": "ball.obj", "dims": 8}]', "[{}]"]
)
def test_regression_refuses_a_bad_file(golden, text):
    golden.write_text(text)
    regression(golden, "--update", cwd=golden.parent, status=1)
    assert golden.read_text() == text


# ---- convergence.py


def test_convergence(tmp_path):
    script = EXAMPLES / "convergence.py"
    text = run(
        sys.executable, script, "--dims", "16,32,64", "--placements", 2, cwd=tmp_path
    ).splitlines()
    rows = [line.split() for line in text if line.strip()[0].isdigit()]
    assert len(rows) == 9
    for row in rows:
        dim, rms = int(row[0]), float(row[1])
        assert rms < 20 / dim**2  # of the second order
        assert float(row[-2]) == pytest.approx(1, abs=1.2 / dim)  # surface26
        assert float(row[-1]) == pytest.approx(1, abs=3 / dim)  # surface6


# ---- call_costs.py


def test_call_costs(folder):
    text = run(sys.executable, EXAMPLES / "call_costs.py", "ball.obj", "--repeat", 1, cwd=folder)
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")][2:]
    assert len(rows) == 6
    assert all(float(cell.strip(" |")) > 0 for row in rows for cell in row[1:])
