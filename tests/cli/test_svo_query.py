"""voxtool svo-query: answers as the library's, through files and pipes; failures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers_cli import fail, process, run
from helpers_octree import ball, octree_from_dense

import voxtool
from voxtool.svo.merged import MergedOctree

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
