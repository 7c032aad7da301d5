"""voxtool distance: points against a plain oracle, grids against voxelize, and what is refused."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, run, write_obj
from helpers.distance import brute

import voxtool
from voxtool.files.meshes.mesh import load_mesh

POINTS = np.random.default_rng(3).uniform(-1, 5, (50, 3))


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    """A folder with box.obj, open.obj, a box without its side at high x, and points.csv."""
    monkeypatch.chdir(tmp_path)
    write_obj(Path("box.obj"), *meshes.box(0, 4))
    write_obj(Path("open.obj"), *meshes.open_box(0, 4, missing=1))
    np.savetxt("points.csv", POINTS, delimiter=",", fmt="%.17g")
    return tmp_path


def test_points(here: Path) -> None:
    result = run("distance box.obj points.csv")
    assert result.stderr.startswith("voxtool: points.csv -> points.distance.npy: 50 distances, ")
    found = np.load("points.distance.npy")
    vertices, faces = meshes.box(0, 4)
    inside = ((POINTS > 0) & (POINTS < 4)).all(axis=1)
    expected = np.where(inside, -1, 1) * brute(POINTS, vertices[faces])
    assert np.abs(found - expected).max() < 1e-14
    run("distance open.obj points.csv --fill none -o unsigned.npy")
    assert (np.load("unsigned.npy") > 0).all()


def test_all_columns(here: Path) -> None:
    run("distance box.obj points.csv --gradient --nearest --face -o all.csv -q")
    names = Path("all.csv").read_text().splitlines()[0]
    assert names == "distance,gx,gy,gz,nearest_x,nearest_y,nearest_z,face"
    table = np.loadtxt("all.csv", delimiter=",", skiprows=1)
    mesh = load_mesh("box.obj")
    found = voxtool.distance(mesh, POINTS, gradient=True, nearest=True, face=True)
    assert np.array_equal(table[:, 0], found.distance)
    assert np.array_equal(table[:, 1:4], found.gradient)
    assert np.array_equal(table[:, 4:7], found.nearest)
    assert np.array_equal(table[:, 7], found.face)


@pytest.mark.parametrize(
    "options", ["", "-", "- -o -", "two.csv -o -", "two.csv -o - --format csv"]
)
def test_stdout_is_csv(here: Path, options: str) -> None:
    points = b"2 2 2\n6 2 2\n"
    Path("two.csv").write_bytes(points.replace(b" ", b","))
    text = run(f"distance box.obj {options}", points).stdout
    assert text == "distance\n-2.0\n2.0\n"


def test_stdout_is_binary_on_request(here: Path) -> None:
    done = run("distance box.obj -o - --format npy", b"2 2 2\n6 2 2\n")
    assert np.load(io.BytesIO(done.stdout_bytes)).tolist() == [-2.0, 2.0]


@pytest.mark.slow
@pytest.mark.parametrize("mesh", ["box", "open"])
def test_a_grid(here: Path, mesh: str) -> None:
    """The grid of the open box leaks by parity as its octree does."""
    for fill in ("auto", "parity", "flood"):
        run(f"voxelize {mesh}.obj --dim 24 --fill {fill} -o {mesh}.svo.h5 -q")
        octree = voxtool.read_svo(f"{mesh}.svo.h5")
        result = run(f"distance {mesh}.obj --dim 24 --fill {fill} -o sdf.npy --json")
        found = np.load("sdf.npy")
        assert np.array_equal(found < 0, octree.to_dense())
        assert json.loads(result.stdout)["negative"] == octree.count
        centres = octree.grid.to_world(np.argwhere(found == found) + 0.5)
        loaded = load_mesh(f"{mesh}.obj")
        expected = brute(centres[::97], loaded.vertices[loaded.faces])
        assert np.abs(np.abs(found.ravel()[::97]) - expected).max() < 1e-14
    run(f"distance {mesh}.obj --like {mesh}.svo.h5 --fill flood --float32 -o like.npy")
    like = np.load("like.npy")
    assert like.dtype == np.float32
    assert np.array_equal(like < 0, octree.to_dense())


def test_centres_on_the_surface_are_negative_where_set(here: Path) -> None:
    found = voxtool.distance_grid(load_mesh("box.obj"), voxtool.Grid((9, 9, 9), -0.5, 1.0))
    assert np.count_nonzero(found < 0) == 4**3
    assert np.count_nonzero(np.abs(found) < 1e-300) == 5**3 - 3**3


def test_the_plan(here: Path) -> None:
    text = run("distance box.obj --dim 32 --plan").stdout
    assert "distances  32 x 32 x 32 float64\n" in text
    assert "tree, distance\n" in text
    found = json.loads(run("distance open.obj points.csv --plan --json").stdout)
    assert found["stages"] == ["tree", "moments", "distance", "winding number"]
    assert "gradients, nearest points and faces" in found["left_out"]
    assert not list(Path().glob("*.npy"))


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        ("box.obj points.csv --dim 32", 2, "give one of them"),
        ("box.obj points.csv --fill flood", 2, "--fill flood fills whole voxels"),
        ("box.obj --dim 32 --face", 2, "go with POINTS"),
        ("box.obj --dim 32 --pitch 1", 2, "both set the voxel size"),
        ("box.obj --dim 32 --like box.svo.h5", 2, "--like sets the grid"),
        ("box.obj points.csv --float32", 2, "goes with a grid"),
        ("- -", 2, "cannot both be stdin"),
        ("box.obj points.csv -o points.csv", 2, "points.csv is the input points.csv: name another"),
        (
            "box.obj nan.csv -o no.npy",
            3,
            "nan.csv: point 1, (nan, 0.0, 0.0), is not finite or too far",
        ),
        ("none.obj points.csv", 3, "no such file"),
        ("box.obj --dim 64 --max-memory 1M", 4, "simplify the mesh"),
    ],
)
def test_failures(here: Path, options: str, code: int, message: str) -> None:
    Path("nan.csv").write_text("1,2,3\nnan,0,0\n")
    assert message in fail(f"distance {options}", code)
