"""voxtool bench adf: what it measures, where, and what it says of it; never how fast."""

from __future__ import annotations

import json
import math
from pathlib import Path

import meshes
import numpy as np
import pytest
from conftest import usable_devices
from helpers_cli import fail, invoke, run, write_obj

from voxtool.adf.survey import cube_of
from voxtool.bench import adf, peers
from voxtool.choices import SEARCHES
from voxtool.cli import bench_adf
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.spatial.sampling import spread_in_cube
from voxtool.spatial.signed_distance import SignedDistance

WORK = "bench adf ball.obj --max-level 4 --points 3000 --repeat 1"


@pytest.fixture
def ball(tmp_path: Path, monkeypatch) -> str:
    """The current folder, with ball.obj; a small sphere for the hash; the device to use."""
    mesh = mesh_from_arrays(*meshes.icosphere(1))
    write_obj(tmp_path / "ball.obj", mesh.vertices, mesh.faces)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(adf, "SPHERE_LEVEL", 4)
    return str(usable_devices()[0][0])


@pytest.fixture
def alone(monkeypatch) -> None:
    """No peer is installed."""
    monkeypatch.setattr(peers, "_module", lambda name: None)


def half_off(mesh) -> list[peers.DistancePeer]:
    """A peer that is wrong by half a side of the cube everywhere, and one that has no inside."""
    exact, side = SignedDistance(mesh), cube_of(mesh)[1]
    return [
        peers.DistancePeer("Off 1.0", lambda: lambda points: exact(points) + side / 2),
        peers.DistancePeer("Unsigned 2.0", lambda: lambda points: abs(exact(points)), True),
    ]


# ---- the command


def test_json(ball: str, alone: None) -> None:
    result = run(f"{WORK} --tolerances 1e-1,1e-2 --band 0.25 --device {ball} --json")
    assert result.stderr == ""
    told = json.loads(result.stdout)
    assert told["device"]["index"] == int(ball)
    asked = {"max_level": 4, "band": 0.25, "sign": None, "points": 3000, "repeat": 1}
    assert {name: told[name] for name in asked} == asked
    check_hash(told["sphere"])
    rows = told["rows"]
    assert [row["tolerance"] for row in rows] == [1e-1, 1e-2]
    assert rows[0]["blocks"] < rows[1]["blocks"]
    assert rows[0]["exact"] == rows[1]["exact"]
    for row in rows:
        check_row(row)


def check_hash(table: dict) -> None:
    types = {"keys": int, "seconds": float, "spread": float, "m": int, "r": int, "w": bool,
             "load": float, "bits_a_key": float}  # fmt: skip
    assert {name: type(value) for name, value in table.items()} == types
    assert table["load"] == table["keys"] / table["m"] ** 3
    assert table["seconds"] > 0


def check_row(row: dict) -> None:
    types = {
        "model": str, "triangles": int, "sign": str, "tolerance": float, "build": float,
        "spread": float, "stages": dict, "device": float, "host": float, "depth": int,
        "blocks": int, "leaves": int, "bytes": int, "lipschitz": float, "error": dict,
        "missed": int, "upload": float, "hash": dict, "queries": list, "exact": dict, "peers": list,
    }  # fmt: skip
    assert {name: type(value) for name, value in row.items()} == types
    assert (row["model"], row["triangles"], row["sign"]) == ("ball.obj", 80, "pseudonormal")
    assert row["leaves"] == 7 * row["blocks"] + 1
    assert row["stages"].keys() >= {"tree", "sample", "constrain", "examine", "refine"}
    assert "distance" not in row["stages"]  # is of the errors
    assert row["device"] == sum(row["stages"].values())
    for place in ("in the cube", "near the surface"):
        assert row["error"][place].keys() == {"points", "max", "rms", "p99", "within"}
    check_hash(row["hash"])
    assert row["hash"]["keys"] == row["blocks"]
    asked = [(query["points"], query["search"]) for query in row["queries"]]
    assert asked == [(kind, search) for kind in ("random", "rays") for search in SEARCHES]
    for query in row["queries"]:
        assert query["count"] >= 3000
        assert query["ns"] > 0
        assert query["device_ns"] > 0
        assert query["break_even"] is None or query["break_even"] >= 0
    assert row["exact"]["name"] == "exact"
    assert row["exact"]["ns"].keys() == row["exact"]["count"].keys() == {"random", "rays"}
    assert min(row["exact"]["build"], *row["exact"]["ns"].values()) > 0
    assert row["exact"]["error"] == {}
    assert row["peers"] == []


def test_tables(ball: str, alone: None) -> None:
    result = run(f"{WORK} --tolerances 1e-1,1e-2 --device {ball}")
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert lines[0].startswith("voxtool ")
    assert lines[1].startswith("perfect hash of a sphere: ")
    assert lines[3] == "ball.obj: 80 triangles, sign pseudonormal, levels to 4"
    first = [line.split()[0] for line in lines[4:]]
    assert first == ["build", "0.1", "0.01", "error", "0.1", "0.01", "query", "0.1", "0.01",
                     "exact", "exact"]  # fmt: skip
    for start, end in ((4, 7), (7, 10), (10, 13), (13, 15)):
        assert len({len(line) for line in lines[start:end]}) == 1


def test_missing_peers_are_named_with_what_installs_them(ball: str, alone: None) -> None:
    result = run(f"{WORK} --tolerances 1e-1 --peers --device {ball}")
    assert result.stderr.splitlines() == [
        "voxtool: peer open3d is not installed: pip install open3d",
        "voxtool: peer libigl is not installed: pip install libigl",
    ]
    assert result.stdout.splitlines()[-1].startswith("exact ")


def test_peers_are_held_against_the_exact_distance(ball: str, monkeypatch) -> None:
    monkeypatch.setattr(peers, "of_distance", half_off)
    monkeypatch.setattr(peers, "missing", lambda *modules: [])
    work = f"{WORK} --tolerances 1e-1 --peers --device {ball}"
    off, unsigned = json.loads(run(f"{work} --json").stdout)["rows"][0]["peers"]
    assert (off["name"], unsigned["name"]) == ("Off 1.0", "Unsigned 2.0")
    mesh = mesh_from_arrays(*meshes.icosphere(1))
    origin, side = cube_of(mesh)
    exact = SignedDistance(mesh)(origin + side * spread_in_cube(3000))
    inside = int(np.count_nonzero(exact < 0))
    for peer in (off, unsigned):
        assert peer["count"]["random"] == peer["error"]["random"]["points"] == 3000
        assert peer["build"] > 0
        assert peer["ns"]["random"] >= 0
        assert peer["error"]["random"]["other_sign"] == inside > 300
    for error in off["error"].values():
        assert [error[name] for name in ("max", "rms", "p99")] == pytest.approx([0.5] * 3)
        assert error["max_unsigned"] <= 0.5 + 1e-12
    error = unsigned["error"]["random"]
    assert error["max"] == pytest.approx(2 * -exact.min() / side)
    assert error["max_unsigned"] == 0
    assert [line[:12].rstrip() for line in run(work).stdout.splitlines()[-2:]] == [
        "Off 1.0",
        "Unsigned 2.0",
    ]


def test_there_is_no_error_where_a_band_leaves_no_point(ball: str, alone: None) -> None:
    lines = run(f"{WORK} --tolerances 0 --band 0 --device {ball}").stdout.splitlines()
    assert lines[3].endswith(", band 0")
    at = next(i for i, line in enumerate(lines) if line.startswith("error"))
    words = lines[at + 1].split()
    assert words[:5] == ["0", "-", "-", "-", "-"]
    assert float(words[5]) >= 0  # the first of those near the surface is on it


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--tolerances 1e-3,x", "'x' is not a valid float"),
        ("--tolerances -1", "-1.0 is not in the range x>=0"),
        ("--max-level 22", "22 is not in the range 1<=x<=21"),
        ("--points 0", "0 is not in the range"),
        ("--sign fast", "'fast' is not one of"),
    ],
)
def test_wrong_usage(ball: str, words: str, message: str) -> None:
    result = invoke(f"bench adf ball.obj {words}")
    assert result.exit_code == 2
    assert message in result.stderr


def test_what_cannot_be_measured_is_one_line(ball: str) -> None:
    assert fail(f"bench adf none.obj --device {ball}").startswith("none.obj: no such file")
    assert "no OpenCL device matches" in fail("bench adf ball.obj --device nothing-like-it")
    assert fail(f"{WORK} --band -1 --device {ball}") == "band -1: give a length from 0 on"


# ---- points


@pytest.mark.parametrize(("count", "step"), [(1, 0.5), (1000, 1 / 64), (5000, 1 / 256)])
def test_rays_go_through_the_cube(count: int, step: float) -> None:
    rays = adf.rays_through_cube(count, step)
    n = rays.shape[1]
    assert rays.shape[2] == 3
    assert rays.shape[0] * n >= count > (rays.shape[0] - 1) * n
    assert rays.min() > 0
    assert rays.max() < 1
    steps = np.diff(rays, axis=1)
    assert np.allclose(np.sqrt((steps**2).sum(axis=2)), step)
    assert np.allclose(steps / step, adf.DIRECTION)
    assert (rays[:, 0, 2] < step).all()
    assert (rays[:, -1, 2] > 1 - step).all()
    assert len(np.unique(rays[:, 0], axis=0)) == len(rays)
    down, across = rays[:, 0, 1], rays[:, 0, 0]
    assert np.array_equal(np.lexsort((across, down)), np.arange(len(rays)))


def test_few_points_are_some_of_the_many(monkeypatch) -> None:
    monkeypatch.setattr(adf, "FEW", 500)
    mesh = mesh_from_arrays(*meshes.box((1, 2, 3), (5, 4, 4)))
    many, few = adf.points_of(mesh, 2000, 5)
    origin, side = cube_of(mesh)
    assert np.array_equal(many["random"], origin + side * spread_in_cube(2000))
    assert np.array_equal(few["random"], many["random"][:500])
    ray = adf.rays_through_cube(2000, 1 / 64).shape[1]
    assert len(few["rays"]) == 500 // ray * ray
    places = {point.tobytes(): i for i, point in enumerate(many["rays"])}
    found = np.array([places[point.tobytes()] for point in few["rays"]]).reshape(-1, ray)
    assert (np.diff(found, axis=1) == 1).all()  # whole rays
    assert (found[:, 0] % ray == 0).all()
    assert found[-1, 0] > len(many["rays"]) / 2  # from all over
    monkeypatch.setattr(adf, "FEW", 10)  # less than a ray
    assert len(adf.points_of(mesh, 2000, 5)[1]["rays"]) == ray


def test_keys_of_a_sphere(monkeypatch) -> None:
    monkeypatch.setattr(adf, "SPHERE_LEVEL", 4)
    expected = []
    for level in range(5):
        for cell in np.ndindex((1 << level,) * 3):
            low = np.array(cell) / (1 << level) - (0.5, 0.48, 0.51)
            corners = low + np.array(list(np.ndindex(2, 2, 2))) / (1 << level)
            nearest = np.clip(0, low, low + 0.5**level)
            if math.dist(nearest, (0, 0, 0)) <= adf.SPHERE_RADIUS <= np.sqrt(
                (corners**2).sum(axis=1)
            ).max():  # fmt: skip
                expected.append(tuple((1 << level) + i for i in cell))
    assert sorted(map(tuple, adf.sphere_keys().tolist())) == sorted(expected)


# ---- figures


def test_errors() -> None:
    exact = np.array([-2.0, -1.0, 1.0, 4.0])
    assert adf.errors_at(np.array([-2.0, 1.5, 1.0, 4.0]), exact, 2.0) == {
        "points": 4,
        "max": 1.25,
        "rms": 0.625,
        "p99": 1.25,
        "max_unsigned": 0.25,
        "other_sign": 1,
    }


@pytest.mark.parametrize(
    ("seconds", "ns", "expected"),
    [
        (3.0, 100.0, 2_000_000),  # 2 s more than the tree, 1 us saved at a point
        (0.5, 100.0, 0),  # ready before
        (3.0, 1100.0, None),
        (3.0, 2000.0, None),
    ],
)
def test_break_even(seconds: float, ns: float, expected: int | None) -> None:
    exact = adf.Exact("exact", 1.0, {"rays": 10}, {"rays": 1100.0, "random": 5.0})
    query = adf.Query("rays", "binary", 10, ns, ns, 0.0)
    assert adf.break_even(seconds, query, exact) == expected


def test_what_a_peer_builds_anew_is_no_part_of_its_queries(monkeypatch) -> None:
    points = {"random": np.zeros((4, 3))}
    slow = peers.DistancePeer("Slow 1", lambda: lambda points: np.zeros(len(points)))
    times = iter([1.0, 3.0] * 2)
    monkeypatch.setattr(adf.timing, "times", lambda work, repeat: [next(times)])
    kept = adf.measure_peer(slow, points, {"random": np.zeros(4)}, 1.0, 5)
    anew = peers.DistancePeer("Slow 2", slow.build, builds_each_time=True)
    rebuilt = adf.measure_peer(anew, points, {"random": np.zeros(4)}, 1.0, 5)
    assert kept.build == rebuilt.build == 1.0
    assert kept.ns["random"] == pytest.approx(0.75e9)
    assert rebuilt.ns["random"] == pytest.approx(0.5e9)


# ---- peers, where they are installed


@pytest.mark.parametrize(("module", "name"), [("open3d", "Open3D "), ("igl", "libigl ")])
def test_a_peer_gives_the_distance_to_a_box(module: str, name: str) -> None:
    pytest.importorskip(module)
    mesh = mesh_from_arrays(*meshes.box((0, 0, 0), (4, 3, 2)))
    (peer,) = (peer for peer in peers.of_distance(mesh) if peer.name.startswith(name))
    points = np.array([[5.0, 1.3, 0.7], [2.1, 1.2, 0.5], [2.1, 1.2, 3.0], [-3.0, -4.0, 1.0]])
    # libigl takes 1 - 2 w for the sign, and its w is approximate
    assert peer.build()(points) == pytest.approx([1.0, -0.5, 1.0, 5.0], rel=0.03)


def test_the_table_names_what_is_measured() -> None:
    assert bench_adf.SEARCHES == SEARCHES
    kinds, _ = adf.points_of(mesh_from_arrays(*meshes.box(0, 1)), 1, 1)
    assert tuple(kinds) == bench_adf.KINDS
