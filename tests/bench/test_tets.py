"""voxtool bench tets: what it measures, and what it says of it; never how fast."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import usable_devices
from helpers_cli import fail, invoke, run
from selftest.test_reference import TETRAHEDRON, constant_of, five, kuhn, look, ramp, steps

from voxtool.bench import peers, tets
from voxtool.choices import METHODS, VIEWS
from voxtool.cli import bench_tets
from voxtool.selftest.reference import reference
from voxtool.tets.mesh import UnstructuredMesh, tetrahedra

WORK = "bench tets cube.vtu --size 12 --every 2 --repeat 1"


@pytest.fixture
def cube(tmp_path: Path, monkeypatch) -> str:
    """The current folder, with cube.vtu, which has one point and one cell array; the device."""
    meshio = pytest.importorskip("meshio")
    vertices, cells = kuhn(2, 0.2)
    values = np.random.default_rng(6).uniform(1, 3, len(vertices))
    meshio.write_points_cells(
        tmp_path / "cube.vtu", vertices, {"tetra": cells}, point_data={"heat": values},
        cell_data={"part": [np.arange(len(cells)) % 3.0]},
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)
    return str(usable_devices()[0][0])


@pytest.fixture
def alone(monkeypatch) -> None:
    """No peer is installed."""
    monkeypatch.setattr(peers, "_module", lambda name: None)


# ---- the command


def test_json(cube: str) -> None:
    words = f"--scalar heat --integrators linear,sampled:1 --transfers x1,steps --device {cube}"
    result = run(f"{WORK} {words} --json")
    assert result.stderr == ""
    told = json.loads(result.stdout)
    assert told["device"]["index"] == int(cube)
    asked = {"size": 12, "view": "iso", "every": 2, "repeat": 1, "component": None}
    assert {name: told[name] for name in asked} == asked
    assert [row["transfer"] for row in told["rows"]] == ["x1", "steps"]
    for row in told["rows"]:
        types = {"model": str, "cells": int, "scalar": str, "transfer": str, "pixels": int,
                 "alpha": float, "frames": list, "peers": list}  # fmt: skip
        assert {name: type(value) for name, value in row.items()} == types
        assert (row["model"], row["cells"], row["scalar"]) == ("cube.vtu", 48, "heat")
        assert 5 < row["pixels"] < 36
        assert 0 < row["alpha"] <= 1
        assert row["peers"] == []
        drawn = [(frame["name"], frame["integrator"]) for frame in row["frames"]]
        assert drawn == [(m, i) for m in METHODS for i in ("linear", "sampled:1")]
        for frame in row["frames"]:
            assert frame["first"] > 0
            assert frame["seconds"] > 0
            assert 0 <= frame["rms"] <= frame["max"] <= 1
            assert (frame["max"] < 1e-5) == (frame["integrator"] == "linear")


def test_table(cube: str, alone: None) -> None:
    words = f"--scalar heat --methods raycast --transfers x1,x10 --peers --device {cube}"
    result = run(f"{WORK} {words} --integrators linear,average")
    assert result.stderr == "voxtool: peer vtk is not installed: pip install vtk\n"
    lines = result.stdout.splitlines()
    assert lines[0].startswith("voxtool ")
    assert lines[2] == "cube.vtu: 48 cells, heat, 12 x 12, iso"
    assert [line.split(":")[0] for line in (lines[4], lines[9])] == ["x1", "x10"]
    for start in (5, 10):
        table = lines[start : start + 3]
        assert [line.split()[0] for line in table] == ["method", "raycast", "raycast"]
        assert len({len(line) for line in table}) == 1
        assert table[1].endswith("1.00")
    assert len(lines) == 13


def test_constant_cells(cube: str) -> None:
    words = f"--scalar part --transfers x10 --integrators linear --device {cube} --json"
    (row,) = json.loads(run(f"{WORK} {words}").stdout)["rows"]
    assert [frame["name"] for frame in row["frames"]] == list(METHODS)
    assert max(frame["max"] for frame in row["frames"]) < 1e-5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--methods raycast,fast", "'fast' is not one of"),
        ("--transfers x2", "'x2' is not one of"),
        ("--every 0", "0 is not in the range"),
        ("--view above", "'above' is not one of"),
    ],
)
def test_wrong_usage(cube: str, words: str, message: str) -> None:
    result = invoke(f"bench tets cube.vtu {words}")
    assert result.exit_code == 2
    assert message in result.stderr


def test_what_cannot_be_measured_is_one_line(cube: str) -> None:
    assert "none.vtu" in fail(f"bench tets none.vtu --device {cube}")
    assert "heat, part" in fail(f"bench tets cube.vtu --scalar cold --device {cube}")
    wrong = fail(f"{WORK} --scalar heat --integrators exact --device {cube}")
    assert wrong.startswith("integrator 'exact' is unknown")


def test_the_command_names_what_is_measured() -> None:
    assert bench_tets.METHODS == METHODS
    assert bench_tets.INTEGRATORS == tets.INTEGRATORS
    assert bench_tets.TRANSFERS == tets.TRANSFERS
    assert bench_tets.VIEWS == VIEWS


# ---- figures


def test_errors_are_of_pixels_with_something_in_them() -> None:
    expected = np.array([(0, 0, 0, 0), (0.5, 0, 0, 0.5), (0, 0, 0, 0)])
    view = tets.View(look(3, 1), np.array([(0, 0), (1, 0), (2, 0)]), expected)
    assert view.errors(expected) == (0, 0)
    found = expected + np.array([(0, 0, 0, 0), (0, 0, 0, 0.25), (0, 0, 0, 0)])
    assert view.errors(found) == (0.125, 0.25)
    found[2, 3] = 0.5  # that should be empty
    assert view.errors(found) == (np.sqrt((0.25**2 + 0.5**2) / 8), 0.5)
    picture = np.arange(3)[None, :, None] * np.ones(4)
    assert view.of(picture)[:, 0].tolist() == [0, 1, 2]


def test_transfer_functions() -> None:
    vertices, cells = kuhn()
    mesh = tetrahedra(UnstructuredMesh(vertices, [("tetra", cells)], 3 + vertices[:, 0], "s"))
    opaque = {name: tets.transfer_of(name, mesh) for name in tets.TRANSFERS}
    most = tets.DEPTH / np.sqrt(3)
    for name, factor in (("x1", 1), ("x10", 10), ("x100", 100)):
        assert opaque[name].scalars.tolist() == [3, 3.25, 3.5, 3.75, 4]
        assert opaque[name].extinctions.max() == pytest.approx(factor * most)
    jumps = np.diff(opaque["steps"].extinctions)[np.diff(opaque["steps"].scalars) == 0]
    assert jumps == pytest.approx(100 * most * np.array([1, -1, 1, -1]))


# ---- the peer, where it is installed


@pytest.mark.parametrize("points", [constant_of(1), ramp(2), five(), five(100), steps()])
@pytest.mark.parametrize("constant", [False, True])
def test_a_peer_finds_what_the_reference_does(points, constant: bool) -> None:
    pytest.importorskip("vtk")
    size = (40, 30)
    rays = look(*size, eye=(3, 4, 5), target=(0.25, 0.25, 0.25), height=1.4)
    scalars = np.array([0.47]) if constant else np.array([0, 1, 0.3, 0.7])
    cells = np.array([(0, 1, 2, 3)])
    (peer,) = peers.of_volume(TETRAHEDRON, cells, scalars, points, rays, constant=constant)
    peer.draw()
    row, column = np.divmod(np.arange(40 * 30), 40)
    expected = reference(TETRAHEDRON, cells, scalars, points, rays, constant=constant)
    assert np.count_nonzero(expected[:, 3]) > 200
    found = peer.at(np.stack([column, row], axis=1))
    assert np.abs(found - expected).max() < 2e-6
    shown = peer.picture()
    assert shown.shape == (30, 40, 4)
    smooth = expected.reshape(30, 40, 4)[8:-8, 14:-14]  # its texture is a bit too large
    assert np.abs(shown[8:-8, 14:-14] - smooth).mean() < 0.02


def test_no_peer_is_right_in_perspective() -> None:
    rays = look(fov=30.0)
    cells = np.array([(0, 1, 2, 3)])
    assert peers.of_volume(TETRAHEDRON, cells, np.zeros(4), ramp(1), rays) == []


def test_peers_are_measured_as_shown_and_by_their_rays(cube: str, monkeypatch) -> None:
    def grey(vertices, cells, scalars, transfer, rays, constant):
        width, height = rays.size
        peer = peers.PicturePeer(
            "Grey 1.0", lambda: None, lambda: np.full((height, width, 4), 0.5),
            lambda pixels: reference(vertices, cells, scalars, transfer, rays, pixels),
        )  # fmt: skip
        return [peer]

    monkeypatch.setattr(peers, "of_volume", grey)
    words = f"--scalar heat --methods raycast --transfers x1 --integrators linear --device {cube}"
    (row,) = json.loads(run(f"{WORK} {words} --peers --json").stdout)["rows"]
    shown, rays = row["peers"]
    assert (shown["name"], rays["name"]) == ("Grey 1.0, shown", "Grey 1.0, rays")
    assert shown["max"] == pytest.approx(0.5)
    assert rays["max"] == 0
    assert shown["seconds"] == rays["seconds"]
