"""voxtool adf-query: answers as the library's, through files and pipes; pictures; failures."""

from __future__ import annotations

import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, process, run
from helpers.field import plain_field, sphere

from voxtool import read_adf, write_adf
from voxtool.adf.field.cells import key_of
from voxtool.opencl import images
from voxtool.pictures.slices import INSIDE, OUTSIDE, round_step

ORIGIN, SIDE = (-1.0, 2.0, 0.5), 4.0
POINTS = np.random.default_rng(1).random((500, 3)) * SIDE + np.array(ORIGIN)
COLUMNS = "distance,gx,gy,gz,bound,level,kx,ky,kz,outside"


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    """A folder with a ball, one without bounds, and points in every format."""
    monkeypatch.chdir(tmp_path)
    place = {"origin": ORIGIN, "side": SIDE}
    write_adf(plain_field(sphere, 5e-3, 5, units="mm", **place), "ball.adf.h5")
    write_adf(plain_field(sphere, 5e-2, 3, bounds=False, **place), "plain.adf.h5")
    np.save("points.npy", POINTS)
    np.savez("points.npz", points=POINTS)
    np.savetxt("points.csv", POINTS, "%.17g", ",", header="x,y,z", comments="")
    np.savetxt("points.xyz", POINTS, "%.17g")
    Path("points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(POINTS)}\nproperty double x\n"
        "property double y\nproperty double z\nend_header\n" + Path("points.xyz").read_text()
    )
    return tmp_path


def npy(points: object) -> bytes:
    file = io.BytesIO()
    np.save(file, np.asarray(points, float))
    return file.getvalue()


# ---- what is written


@pytest.mark.parametrize("name", ["npy", "npz", "csv", "xyz", "ply"])
def test_points_of_every_format(name: str, here: Path) -> None:
    result = run(f"adf-query ball.adf.h5 points.{name}")
    assert result.stdout == ""
    assert result.stderr.startswith(f"voxtool: points.{name} -> points.distance.npy: 500 points, ")
    found = np.load("points.distance.npy")
    assert np.array_equal(found, read_adf("ball.adf.h5").query(POINTS).distance)


@pytest.mark.parametrize("search", ["linear", "binary", "coherent"])
def test_all_columns(search: str, here: Path) -> None:
    points = np.concatenate([POINTS, [(9, 9, 9), (math.nan, 3, 1)]])
    np.save("points.npy", points)
    result = run(
        f"adf-query ball.adf.h5 points.npy --gradient --bounds --cell -o a.csv --search {search}"
    )
    lines = Path("a.csv").read_text().splitlines()
    assert lines[0] == COLUMNS
    expected = read_adf("ball.adf.h5").query(points, gradient=True, bounds=True, cell=True)
    table = np.array([line.split(",") for line in lines[1:]], float)
    assert np.array_equal(table[:, 0], expected.distance, equal_nan=True)
    gradient = table[:, 1:4].astype(np.float32)
    assert np.array_equal(gradient, expected.gradient, equal_nan=True)
    assert np.array_equal(table[:, 4], expected.bound)
    assert np.array_equal(table[:, 5], expected.level)
    assert np.array_equal(table[:, 6:9], key_of(expected.level, expected.cell))
    assert np.array_equal(table[:, 9], expected.outside)
    assert table[-2:, 9].tolist() == [1, 0]
    assert result.stderr.splitlines()[1:] == [
        "voxtool: 1 point is NaN: so is the value",
        "voxtool: 1 point is outside the cube: the values are lower bounds",
    ]


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ("", "distance"),
        ("--gradient", "distance,gx,gy,gz,outside"),
        ("--bounds", "distance,bound,outside"),
        ("--cell", "distance,level,kx,ky,kz,outside"),
    ],
)
def test_only_the_columns_that_are_asked_for(asked: str, names: str, here: Path) -> None:
    result = run(f"adf-query ball.adf.h5 points.csv {asked} --format csv -q")
    assert result.stderr == ""
    assert Path("points.distance.csv").read_text().splitlines()[0] == names
    run(f"adf-query ball.adf.h5 points.csv {asked} -o a.npy")
    count = len(names.split(","))
    assert np.load("a.npy").shape == ((500,) if count == 1 else (500, count))


def test_pipes(here: Path) -> None:
    expected = read_adf("ball.adf.h5").query(POINTS).distance
    for command in ("adf-query ball.adf.h5", "adf-query ball.adf.h5 - -o -"):
        result = run(f"{command} --format npy", npy(POINTS))
        assert np.array_equal(np.load(io.BytesIO(result.stdout_bytes)), expected)
        assert result.stderr.startswith("voxtool: stdin -> stdout: 500 points, ")
    text = run("adf-query ball.adf.h5 -", Path("points.csv").read_bytes()).stdout
    assert text.splitlines() == ["distance", *map(repr, expected.tolist())]
    result = run("adf-query - points.npy -o a.npy", Path("ball.adf.h5").read_bytes())
    assert np.array_equal(np.load("a.npy"), expected)


def test_json(here: Path) -> None:
    points = np.concatenate([POINTS, [(9, 9, 9), (8, 8, 8), (math.nan, 3, 1)]])
    np.save("points.npy", points)
    result = run("adf-query ball.adf.h5 points.npy --json -o a.npy")
    said = json.loads(result.stdout)
    assert {k: said[k] for k in ("output", "points", "outside", "nan")} == {
        "output": "a.npy", "points": 503, "outside": 2, "nan": 1,
    }  # fmt: skip
    assert said["seconds"] > 0
    assert said["ns_a_point"] > 0
    piped = run("adf-query ball.adf.h5 --json --format npy", npy(points))
    said = "\n".join(line for line in piped.stderr.splitlines() if not line.startswith("voxtool:"))
    assert json.loads(said)["points"] == 503
    assert len(np.load(io.BytesIO(piped.stdout_bytes))) == 503
    assert run("adf-query ball.adf.h5 --json -q", npy(points)).stderr == ""


def test_the_points_are_not_overwritten(here: Path) -> None:
    before = Path("points.npy").read_bytes()
    result = process("adf-query ball.adf.h5 points.npy -o ./points.npy")
    assert result.returncode == 2
    assert b"points.npy is the input points.npy: name another output" in result.stderr
    assert Path("points.npy").read_bytes() == before


def test_no_points_at_all(here: Path) -> None:
    np.save("none.npy", np.empty((0, 3)))
    run("adf-query ball.adf.h5 none.npy --gradient")
    assert np.load("none.distance.npy").shape == (0, 5)


# ---- pictures


def test_a_slice(here: Path) -> None:
    from PIL import Image, ImageColor

    for axis, name in (("y", "a.png"), ("z", "b.png")):
        result = run(f"adf-query ball.adf.h5 --slice {axis}=2.53 --size 400 -o {name}")
        assert result.stdout == ""
        assert re.search(rf"ball.adf.h5 -> {name}: [0-9,]+ pixels at {axis}=2.53, ", result.stderr)
    picture = Image.open("b.png").convert("RGB")
    width, height = picture.size
    assert width == 400
    assert width * 0.8 < height < width
    pixels = {picture.getpixel((x, y)) for x in range(width) for y in range(height)}
    near = {ImageColor.getrgb(colour) for colour in (INSIDE[-1], OUTSIDE[0])}
    assert all(any(np.abs(np.subtract(p, n)).max() < 8 for p in pixels) for n in near)
    # the ball is round: the zero line is as far to the left as to the right, and inside is red
    red = np.array([[p[0] > p[2] + 30 for p in row] for row in np.asarray(picture).tolist()])
    columns = np.flatnonzero(red[: int(0.8 * height), : int(0.8 * width)].any(axis=0))
    rows = np.flatnonzero(red[: int(0.8 * height), : int(0.8 * width)].any(axis=1))
    assert abs(len(columns) - len(rows)) <= 3
    assert len(columns) > 100


def test_slices_of_every_kind_of_field(here: Path) -> None:
    """A plane of which all is outside, at the cube's face, of leaves of one level and of none that
    are large enough."""
    run("adf-query plain.adf.h5 --slice x=-1 --size 200")
    assert Path("plain.slice.png").stat().st_size > 5000
    said = json.loads(run("adf-query ball.adf.h5 --slice z=4.5 --size 200 --json").stdout)
    assert said["output"] == "ball.slice.png"
    assert said["points"] == 149**2
    assert "ns_a_point" not in said


def test_pictures_need_their_extra(here: Path, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    message = fail("adf-query ball.adf.h5 --slice z=1")
    assert message == "pictures need matplotlib: pip install 'voxtool[pictures]'"


@pytest.mark.parametrize(
    ("least", "step"), [(1.0, 1.0), (1.1, 2.0), (0.0021, 0.005), (6e-7, 1e-6), (300.0, 500.0)]
)
def test_round_steps(least: float, step: float) -> None:
    assert round_step(least) == step


# ---- failures


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("adf-query ball.adf.h5 none.npy", "none.npy: there is no such file"),
        ("adf-query points.csv points.npy", "points.csv"),
        ("adf-query ball.adf.h5 points.npy -o points.csv --no-clobber", "points.csv exists"),
        ("adf-query plain.adf.h5 points.npy --bounds", "plain.adf.h5: the field has no bounds"),
        (
            "adf-query ball.adf.h5 --slice x=3.1",
            "ball.adf.h5: slice x=3.1 lies outside of the cube: choose -1 to 3",
        ),
    ],
)
def test_failures(command: str, message: str, here: Path) -> None:
    assert message in fail(command)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("adf-query - -", "FIELD and POINTS cannot both be stdin"),
        ("adf-query -", "FIELD and POINTS cannot both be stdin"),
        ("adf-query ball.adf.h5 points.npy --size 300", "--size goes with --slice"),
        ("adf-query ball.adf.h5 points.npy --slice z=1", "leave out POINTS"),
        ("adf-query ball.adf.h5 --slice z=1 --gradient", "leave out POINTS, --gradient"),
        ("adf-query ball.adf.h5 --slice w=1", "'w=1' is no plane: write x=1.5"),
        ("adf-query ball.adf.h5 --slice z", "'z' is no plane"),
        ("adf-query ball.adf.h5 --slice z=nan", "'z=nan' is no plane"),
        ("adf-query ball.adf.h5 points.npy --search quick", "quick"),
    ],
)
def test_usage_errors(command: str, message: str, here: Path) -> None:
    assert message in fail(command, code=2)


def test_damaged_points_leave_nothing(here: Path) -> None:
    Path("bad.csv").write_text("x,y,z\n1,2,3\n1,two,3\n")
    assert fail("adf-query ball.adf.h5 bad.csv").startswith("bad.csv: line 3: ")
    Path("bad.npy").write_bytes(npy(POINTS)[:-8])
    assert fail("adf-query ball.adf.h5 bad.npy").startswith("bad.npy: ")
    assert not list(here.glob("*.distance.*"))


def test_the_hardware_interpolates_on_request(here: Path, monkeypatch) -> None:
    expected = read_adf("ball.adf.h5").query(POINTS).distance
    run("adf-query ball.adf.h5 points.csv --sampler hardware -o a.npy -q")
    assert np.allclose(np.load("a.npy"), expected, rtol=0, atol=1e-2)
    monkeypatch.setattr(images, "FILTER_STEP", -1.0)
    said = fail("adf-query ball.adf.h5 points.csv --sampler hardware -o b.npy", 4)
    assert "does not interpolate in images of one float32 channel: use the exact sampler" in said
    assert not Path("b.npy").exists()
