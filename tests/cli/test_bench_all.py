"""voxtool bench: from models to tables and files; never how fast."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import made_once, usable_devices
from docs.test_docs import parse
from helpers import meshes
from helpers.cli import ENVIRONMENT, MODULE, fail, invoke, run, write_obj

from voxtool.bench.points import FIGURES, MEASURES
from voxtool.bench.request import MESH_BENCHES, VOLUME_BENCHES, benches_for
from voxtool.cli.main import cli

pytestmark = pytest.mark.slow  # most run whole benches
BENCHES = ("voxelize", "extract", "adf", "surfaces", "distance", "pictures", "tets", "view",
           "exchange", "combine", "morph", "fractions", "attributes", "scale", "repair",
           "growth")  # fmt: skip
ON_THE_HOST = (
    ("field to surface", "dual contouring"), ("octree to components", "components"),
    ("mesh to fractions of voxels", "1,000 points a voxel"),
    ("octree with attributes to meshes", "meshes of labels, voxel-faces"),
    ("octree with attributes to meshes", "meshes of labels, surface-nets"),
)  # fmt: skip
QUICK = f"--quick -q --date today --device {usable_devices()[0][0]}"


@pytest.fixture(scope="module")
def made(models: Path, tmp_path_factory) -> Path:
    """A folder with bunny.obj and volume.vtu, and out/, their quick report; what was said."""
    pytest.importorskip("matplotlib")
    return made_once(tmp_path_factory, "bench", partial(make_report, models))


def make_report(models: Path, folder: Path) -> None:
    for name in ("bunny.obj", "volume.vtu"):
        shutil.copy(models / name, folder)
    words = f"bench all bunny.obj volume.vtu --scalar density --peers -o out {QUICK}"
    # A process of its own: the peers take a gigabyte, which this one would keep to its end.
    done = subprocess.run(
        [*MODULE, *shlex.split(words)], env=ENVIRONMENT, cwd=folder, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    (folder / "said.txt").write_text(done.stdout)


@pytest.fixture(scope="module")
def report(made: Path) -> dict[str, Any]:
    """The quick report of two models."""
    return json.loads((made / "out" / "report.json").read_text())


@pytest.fixture
def ball(tmp_path: Path, monkeypatch) -> str:
    """The current folder, with ball.obj, which is closed; the device to use."""
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(2))
    monkeypatch.chdir(tmp_path)
    return str(usable_devices()[0][0])


# ---- bench all


def test_every_bench_has_times_and_errors(report: dict[str, Any]) -> None:
    head = (report["format"], report["schema_version"], report["date"])
    assert head == ("voxtool-bench", "1.1", "today")
    assert report["device"]["probe"] in ("", "ok")
    assert report["machine"]["cores"] > 0
    points = report["points"]
    assert {point["bench"] for point in points} == set(BENCHES)
    for point in points:
        assert len(point["runs"]) == 2
        seconds = point["seconds"]
        assert 0 < seconds["least"] <= seconds["median"] <= seconds["most"]
        assert point["errors"].keys() <= MEASURES[point["bench"]].keys()
        assert point["errors"] or point["absent"]
        assert point["figures"].keys() <= FIGURES.keys()
        alone = point["bench"] == "growth" or point["method"] == "exact distances"
        alone |= "hash" in point["work"] or point["bench"] in ("view", "exchange", "scale")
        alone |= (point["work"], point["method"]) in ON_THE_HOST
        if not point["peer"] and not alone:
            assert all(seconds >= 0 for seconds in point["stages"].values())
            assert point["stages"]
            assert point["bytes"] or point["work"].startswith(("exact distances", "Hausdorff"))
    keys = [tuple(point[word] for word in ("bench", "model", "work", "method", "label"))
            for point in points]  # fmt: skip
    assert len(set(keys)) == len(keys)
    between = [p for p in points if p["work"].startswith("Hausdorff")]
    assert {p["setting"].get("tolerance", 1) >= p["errors"]["max"] >= 0 for p in between} == {True}
    exact = [p for p in points if p["bench"] == "distance" and p not in between]
    assert all(p["errors"]["max"] < 1e-13 for p in exact)
    assert all(p["errors"] == {"unpacked": 0} for p in points if p["bench"] == "view")
    assert {p["errors"].get("returned", 0) for p in points if p["bench"] == "exchange"} == {0}
    assert {p["errors"]["wrong"] for p in points if p["bench"] == "combine"} == {0}
    assert {p["errors"]["wrong"] for p in points if p["bench"] == "morph"} == {0}
    attributes = [p["errors"] for p in points if p["bench"] == "attributes"]
    assert {errors["wrong"] for errors in attributes if "wrong" in errors} == {0}
    assert {p["errors"]["different"] for p in points if p["bench"] == "scale" and p["errors"]} == {
        0
    }
    ours = [p for p in points if p["bench"] == "repair" and not p["peer"]]
    assert {p["errors"]["not closed"] for p in ours} == {0}
    linear = [p for p in points if p["bench"] == "tets" and "linear" in p["method"]]
    assert max(p["errors"].get("max", 0) for p in linear if not p["peer"]) < 1e-5


def test_errors_fall_with_finer_settings(report: dict[str, Any]) -> None:
    points = report["points"]
    for work in ("mesh to solid voxels", "solid voxels to surface", "mesh to field"):
        ours = [p for p in points if p["work"] == work and not p["peer"]]
        for method in {p["method"] for p in ours}:
            errors = [p["errors"]["rms"] for p in ours if p["method"] == method]
            assert errors == sorted(errors, reverse=True), (work, method)


def test_ablations(report: dict[str, Any]) -> None:
    savings = report["savings"]
    assert {saving["bench"] for saving in savings} == {"voxelize", "extract", "adf"}
    assert all(saving["same"] for saving in savings)
    assert all(len(s["runs"]) == len(s["forced"]) == 2 for s in savings)


def test_commands_of_rows_exist(report: dict[str, Any]) -> None:
    for point in report["points"]:
        words = shlex.split(point["command"])
        assert words[:3] == ["voxtool", "bench", point["bench"]]
        parse(cli, words[1:])


def test_what_is_said(made: Path) -> None:
    said = (made / "said.txt").read_text()
    assert "\ntets, volume.vtu: frames through x10" in f"\n{said}"
    assert "  most accurate: " in said
    assert said.endswith("report: out/report.html\n")
    page = (made / "out" / "report.html").read_text()
    assert page.count("<svg") == len(list((made / "out").glob("*.png"))) >= 2
    assert "today" in page


def test_no_clobber(made: Path, monkeypatch) -> None:
    monkeypatch.chdir(made)
    before = {path: path.stat().st_mtime_ns for path in (made / "out").iterdir()}
    assert "report.json exists" in fail("bench all volume.vtu --quick -o out --no-clobber", 3)
    assert {path: path.stat().st_mtime_ns for path in (made / "out").iterdir()} == before


def test_wrong_models_are_one_line_before_anything_is_measured(ball: str) -> None:
    assert "none.obj: " in fail(f"bench all ball.obj none.obj --quick -o out --device {ball}", 3)
    assert "there is no folder" in fail(f"bench all ball.obj --quick -o no/out --device {ball}", 3)
    assert "ball.obj" in fail(f"bench tets ball.obj -o out --device {ball}", 3)


# ---- single benches


def test_a_single_bench_and_its_row_again(ball: str) -> None:
    pytest.importorskip("matplotlib")
    words = "bench voxelize ball.obj --dims 16 --modes solid --repeat 1"
    result = run(f"{words} -o out --json --device {ball}")
    (point,) = json.loads(result.stdout)["points"]
    assert point["errors"].keys() == {"rms", "hausdorff", "volume"}
    assert point["peak"] > 0
    assert point["left_out"]["128-bit predicates"]
    again = shlex.split(point["command"])[1:]
    again[again.index("-o") + 1] = "again"
    run(shlex.join(again))
    (other,) = json.loads(Path("again/report.json").read_text())["points"]
    assert other["errors"] == point["errors"]
    assert run("bench compare out/report.json again/report.json").stdout.endswith(
        "1 row in both, 0 only in the old, 0 only in the new\n"
    )


def test_table(ball: str) -> None:
    words = "bench voxelize ball.obj --dims 16,32 --modes surface6,solid --repeat 1"
    result = run(f"{words} --device {ball}")
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert lines[0].startswith("voxtool ")
    assert lines[2] == "voxelize, ball.obj: mesh to voxels of the surface"
    assert lines[3] == "  time, and errors: rms, hausdorff: of the model's diagonal"
    assert lines[4].split() == ["setting", "time", "±", "rms", "hausdorff"]
    names = [line.lstrip("* ").partition("  ")[0] for line in lines[5:7]]
    assert names == ["surface6, dim 16", "surface6, dim 32"]
    assert len({len(line) for line in lines[4:7]}) == 1
    assert {"host", "command", "triangles", "voxels"} <= set(lines[8].split())
    assert {"active", "octree", "surface6"} <= set(lines[12].split())
    said = result.stdout
    assert "voxelize, ball.obj: mesh to solid voxels\n" in said
    assert "voxelize, ball.obj: solid, dim 32: without 128-bit predicates: " in said


def test_what_takes_long_is_left_out_on_request(ball: str) -> None:
    words = "bench voxelize ball.obj --dims 16 --modes solid --quick --json -q"
    whole = json.loads(run(f"{words} --device {ball}").stdout)
    less = json.loads(run(f"{words} --samples 0 --no-ablate --device {ball}").stdout)
    assert whole["savings"]
    assert not less["savings"]
    (point,) = [one for one in less["points"] if one["method"] == "solid, auto (parity)"]
    assert not point["errors"]
    assert "--samples 0" in point["absent"]["volume"]
    assert "--samples 0" in point["absent"]["rms"]


def test_rules_of_solids(ball: str) -> None:
    words = "bench voxelize ball.obj --dims 16 --modes solid,surface6 --fills parity,auto,flood"
    result = run(f"{words} --repeat 1 --json --budget-error 1 --device {ball}")
    points = json.loads(result.stdout)["points"]
    methods = [point["method"] for point in points]
    assert methods == ["solid, auto (parity)", "solid, flood", "surface6"]  # parity is there once
    assert [point["setting"]["against"] for point in points] == ["the model"] * 3
    volumes = [point["errors"].get("volume") for point in points]
    assert volumes[0] < volumes[1]  # flood has the voxels of the surface
    assert volumes[2] is None
    shares = [point["figures"].get("outer surface") for point in points]
    assert shares == [1, 1, None]
    assert [point["first"] for point in points] == [None] * 3


def test_rules_of_a_wreck(tmp_path: Path, monkeypatch) -> None:
    """Winding numbers lose what is wound inside out, unless auto turns it: both are measured."""
    monkeypatch.chdir(tmp_path)
    vertices, faces = meshes.open_box((7, 0, 0), (12, 5, 5))
    wreck = meshes.join(meshes.open_box(0, 5), (vertices, faces[:, ::-1]))
    write_obj(tmp_path / "wreck.obj", *wreck)
    words = "bench voxelize wreck.obj --dims 64 --modes solid --fills winding,auto --samples 500"
    points = json.loads(run(f"{words} --repeat 1 --json --budget-error 1").stdout)["points"]
    assert [point["method"] for point in points] == ["solid, auto (winding)", "solid, winding"]
    kept, half = (point["figures"]["outer surface"] for point in points)
    assert kept > 0.98
    assert abs(half - 0.5) < 0.05
    assert points[0]["first"] > 0
    assert points[1]["first"] is None


def test_open_models_are_compared_with_their_caps(tmp_path: Path, monkeypatch) -> None:
    """The error of the surface of an open model falls with the dim."""
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "open.obj", *meshes.open_box(0, (4.0, 3.1, 2.3)))
    words = "bench extract open.obj --dims 32,64 --styles blocks --samples 500 --repeat 1"
    coarse, fine = json.loads(run(f"{words} --budget-error 1 --json").stdout)["points"]
    assert coarse["setting"]["against"] == "the model, 1 hole capped"
    assert fine["errors"]["hausdorff"] < coarse["errors"]["hausdorff"]
    assert fine["figures"].keys() >= {"looked at", "cut", "rms in voxels", "max in voxels"}


def test_budgets(ball: str) -> None:
    words = f"bench extract ball.obj --dims 16,32 --repeat 1 --samples 500 --device {ball}"
    said = run(f"{words} --budget-error 1").stdout
    assert said.startswith("extract, ball.obj: solid voxels to surface: ")
    assert said.count("\n") == 1
    best = run(f"{words} --budget-time 1000").stdout
    assert ": sharp, dim 32: " in best
    assert "volume error" in run(f"{words} --budget-error 1:volume").stdout
    result = invoke(f"{words} --budget-error 1e-12")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "error up to 1e-12: nothing that was measured meets it in extract, " in result.stderr
    assert "no error 'p99'" in fail(f"{words} --budget-error 1:p99", 3)


@pytest.mark.parametrize("wrong", ["x", "-1", "nan", "1e999", ":rms"])
def test_wrong_budgets(ball: str, wrong: str) -> None:
    assert "is no error: write 1e-3" in fail(f"bench all ball.obj --budget-error={wrong}", 2)
    fail("bench all ball.obj --budget-time 0", 2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("voxelize ball.obj --dims 64,x", "'x' is not a valid integer"),
        ("adf ball.obj --tolerances -1", "-1.0 is not in the range x>=0"),
        ("adf ball.obj --max-level 22", "22 is not in the range 1<=x<=21"),
        ("tets cube.vtu --methods raycast,fast", "'fast' is not one of"),
        ("tets cube.vtu --transfers x2", "'x2' is not one of"),
    ],
)
def test_wrong_usage(words: str, message: str) -> None:
    assert message in fail(f"bench {words}", 2)


def test_a_band_of_nothing_is_measured(ball: str) -> None:
    words = "bench adf ball.obj --tolerances 0 --band 0 --levels 4 --points 100 --repeat 1"
    points = json.loads(run(f"{words} --quick --json --device {ball}").stdout)["points"]
    (built,) = (point for point in points if point["work"] == "mesh to field")
    assert "rms" not in built["errors"]
    assert "band" in built["absent"]["rms"]


def test_benches_for_files() -> None:
    assert benches_for("a/b.OBJ") == MESH_BENCHES
    assert benches_for("b.ply.gz") == MESH_BENCHES
    assert benches_for("b.VTU") == VOLUME_BENCHES
