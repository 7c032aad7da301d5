"""voxtool svo-query: answers as the library's, through files and pipes; failures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, process, run, told
from helpers.octree import ball, octree_from_dense

import voxtool
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage

OCTREE = octree_from_dense(ball((24, 20, 16), 0.4))
POINTS = OCTREE.grid.to_world(np.random.default_rng(2).random((300, 3)) * 26 - 1)


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    """A folder with an octree, the same merged, and points."""
    monkeypatch.chdir(tmp_path)
    voxtool.write_svo(OCTREE, "ball.svo.h5")
    voxtool.write_svo(MergedOctree.of(OCTREE), "small.svo.h5")
    np.save("points.npy", POINTS)
    np.savetxt("points.csv", POINTS, "%.17g", ",", header="x,y,z", comments="")
    return tmp_path


@pytest.mark.parametrize("octree", ["ball.svo.h5", "small.svo.h5"])
def test_answers_are_the_librarys(octree: str, here: Path) -> None:
    expected = voxtool.query_svo(octree, POINTS, level=0)
    outside = np.count_nonzero(expected.outside)
    said = run(f"svo-query {octree} points.npy").stderr.splitlines()
    count = np.count_nonzero(expected.contains)
    assert said[0].startswith(
        f"voxtool: points.npy -> points.voxels.npy: 300 points, {count} in set voxels, "
    )
    assert said[1] == f"voxtool: {outside} points are outside the grid"
    assert np.array_equal(np.load("points.voxels.npy"), expected.contains)
    run(f"svo-query {octree} points.csv --level 0 -o answers.csv")
    lines = Path("answers.csv").read_text().splitlines()
    assert lines[0] == "contains,coverage"
    table = np.array([line.split(",") for line in lines[1:]], float)
    assert np.array_equal(table[:, 0], expected.contains)
    assert np.array_equal(table[:, 1], expected.coverage)


def test_nearest_voxels(here: Path) -> None:
    expected = voxtool.query_svo(OCTREE, POINTS, nearest=True)
    run("svo-query small.svo.h5 points.npy --nearest -o answers.csv")
    lines = Path("answers.csv").read_text().splitlines()
    assert lines[0] == "contains,voxel_x,voxel_y,voxel_z,distance"
    table = np.array([line.split(",") for line in lines[1:]], float)
    assert expected.nearest is not None
    assert np.array_equal(table[:, 1:4], expected.nearest)
    assert np.array_equal(table[:, 4], expected.distance)
    centres = OCTREE.grid.to_world(expected.nearest + 0.5)
    np.testing.assert_allclose(np.linalg.norm(POINTS - centres, axis=1), expected.distance)


def test_pipes_json_and_plans(here: Path) -> None:
    expected = OCTREE.contains(POINTS)
    text = run("svo-query ball.svo.h5", Path("points.csv").read_bytes()).stdout
    assert text.split() == ["contains", *map(str, expected.astype(int))]
    said = json.loads(run("svo-query ball.svo.h5 points.npy --json").stdout)
    assert (said["points"], said["contained"]) == (300, np.count_nonzero(expected))
    plan = json.loads(run("svo-query small.svo.h5 points.npy --plan --json").stdout)
    assert plan["stages"] == ["upload", "query"]
    assert set(plan["left_out"]) == {"coverage", "nearest voxels", "nodes of equal subtrees"}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("svo-query ball.svo.h5 none.npy", "none.npy: there is no such file"),
        ("svo-query ball.svo.h5 points.npy --level 7", "ball.svo.h5: level 7: choose 'voxel' or"),
        ("svo-query ball.svo.h5 points.npy --max-memory 10", "queries of the octree would need"),
        (
            "svo-query ball.svo.h5 far.csv --nearest",
            "far.csv: point 0 (the first is 0) is 1,",
        ),
        ("svo-query points.csv points.npy", "points.csv"),
        ("svo-query ball.svo.h5 nan.csv", "nan.csv: point 1 (the first is 0) is NaN"),
    ],
)
def test_failures(command: str, message: str, here: Path) -> None:
    Path("far.csv").write_text("0,0,1e9\n")
    Path("nan.csv").write_text("0,0,0\n1,nan,2\n")
    assert fail(command).startswith(message)


def test_usage(here: Path) -> None:
    assert "OCTREE and POINTS cannot both be stdin" in fail("svo-query - -", 2)
    assert process("svo-query ball.svo.h5 points.npy -o ./points.npy").returncode == 2


def test_attributes_of_points(here: Path) -> None:
    octree = attributed()
    voxtool.write_svo(octree, "parts.svo.h5")
    points = np.random.default_rng(7).random((500, 3)) * 44 - 2
    np.save("points.npy", points)
    names = ("label", "colour", "normal", "area", "fraction", "faces")
    found = voxtool.query_svo(octree, points, attributes=names)
    assert np.array_equal(found.contains, octree.contains(points))
    cells = np.floor(points).astype(int)
    within = ((cells >= 0) & (cells < octree.grid.shape)).all(axis=1)
    for name in names:
        dense = np.concatenate(list(AttributeImage(VoxelImage.of(octree), name).slabs()))
        wanted = np.zeros((len(points), *dense.shape[3:]), dense.dtype)
        wanted[within] = dense[tuple(cells[within].T)]
        values = getattr(found, name)
        assert np.array_equal(values + 1 if name == "label" else values, wanted)
    assert found[3].label == found.label[3]
    run("svo-query parts.svo.h5 points.npy --attributes colour,label,area -o answers.csv")
    lines = Path("answers.csv").read_text().splitlines()
    assert lines[0] == "contains,red,green,blue,alpha,label,area"
    table = np.loadtxt(lines[1:], delimiter=",")
    assert np.array_equal(table[:, 6].astype("f4"), found.area)
    assert np.array_equal(table[:, 1:5], found.colour)
    assert np.array_equal(table[:, 5], found.label)
    message = "has no attribute 'label', it has none"
    assert message in fail("svo-query ball.svo.h5 points.npy --attributes label")
    message = "merged subtrees have no attribute 'label'"
    assert message in fail("svo-query small.svo.h5 points.npy --attributes label")


def test_svo_info_lists_labels(here: Path) -> None:
    octree = attributed()
    voxtool.write_svo(octree, "parts.svo.h5")
    dense = np.concatenate(list(AttributeImage(VoxelImage.of(octree), "label").slabs()))
    counts = np.bincount(dense.ravel())[1:].tolist()
    assert sum(counts) == octree.count
    rows = told("svo-info parts.svo.h5 --json")["attributes"]["label"]["labels"]
    assert [(row["label"], row["name"], row["voxels"]) for row in rows] == [
        (number, name, counts[number]) for number, name in enumerate(("head", "größe", "a b"))
    ]
    shares = np.concatenate(list(AttributeImage(VoxelImage.of(octree), "fraction").slabs()))
    assert rows[1]["volume"] == pytest.approx(shares[dense == 2].sum(dtype=float), rel=1e-12)
    plain = replace(octree, attributes=octree.attributes[:1]).summary()
    found = plain["attributes"]["label"]["labels"]
    assert [row["volume"] for row in found] == counts
    text, volume = run("svo-info parts.svo.h5").stdout, f"{rows[1]['volume']:.9g}"
    assert f"      1 {counts[1]:>19,}   {volume:<16} größe" in text.splitlines()
