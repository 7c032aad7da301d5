"""Reports of benchmarks: what follows from points, tables, the page, budgets and comparisons. The
points are made up; only the last sections measure."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import fail, invoke, run

from voxtool.adf.construction.build import build_adf, plan_adf
from voxtool.bench import ablation, compare, peers, report, timing, voxels
from voxtool.bench.points import (
    MEASURES,
    Ablation,
    Budget,
    Point,
    answers,
    duration,
    exponent,
    exponents,
    pareto,
    verdicts,
)
from voxtool.bench.references import Reference, capped, voxels_of_peer
from voxtool.bench.request import Request
from voxtool.bench.sweep import sweep
from voxtool.bench.tables import absent_of, tables_of
from voxtool.bench.voxels import boundary, lattice_share
from voxtool.errors import FileError, VoxtoolError, VoxtoolWarning
from voxtool.files import write_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.mesh.topology import check_topology, volume
from voxtool.opencl import list_devices
from voxtool.spatial.sampling import sample_cube
from voxtool.svo.surface.extract import plan_extract
from voxtool.svo.voxelization.voxelize import plan_voxelize, voxelize

HOSTILE = """<script src="http://x.example/a.js">alert(1)</script>"'&$x_$=1\x1b[31m\n.obj"""


def point(method: str, seconds: float, error: float | None, **more) -> Point:
    errors = {} if error is None else {"rms": error}
    given = {"runs": [0.9 * seconds, seconds, 1.1 * seconds], "errors": errors, "label": "",
             "model": "a.obj", "command": "voxtool bench all a.obj", "setting": {}}  # fmt: skip
    return Point(
        **{"bench": "voxelize", "work": "mesh to voxels", "method": method, **given, **more}
    )


def line(method: str, power: float, order: float, sizes=(64, 128, 256)) -> list[Point]:
    """Points whose time goes with a power of the size, and whose error falls with an order."""
    return [
        point(method, 1e-6 * n**power, n**-order, label=f"dim {n}", size=n, size_of="dim")
        for n in sizes
    ]


POINTS = [
    *line("coarse", 1, 1),
    *line("fine", 2, 2),
    point("VTK 9", 0.5, 1e-4, label="dim 256", peer=True),
    point("exact", 0.3, None, absent={"rms": "it is the reference"}),
]


def made(points=POINTS, **more) -> report.Report:
    one = Ablation("voxelize", "a.obj", "solid, dim 256", "128-bit predicates", "small triangles",
                   [1.0, 1.1, 1.2], [2.0, 2.1, 2.2], True)  # fmt: skip
    device = next(info for info in list_devices() if info.index == usable_devices()[0][0])
    return report.Report(list(points), [one], device, "voxtool bench all a.obj", **more)


# ---- what follows from points


def test_pareto_front_against_all_pairs() -> None:
    rng = np.random.default_rng(3)
    points = [point(str(i), *rng.integers(1, 12, 2).tolist()) for i in range(60)]
    points += [point("none", 0.1, None)]

    def beaten(p: Point) -> bool:
        return any(
            q.seconds <= p.seconds and (q.error or 0) <= (p.error or 0)
            and (q.seconds, q.error) != (p.seconds, p.error)
            for q in points if q.error is not None
        )  # fmt: skip

    front = pareto(points)
    left = {(p.seconds, p.error) for p in points if p.error is not None and not beaten(p)}
    assert {(p.seconds, p.error) for p in front} == left
    assert len(front) == len(left)
    assert [p.seconds for p in front] == sorted(p.seconds for p in front)


def test_exponents_of_known_powers() -> None:
    for power in (0.5, 1.0, 2.7, -1.0):
        assert exponent([(x, 3 * x**power) for x in (2, 5, 11, 64)]) == pytest.approx(power)
    # least squares on logarithms: numpy's polyfit is of another algorithm
    rng = np.random.default_rng(4)
    xs, ys = np.exp(rng.uniform(0, 5, (2, 9)))
    fitted = exponent(list(zip(xs.tolist(), ys.tolist(), strict=True)))
    assert fitted == pytest.approx(np.polyfit(np.log(xs), np.log(ys), 1)[0])
    assert exponent([(4, 1.0), (4, 2.0)]) is None
    assert exponent([(1, 1.0), (2, 0.0)]) is None
    assert exponents(POINTS) == {
        "coarse": (pytest.approx(1), 64, 256),
        "fine": (pytest.approx(2), 64, 256),
    }


def test_budgets() -> None:
    cheapest = Budget(error=1e-3).choose(POINTS)
    assert cheapest is not None
    assert (cheapest.method, cheapest.label) == ("fine", "dim 64")
    best = Budget(time=0.01).choose(POINTS)
    assert best is not None
    assert (best.method, best.label) == ("fine", "dim 64")
    assert Budget(time=1e-3, error=1e-3).choose(POINTS) is None
    assert Budget(error=1e-9).choose(POINTS) is None
    assert Budget(error=1.0, measure="volume").choose(POINTS) is None
    other = point("fine", 1.0, 0.5, model="b.obj")
    told = answers([*POINTS, other], Budget(error=1e-3))
    assert [p and p.method for _, p in told] == ["fine", None]
    with pytest.raises(VoxtoolError, match="voxelize has no error 'p99': choose rms, hausdorff"):
        Budget(error=1, measure="p99").check(["adf", "voxelize"])


def test_verdicts_are_of_the_figures() -> None:
    said = verdicts(POINTS)
    assert said[0].startswith("error up to 1e-1: coarse, dim 64, 64 µs (error 0.016)")
    assert said[1].startswith("error up to 1e-2: coarse, dim 128, 128 µs")
    assert said[2].startswith("error up to 1e-3: fine, dim 64, 4.1 ms")
    assert said[3].startswith("error up to 1e-4: fine, dim 128")
    assert len(said) == 6
    assert said[-2].startswith("most accurate: fine, dim 256")
    assert said[-1] == "never the fastest for its error: VTK 9"
    assert verdicts([POINTS[-1]]) == []
    perfect = verdicts([point("a", 1, 0.0)])
    assert len(perfect) == 2
    assert "most accurate: a, 1 s (error 0, rms of the model's diagonal)" in perfect[1]
    assert [duration(s) for s in (12.34, 0.0125, 3e-6)] == ["12.3 s", "12.5 ms", "3 µs"]


# ---- tables


def test_tables_put_the_error_beside_the_time() -> None:
    measured = [
        point("ours", 1e-3, 0.5, label="dim 8", figures={"voxels": 1234, "host": 2e-4, "load": 0.5},
              stages={"a": 1e-4, "b": 2e-4}, peak=10**8),
        point("ours", 2e-3, 0.25, label="dim 16", first=0.5, stages={"b": 1e-4},
              figures={"break-even": None}),
        point("theirs", 4e-3, 0.75, label="dim 8", peer=True, absent={"area": "of voxels"}),
    ]  # fmt: skip
    times, figures, stages = tables_of(measured)
    assert times.note == "time, and errors: rms: of the model's diagonal"
    assert times.head == ["setting", "time", "±", "first", "rms", "beside"]
    assert times.rows == [
        ["ours, dim 8", "1 ms", "20 %", "-", "0.5", "-"],
        ["ours, dim 16", "2 ms", "20 %", "500 ms", "0.25", "-"],
        ["theirs, dim 8", "4 ms", "20 %", "-", "0.75", "4 times"],
    ]
    assert times.front == {0, 1}
    assert figures.head == ["setting", "peak memory", "voxels", "break-even", "host", "load"]
    assert figures.rows == [
        ["ours, dim 8", "100 MB", "1,234", "-", "200 µs", "50.00 %"],
        ["ours, dim 16", "-", "-", "never", "-", "-"],
    ]
    assert stages.rows == [["ours, dim 8", "0.30", "0.10", "0.20"],
                           ["ours, dim 16", "0.10", "-", "0.10"]]  # fmt: skip
    assert absent_of(measured) == ["theirs: no area: of voxels"]
    lines = times.lines()
    assert len({len(line) for line in lines}) == 1
    assert [line[:2] for line in lines] == ["  ", "* ", "* ", "  "]


def test_fill_rules_are_compared_with_parity() -> None:
    rules = (("winding", 3e-3, "dim 8"), ("parity", 2e-3, "dim 8"), ("winding", 3e-3, "dim 16"))
    measured = [point(r, t, 0.5, label=dim, setting={"rule": r}) for r, t, dim in rules]
    times = tables_of([*measured, point("theirs", 4e-3, 0.5, label="dim 8", peer=True)])[0]
    assert times.head[-1] == "over parity"
    assert [row[-1] for row in times.rows] == ["1.5", "-", "-", "-"]


# ---- files


class Page(HTMLParser):
    """Every tag and attribute of a page, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data) -> None:
        self.text += data


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    pytest.importorskip("matplotlib")
    tmp_path = tmp_path_factory.mktemp("report")
    hostile = [replace(p, model=HOSTILE, command=f"voxtool bench all {HOSTILE}") for p in POINTS]
    report.write_report(made([*POINTS, *hostile], date=HOSTILE), str(tmp_path / "out"))
    return tmp_path / "out"


def test_a_page_needs_nothing_else(written: Path) -> None:
    text = (written / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    names = {tag for tag, _ in page.tags}
    assert "svg" in names
    assert not names & {"script", "link", "iframe", "img", "object", "embed", "base", "form"}
    for _, attributes in page.tags:
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("href", "src", "xlink:href", "data", "action"):
                assert value.startswith("#"), (name, value)
    markup = re.sub(r">[^<]*<", "><", text)  # what is no text
    assert not re.search(r"https?:|//\w|@import", markup)
    assert set(re.findall(r"url\(([^)]?)", markup)) <= {"#"}
    assert '<script src="http://x.example/a.js">alert(1)</script>' in page.text
    assert "\x1b" not in text


def test_identifiers_of_charts_do_not_clash(written: Path) -> None:
    page = Page((written / "report.html").read_text(encoding="utf-8"))
    svgs, current = [], None
    for tag, attributes in page.tags:
        if tag == "svg":
            current = set()
            svgs.append(current)
        if current is not None and tag in ("clippath", "path", "use") and "id" in attributes:
            current.add(attributes["id"])
    assert len(svgs) == 5
    assert all(not a & b for i, a in enumerate(svgs) for b in svgs[:i])


def test_files_of_a_report(written: Path) -> None:
    names = {path.name for path in written.iterdir()}
    assert names > {
        "report.json", "report.csv", "report.html", "voxelize-a-obj-mesh-to-voxels-error.png",
        "voxelize-a-obj-saved.png",
    }  # fmt: skip
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in written.glob("*.png"))
    assert len(list(written.glob("*.png"))) == 5
    rows = list(csv.DictReader(io.StringIO((written / "report.csv").read_text())))
    assert len(rows) == 2 * len(POINTS)
    assert float(rows[0]["seconds"]) == POINTS[0].seconds
    assert float(rows[0]["rms error"]) == POINTS[0].error
    assert rows[7]["rms error"] == ""
    told = json.loads((written / "report.json").read_text())
    assert told["measures"] == {bench: dict(found) for bench, found in MEASURES.items()}
    first = told["points"][0]
    assert first["runs"] == POINTS[0].runs
    assert first["seconds"] == {"median": POINTS[0].seconds, "least": min(POINTS[0].runs),
                                "most": max(POINTS[0].runs)}  # fmt: skip
    assert told["savings"][0]["saved"] == pytest.approx(1.0)
    assert told["savings"][0]["beyond_noise"] is True
    rows = report.as_csv([replace(POINTS[0], model="=1+1.obj", command="-x")])
    assert "'=1+1.obj" in rows
    assert "'-x" in rows


def test_existing_files_and_the_same_report_again(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for name in "ab":
        report.write_report(made(POINTS[:2]), str(tmp_path / name))
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    again = {path.name: path.read_bytes() for path in (tmp_path / "b").iterdir()}
    assert before == again
    file = tmp_path / "a" / "report.json"
    with pytest.raises(FileError, match=r"report\.json exists"):
        report.write_report(made(POINTS[:1]), str(tmp_path / "a"), clobber=False)
    assert file.read_bytes() == before["report.json"]
    report.write_report(made(POINTS[:1]), str(tmp_path / "a"))
    assert file.read_bytes() != before["report.json"]
    for folder, message in ((file, "it is a file: name a folder"),
                            (tmp_path / "no" / "out", "there is no folder")):  # fmt: skip
        with pytest.raises(FileError, match=message):
            report.check_folder(str(folder))


@pytest.mark.parametrize("package", ["matplotlib", "jinja2"])
def test_reports_need_an_extra(monkeypatch, tmp_path: Path, package: str) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(FileError, match=r"pip install 'voxtool\[pictures\]'"):
        report.check_folder(str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


# ---- comparing


def write(path: Path, points) -> str:
    path.write_text(json.dumps(made(points).as_dict()))
    return str(path)


def test_compare(tmp_path: Path) -> None:
    new = [
        point("coarse", 64e-6 * 1.05, 1 / 64, label="dim 64"),  # within the noise
        point("coarse", 128e-6 * 2, 1 / 128, label="dim 128"),  # slower
        point("coarse", 256e-6 / 2, 1 / 256, label="dim 256"),  # faster
        point("fine", 64**2 * 1e-6, 1.01 * 64**-2, label="dim 64"),  # less accurate
        point("fine", 128**2 * 1e-6, 0.5 * 128**-2, label="dim 128"),  # more
        point("fine", 256**2 * 1e-6, (1 + 1e-9) * 256**-2, label="dim 256"),  # rounding
        point("new", 1, 1),
    ]
    old, newer = (compare.read_report(write(tmp_path / f"{n}.json", p))
                  for n, p in (("old", POINTS), ("new", new)))  # fmt: skip
    changes = compare.compare(old, newer)
    assert [(c.slower, c.faster, bool(c.worse), bool(c.better)) for c in changes] == [
        (False, False, False, False),
        (True, False, False, False),
        (False, True, False, False),
        (False, False, True, False),
        (False, False, False, True),
        (False, False, False, False),
    ]
    assert [c.fails(50) for c in changes] == [False, True, False, True, False, False]
    assert [c.fails(120) for c in changes] == [False, False, False, True, False, False]
    assert changes[1].percent == pytest.approx(100)


def test_compare_command(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "old.json", POINTS)
    write(tmp_path / "new.json", [replace(p, runs=[3 * s for s in p.runs]) for p in POINTS])
    told = run("bench compare old.json old.json --fail-over 0").stdout
    assert told.startswith("nothing has changed beyond the noise\n8 rows in both")
    result = run("bench compare old.json new.json")
    assert result.stdout.count("slower") == 8
    assert "+200.0 %" in result.stdout
    result = invoke("bench compare old.json new.json --fail-over 150")
    assert result.exit_code == 1
    assert "8 rows slower by more than 150 %" in result.stderr
    assert invoke("bench compare old.json new.json --fail-over 250").exit_code == 0
    assert invoke("bench compare new.json old.json --fail-over 0").exit_code == 0
    rows = json.loads(run("bench compare old.json new.json --json").stdout)["rows"]
    assert {row["time"] for row in rows} == {"slower"}
    write(tmp_path / "other.json", [replace(POINTS[0], model="b.obj")])
    assert invoke("bench compare old.json other.json").exit_code == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.update(format="other"), "no report of `voxtool bench`"),
        (lambda v: v.update(schema_version="2.0"), "schema version 2.0, and 1 can be read"),
        (lambda v: v.update(points={}), "points is no list"),
        (lambda v: v.update(points=[3]), "point 0 is no object"),
        (lambda v: v["points"][1].pop("model"), "point 1, model, is no text"),
        (lambda v: v["points"][1].update(method="x" * 2000), "is no text of up to"),
        (lambda v: v["points"][2].update(seconds=1), "point 2, seconds, is no object"),
        (lambda v: v["points"][2]["seconds"].update(least=9), "are not positive and in order"),
        (lambda v: v["points"][2]["seconds"].update(least=0), "are not positive and in order"),
        (lambda v: v["points"][2]["seconds"].update(most=10**400), "is out of range"),
        (lambda v: v["points"][2]["errors"].update(rms=-1), "is out of range"),
        (lambda v: v["points"][2]["errors"].update(rms=math.nan), "is no JSON: NaN"),
        (lambda v: v["points"].append(v["points"][0]), "point 8 is there twice"),
        (lambda v: v.update(device=None), "device is no object"),
    ],
)
def test_damaged_reports_are_one_line(tmp_path: Path, monkeypatch, change, message: str) -> None:
    monkeypatch.chdir(tmp_path)
    value = made().as_dict()
    change(value)
    (tmp_path / "bad.json").write_text(json.dumps(value))
    assert message in fail("bench compare bad.json bad.json")


def test_other_files_are_one_line(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for content in (b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b"3"):
        (tmp_path / "bad.json").write_bytes(content)
        assert fail("bench compare bad.json bad.json").startswith("bad.json: is no ")
    assert "there is no such file" in fail("bench compare none.json none.json")
    with open(tmp_path / "large.json", "wb") as file:
        file.truncate(compare.MOST_BYTES + 1)
    with pytest.raises(FileError, match="a report has at most"):
        compare.read_report("large.json")


# ---- errors, of voxels and of what peers make


def test_errors_of_a_surface(device, monkeypatch: pytest.MonkeyPatch) -> None:
    ball = mesh_from_arrays(*meshes.icosphere(3))
    reference = Reference(ball, 0, 2000, device)
    larger = mesh_from_arrays(1.1 * ball.vertices, ball.faces)
    errors = reference.errors_of(larger)["errors"]
    assert errors["volume"] == pytest.approx(1.1**3 - 1)
    assert errors["area"] == pytest.approx(1.1**2 - 1)
    assert errors["rms"] == pytest.approx(0.1 / (2 * math.sqrt(3)), rel=0.02)
    assert errors["hausdorff"] == pytest.approx(0.1 / (2 * math.sqrt(3)), rel=0.02)
    monkeypatch.setattr("voxtool.bench.references.available_memory", lambda: 100_000)
    large = reference.errors_of(larger)
    assert large["errors"].keys() == {"volume", "area"}
    assert "triangles would take" in large["absent"]["rms"] == large["absent"]["hausdorff"]
    monkeypatch.undo()
    timed = Reference(ball, 0, 0, device).errors_of(larger)
    assert timed["errors"] == {name: errors[name] for name in ("volume", "area")}
    assert "--samples 0" in timed["absent"]["rms"] == timed["absent"]["hausdorff"]
    without = Reference(ball, 0, 2000, device, {"volume": "why"}).errors_of(ball)
    assert without["errors"].keys() == {"rms", "hausdorff", "area"}
    assert without["absent"] == {"volume": "why"}


def test_without_samples_voxels_are_timed_and_their_errors_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_mesh(mesh_from_arrays(*meshes.icosphere(2)), "ball.ply")
    request = Request(dims=(16,), modes=("solid",), fills=("parity",), repeat=1, seconds=0,
                      samples=0, commands=False, ablations=False)  # fmt: skip
    (timed,) = sweep(["ball.ply"], request, ("voxelize",))
    (measured,) = sweep(["ball.ply"], replace(request, samples=100), ("voxelize",))
    assert isinstance(timed, Point)
    assert isinstance(measured, Point)
    assert timed.runs
    assert timed.bytes == measured.bytes
    assert timed.errors == {}
    assert timed.absent.keys() == measured.errors.keys() | measured.absent.keys()
    assert "--samples 0" in timed.absent["volume"]
    assert "outer surface" in measured.figures.keys() - timed.figures.keys()


def test_the_share_of_a_surface_that_rounding_changes(device) -> None:
    """None of a mesh whose vertices are on the lattice."""
    grid = Grid((40,) * 3, (0, 0, 0), (1, 1, 1))
    vertices, faces = meshes.icosphere(3, 20.1, 17.3)
    for moved, low, high in ((vertices, 1e-4, 3e-3), (meshes.fixed(vertices) / 256, 0, 0)):
        mesh = mesh_from_arrays(moved, faces)
        octree = voxelize(mesh, grid, "surface26", device=device)
        assert low <= lattice_share(mesh, grid, octree, device) <= high


def test_open_models_are_capped(device) -> None:
    box, holes = capped(mesh_from_arrays(*meshes.open_box(0, (4, 3, 2))))
    assert holes == 1
    assert check_topology(box).closed
    assert volume(box) == pytest.approx(24)
    reference = Reference(box, holes, 100, device)
    assert reference.words == "the model, 1 hole capped"
    assert reference.errors_of(box)["errors"].keys() == {"rms", "hausdorff", "volume", "area"}
    ball = mesh_from_arrays(*meshes.icosphere(2))
    assert capped(ball)[1] == 0
    assert np.array_equal(capped(ball)[0].faces, ball.faces)


@pytest.mark.parametrize("mode", ["surface26", "solid"])
def test_voxels_of_peers_lie_where_the_model_does(mode: str) -> None:
    pytest.importorskip("scipy")
    device = opened(usable_devices()[0][0])
    ball = mesh_from_arrays(*meshes.icosphere(3))
    grid, reference = Grid.fit(ball, 32), Reference(ball, 0, 2000, device)
    found = peers.of(ball, grid, mode)
    assert any(name.startswith("trimesh ") for name in found)
    for name, work in found.items():
        errors = reference.errors_of(boundary(voxels_of_peer(work(), grid), device))["errors"]
        assert errors["rms"] * reference.diagonal < grid.pitch[0], name
        assert errors["hausdorff"] * reference.diagonal < 2 * grid.pitch[0], name


def test_tools_that_would_fill_the_memory_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Grid((100, 100, 50), (0, 0, 0), 1)
    monkeypatch.setattr(voxels, "available_memory", lambda: 1_000_000)
    assert voxels.dense_fits(grid, 100, "solid")
    monkeypatch.setattr(voxels, "available_memory", lambda: 999_999)
    with pytest.warns(VoxtoolWarning, match=r"dim 100, solid: other tools are left out.*1 MB"):
        assert not voxels.dense_fits(grid, 100, "solid")


@pytest.mark.parametrize(
    ("repeat", "seconds", "runs"), [(2, 0, 2), (2, 60, timing.MOST_RUNS), (20, 60, 20)]
)
def test_short_work_is_run_more_often(repeat: int, seconds: float, runs: int) -> None:
    turns = timing.by_turns(Request(repeat=repeat, seconds=seconds), list, list)
    assert [len(found) for found in turns] == [runs] * 2


def test_slow_tools_are_not_run_again() -> None:
    runs = []
    quick, slow = timing.Peers(9), timing.Peers(9, patience=-1)
    found, made = quick.times("quick", lambda: runs.append(0) or len(runs))
    assert (len(found), made) == (timing.PEER_RUNS, 1 + timing.PEER_RUNS)
    assert len(runs) == 1 + timing.PEER_RUNS
    assert len(slow.times("slow", lambda: runs.append(0))[0]) == 1
    assert slow.times("slow", lambda: runs.append(0)) == ([], None)
    assert len(runs) == 2 + timing.PEER_RUNS


def test_missing_tools_are_those_of_the_benches() -> None:
    assert set(peers.missing({"adf"})) <= {"open3d", "libigl"}
    assert set(peers.missing({"tets"})) <= {"vtk"}


# ---- ablation


def test_forced_decisions_change_nothing() -> None:
    """On one device: tests of the voxelizer and of fields force decisions on every one."""
    device = opened(usable_devices()[0][0])
    mesh = mesh_from_arrays(*meshes.icosphere(2))
    bench = timing.Bench(Request(repeat=1, seconds=0), device, device, "voxelize", "a/ball.obj")
    job = plan_voxelize(mesh, Grid.fit(mesh, 64), "solid", device=device)
    found = list(ablation.of_voxelize(job, bench, "solid"))
    assert [one.what for one in found] == [*ablation.VOXELIZE, *ablation.METHODS]
    assert all(one.same and (one.model, one.work) == ("ball.obj", "solid") for one in found)
    assert all(len(one.runs) == len(one.forced) == 1 for one in found)
    extraction = plan_extract(job.run(), style="marching-cubes", device=device)
    found = list(ablation.of_extract(extraction, bench, "marching-cubes"))
    assert [one.what for one in found] == [*ablation.EXTRACT, *ablation.PYRAMIDS]
    assert all(one.same for one in found)
    extraction.max_memory = extraction.with_(naive=True).cost.device - 1
    assert list(ablation.of_extract(extraction, bench, "marching-cubes")) == []
    request = {"tolerance": 1e-2, "max_level": 3, "measure": False, "device": device}
    found = list(ablation.of_field(plan_adf(mesh, **request), bench, "solid"))
    assert {one.what for one in found} == set(ablation.FIELD)
    assert all(one.same for one in found)
    unsigned = plan_adf(mesh, sign="none", **request)
    assert list(ablation.of_field(unsigned, bench, "solid")) == []
    points = sample_cube(100)
    for level, what in ((1, {ablation.WIDE, ablation.W}), (3, {ablation.WIDE})):  # which has w
        built = build_adf(mesh, device, tolerance=1e-2, max_level=level)
        found = list(ablation.of_queries(built, points, bench, "solid"))
        assert {one.what for one in found} == what
        assert all(one.same for one in found)
