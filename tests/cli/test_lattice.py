"""Grids of other files: --like and --lattice, what lies beyond, and units."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import meshes
from helpers.cli import fail, invoke, run, told, write_obj

import voxtool
from voxtool.files import read_svo

SIDES = 64  # of the cylinder
PITCH = 0.5


def cylinder(radius: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A prism along z around 0, closed and outward."""
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ring = np.rint(512 * ring) / 512  # on the fixed-point lattice of voxels of PITCH
    low, high = (np.c_[ring, np.full(SIDES, z)] for z in (-height / 2, height / 2))
    i, j = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    walls = [np.stack([i, j, j + SIDES], axis=1), np.stack([i, j + SIDES, i + SIDES], axis=1)]
    k = np.arange(1, SIDES - 1)
    caps = [np.stack([0 * k, k + 1, k], axis=1), np.stack([0 * k, k, k + 1], axis=1) + SIDES]
    return np.concatenate([low, high]), np.concatenate([*walls, *caps])


def in_ring(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return which points lie in the cross-section of the cylinder of radius 8."""
    ring = cylinder(8, 1)[0][:SIDES, :2]
    edges = np.roll(ring, -1, axis=0) - ring
    left = edges[:, 0] * (y[..., None] - ring[:, 1]) - edges[:, 1] * (x[..., None] - ring[:, 0])
    return (left > 0).all(axis=-1)


@pytest.fixture
def parts(tmp_path: Path, monkeypatch) -> None:
    """A.obj, a box of 40 x 40 x 20, and its octree; B.obj, a cylinder of height 40."""
    monkeypatch.chdir(tmp_path)
    write_obj(Path("A.obj"), *meshes.box((-20, -20, -10), (20, 20, 10)))
    write_obj(Path("B.obj"), *cylinder(8, 40))
    run(f"voxelize A.obj --pitch {PITCH} -q")


def test_octrees_of_one_lattice_combine_without_loss(parts) -> None:
    """Their union has the volume of the two, by the centres of voxels."""
    run("voxelize B.obj --pitch 0.3 -q")
    message = fail("combine A.svo.h5 B.svo.h5 -o U.svo.h5")
    assert message.endswith("voxelize one again with --lattice, naming the other")
    said = told("voxelize B.obj --lattice A.svo.h5 --json")
    assert (said["beyond"], said["warnings"], said["notes"]) == (0.0, [], [])
    one, other = read_svo("A.svo.h5").grid, read_svo("B.svo.h5").grid
    apart = (np.array(other.origin) - one.origin) / PITCH
    assert np.array_equal(apart, np.rint(apart))
    assert (other.pitch, other.shape) == (one.pitch, (40, 40, 88))  # a margin of 4 voxels
    found = told("combine A.svo.h5 B.svo.h5 -o U.svo.h5 --json")
    centres = np.arange(-25, 25, PITCH) + PITCH / 2
    x, y = np.meshgrid(centres, centres)
    square, ring = (abs(x) < 20) & (abs(y) < 20), in_ring(x, y)
    count = 40 * np.count_nonzero(square | ring) + 40 * np.count_nonzero(ring)  # of 80 layers
    assert found["volume"] == PITCH**3 * count
    assert found["volume"] > 36000


def test_what_lies_beyond_is_said_once(parts) -> None:
    """The part of the cylinder beyond the box: of its wall and its caps."""
    ring = cylinder(8, 40)[0][:SIDES]
    after = np.roll(ring, -1, axis=0)
    around = np.linalg.norm(after - ring, axis=1).sum()
    area = (ring[:, 0] * after[:, 1] - ring[:, 1] * after[:, 0]).sum() / 2
    inner = 2 * (10 + 4 * PITCH)  # the margin is part of the grid
    beyond = (around * (40 - inner) + 2 * area) / (around * 40 + 2 * area)
    for command, output in (("voxelize", "b.svo.h5"), ("distance", "b.npy")):
        result = run(f"{command} B.obj --like A.svo.h5 -o {output} --json")
        said = json.loads(result.stdout)
        assert said["beyond"] == pytest.approx(beyond, rel=1e-12)
        line = (
            f"{100 * beyond:.3g} % of the surface of B.obj lies beyond the grid of A.svo.h5: "
            "--lattice A.svo.h5 takes all of it, on the same voxels"
        )
        assert said["warnings"] == [line]
        assert result.stderr == f"voxtool: warning: {line}\n"
        strict = invoke(f"{command} B.obj --like A.svo.h5 -o {output} --strict")
        assert strict.exit_code == 1
    assert read_svo("b.svo.h5").grid == read_svo("A.svo.h5").grid


@pytest.mark.parametrize(
    ("options", "beyond"),
    [
        ("--bbox -20 -20 -10 20 20 10 --pitch 0.5", False),
        ("--bbox -20,-20,-10,20,20,10 --dim 37", False),  # of a pitch that is rounded
        ("--bbox 0,-20,-10,20,20,10 --pitch 0.5", True),
        ("--origin -20,-20,-10 --shape 80 --spacing 0.5", False),
        ("--origin -20,-20,-10 --shape 80,80,39 --spacing 0.5", True),
    ],
)
def test_boxes_report_what_they_cut(options: str, beyond: bool, parts) -> None:
    said = told(f"voxelize A.obj {options} -o a.svo.h5 --json")
    assert (said["beyond"] > 0) == beyond
    assert [line.split(" lies ")[1] for line in said["warnings"]] == beyond * [
        "beyond the grid: choose a larger one"
    ]


def test_a_box_in_one_word_or_six(parts) -> None:
    for words in ("-20 -20 -10 20 20 10", "-20,-20,-10,20,20,10"):
        run(f"voxelize A.obj --bbox {words} --pitch 0.5 -o {len(words.split())}.svo.h5 -q")
        run(f"export A.svo.h5 --bbox {words} -o a.npy -q")
        run(f"morph A.svo.h5 --resample --bbox {words} -o a.npy -q")
    assert read_svo("1.svo.h5") == read_svo("6.svo.h5")
    run("voxelize A.obj --shape 64 --origin -32,-32,-32 --spacing 1 -o one.svo.h5 -q")
    run("voxelize A.obj --shape 64,64,64 --origin -32,-32,-32 --spacing 1 -o three.svo.h5 -q")
    assert read_svo("one.svo.h5") == read_svo("three.svo.h5")
    for words in ("0,0,0,1,1", "0 0 0 1 1 -o", "0 0 0 1 1 x", "1"):
        assert "is no box: write 0,0,0,1,1,1" in fail(f"voxelize A.obj --bbox {words}", 2)


def test_resampling_and_samples_on_a_lattice(parts) -> None:
    run("voxelize B.obj --lattice A.svo.h5 -q")
    said = told("morph B.svo.h5 --resample --like A.svo.h5 -o r.svo.h5 --json")
    lost = 1 - read_svo("r.svo.h5").count / read_svo("B.svo.h5").count
    assert said["beyond"] == pytest.approx(lost, rel=1e-12)
    assert said["warnings"][0].startswith(f"{100 * lost:.3g} % of the set voxels lie beyond")
    run("voxelize B.obj --pitch 0.4 -o fine.svo.h5 -q")
    said = told("morph fine.svo.h5 --resample --lattice A.svo.h5 -o r.svo.h5 --json")
    assert (said["beyond"], said["warnings"], said["pitch"]) == (0.0, [], [PITCH] * 3)
    run("combine A.svo.h5 r.svo.h5 -o u.svo.h5 -q")
    run("adf-build B.obj --max-level 3 -q")
    run("export B.adf.h5 --lattice A.svo.h5 -o b.npz -q")
    with np.load("b.npz") as found:
        apart = (found["origin"] - read_svo("A.svo.h5").grid.origin) / PITCH
    assert np.array_equal(apart, np.rint(apart))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("voxelize B.obj --like A.svo.h5 --dim 9", "--like sets the grid: drop --dim"),
        ("voxelize B.obj --lattice A.svo.h5 --pitch 1", "--lattice sets the voxels: drop --pitch"),
        ("distance B.obj --lattice A.svo.h5 --like A.svo.h5", "--like sets the grid: drop --lat"),
        ("voxelize B.obj --shape 64", "go together: give all three"),
        ("export A.adf.h5 --lattice A.svo.h5 --shape 9 -o a.npy", "sets the voxels: drop --shape"),
        ("morph A.svo.h5 --resample --lattice A.svo.h5 --dim 9", "sets the voxels: drop --dim"),
        ("morph A.svo.h5 --close 1 --lattice A.svo.h5", "--lattice goes with --resample"),
    ],
)
def test_one_thing_places_the_grid(words: str, message: str, parts) -> None:
    assert message in fail(words, 2)


def test_units_are_converted(parts) -> None:
    """A part in inches on voxels in millimetres sets those of the part in millimetres."""
    inches = meshes.box((-0.3, -0.2, -0.1), (0.3, 0.2, 0.1))
    write_obj(Path("in.obj"), *inches)
    write_obj(Path("mm.obj"), inches[0] * 127 / 5, inches[1])
    run("voxelize A.obj --units mm --pitch 0.5 -q")
    note = "in.obj is in in, the grid in mm: scaled by 25.4"
    for option in ("--like", "--lattice"):
        said = told(f"voxelize in.obj --units in {option} A.svo.h5 --json")
        assert (said["units"], said["notes"]) == ("mm", [note])
        run(f"voxelize mm.obj --units mm {option} A.svo.h5 -q")
        assert read_svo("in.svo.h5") == read_svo("mm.svo.h5")
        run("combine A.svo.h5 in.svo.h5 -o both.svo.h5 -q")
        far = told(f"distance in.obj --units in {option} A.svo.h5 -o in.npy --json")
        assert (far["units"], far["notes"]) == ("mm", [note])
        run(f"distance mm.obj {option} A.svo.h5 -o mm.npy -q")
        assert np.array_equal(np.load("in.npy"), np.load("mm.npy"))
    # where one is not known, nothing is converted
    said = told("voxelize mm.obj --like A.svo.h5 -o plain.svo.h5 --json")
    assert (said["units"], said["notes"]) == ("mm", [])
    run("compare plain.svo.h5 mm.svo.h5 -q")


def test_units_of_sources_and_references(parts) -> None:
    run("voxelize A.obj --units mm --scale 10 --dim 40 -o mm.svo.h5 -q")
    note = "A.obj is in cm, the octree in mm: scaled by 10"
    for words in ("--style sharp --source A.obj", "--style voxel-faces --against A.obj"):
        said = told(f"extract mm.svo.h5 {words} --units cm -o a.ply --json")
        assert note in said["notes"]
        run(f"extract mm.svo.h5 {words} --units mm --scale 10 -o b.ply -q")
        assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()
    assert said["against"]["hausdorff_upper"] < 20  # a voxel, and its margin
    said = told("export mm.svo.h5 --links D3Q19 --source A.obj --units cm -o a.npz --json")
    assert said["notes"] == [note]
    run("adf-build A.obj --units mm --scale 10 --max-level 4 -o mm.adf.h5 -q")
    said = told("extract mm.adf.h5 --style sharp --source A.obj --units cm -o a.ply --json")
    assert said["notes"][0] == "A.obj is in cm, the field in mm: scaled by 10"
    run("extract mm.adf.h5 --style sharp --source A.obj --units mm --scale 10 -o b.ply -q")
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()


def test_units_that_cannot_be_converted_are_refused(parts) -> None:
    run("voxelize A.obj --units mm --pitch 0.5 -o mm.svo.h5 -q")
    run("voxelize A.obj --units m --pitch 0.5 -o m.svo.h5 -q")
    run("adf-build A.obj --units m --max-level 3 -o m.adf.h5 -q")
    for words in (
        "combine mm.svo.h5 m.svo.h5 -o u.svo.h5",
        "compare mm.svo.h5 m.svo.h5",
        "render mm.svo.h5 --difference m.svo.h5 -o a.png",
        "morph m.svo.h5 --resample --like mm.svo.h5 -o a.svo.h5",
        "morph m.svo.h5 --resample --lattice mm.svo.h5 -o a.svo.h5",
        "export m.adf.h5 --like mm.svo.h5 -o a.npy",
        "export m.adf.h5 --lattice mm.svo.h5 -o a.npy",
    ):
        assert "1 m is 1000 mm: " in fail(words)
    run("combine mm.svo.h5 A.svo.h5 -o u.svo.h5 -q")  # of which one is not known


def test_meshes_are_joined_in_the_unit_of_the_first(parts) -> None:
    trimesh.Trimesh(*meshes.box((0, 0, 0), (1, 1, 1))).export("m.glb")  # in metres
    run("voxelize m.glb A.obj --labels file --dim 16 -o m.svo.h5 -q --units cm")
    whole = voxtool.join([voxtool.load_mesh("A.obj", units="mm"), voxtool.load_mesh("m.glb")])
    assert (whole.units, whole.bounds[1].tolist()) == ("mm", [1000.0] * 3)


def test_both_meshes_of_a_report_are_named(parts) -> None:
    result = run("voxelize A.obj B.obj --labels file --dim 16 -o AB.svo.h5")
    assert result.stderr.startswith("voxtool: A.obj, B.obj -> AB.svo.h5: ")


def test_in_python(parts) -> None:
    grid = read_svo("A.svo.h5").grid
    with pytest.warns(voxtool.MeshWarning, match="lies beyond the grid of A.svo.h5"):
        cut = voxtool.voxelize("B.obj", "A.svo.h5")
    with pytest.warns(voxtool.MeshWarning, match="lies beyond the grid: choose"):
        assert voxtool.voxelize("B.obj", grid) == cut
    whole = voxtool.voxelize("B.obj", lattice="A.svo.h5")
    assert whole == voxtool.voxelize("B.obj", lattice=grid)
    mesh = voxtool.load_mesh("B.obj")
    assert whole.grid == voxtool.Grid.fit(mesh, lattice=grid)
    assert (whole & voxtool.read_svo("A.svo.h5")).count < whole.count
    assert voxtool.share_beyond(mesh, whole.grid) == 0 < voxtool.share_beyond(mesh, grid)
    far = voxtool.distance_grid("B.obj", lattice="A.svo.h5")
    assert np.array_equal(far < 0, whole.to_dense())
    again = voxtool.resample(whole, lattice="A.svo.h5", bbox=(-8, -8, -20, 8, 8, 20))
    assert voxtool.compare(again, whole).equal
    with pytest.raises(voxtool.GridError, match="drop dim= and pitch=, or the grid"):
        voxtool.voxelize("B.obj", grid, lattice=grid)
    with pytest.raises(voxtool.GridError, match="a lattice has voxels of its own"):
        voxtool.voxelize("B.obj", lattice=grid, dim=9)
