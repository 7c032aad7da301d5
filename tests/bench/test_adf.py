"""The bench of distance fields: its points, and what it says of tools that are wrong."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import opened, usable_devices
from helpers import meshes
from helpers.cli import write_obj

from voxtool.adf.construction.survey import cube_of
from voxtool.bench import adf, peers
from voxtool.bench.points import FIGURES, Point
from voxtool.bench.references import distances_compared
from voxtool.bench.request import KINDS, Request
from voxtool.bench.timing import Bench
from voxtool.choices import SEARCHES
from voxtool.distances import plan_distance
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.opencl import open_device
from voxtool.spatial.sampling import sample_cube

REQUEST = Request(tolerances=(1e-1, 1e-2), levels=(4,), points=2000, sphere_level=3, repeat=1,
                  seconds=0, peers=True, ablations=False)  # fmt: skip


def wrong_tools(mesh) -> dict:
    """A tool that is wrong by half a side of the cube everywhere, and one that has no inside."""
    exact, side = plan_distance(mesh).run(), cube_of(mesh)[1]
    return {
        "Off 1.0": lambda: lambda points: exact(points) + side / 2,
        "Unsigned 2.0": lambda: lambda points: abs(exact(points)),
    }


@pytest.fixture(scope="module")
def points(tmp_path_factory) -> list[Point]:
    """The points of a small sphere."""
    path = tmp_path_factory.mktemp("adf") / "ball.obj"
    write_obj(path, *meshes.icosphere(1))
    index = usable_devices()[0][0]
    profiled = open_device(str(index), profile=True)
    tools = SimpleNamespace(of_distance=wrong_tools)
    found = list(adf.measure(Bench(REQUEST, opened(index), profiled, "adf", str(path), tools)))
    assert all(isinstance(point, Point) for point in found)
    return found  # type: ignore[return-value]


def of(points: list[Point], work: str) -> list[Point]:
    return [point for point in points if point.work.startswith(work)]


def test_builds(points: list[Point]) -> None:
    first, second = of(points, "mesh to field")
    assert (first.label, second.label) == ("tolerance 0.1", "tolerance 0.01")
    for point in (first, second):
        assert point.size == 7 * point.figures["blocks"] + 1
        assert point.figures["triangles"] == 80
        assert point.stages.keys() >= {"tree", "sample", "examine"}
        assert "errors" not in point.stages
        assert point.errors.keys() >= {"rms", "p99", "max", "rms near the surface"}
        assert "error measurement" not in point.left_out
    assert first.figures["blocks"] < second.figures["blocks"]
    assert first.errors["rms"] > second.errors["rms"]


def test_hashes(points: list[Point]) -> None:
    hashes = of(points, adf.HASH)
    assert [point.method for point in hashes] == [*["field, levels to 4"] * 2, "sphere"]
    for point in hashes:
        assert point.figures["load"] == point.size / point.figures["side of slots"] ** 3
        assert not point.errors
    assert [point.size for point in hashes[:2]] == [
        point.figures["blocks"] for point in of(points, "mesh to field")
    ]


def test_queries(points: list[Point]) -> None:
    asked = [p for p in of(points, "distances at") if p.method.startswith("field")]
    settings = [(p.setting["tolerances"], p.setting["search"]) for p in asked]
    every = [(t, search) for t in REQUEST.tolerances for _ in KINDS for search in SEARCHES]
    assert settings == every
    for point in asked:
        assert point.setting["points"] >= 2000
        assert point.figures["ns a point"] > 0
        even = point.figures["break-even"]
        assert even is None or even >= 0
        assert point.errors.keys() == {"rms", "p99", "max"}
    assert all(point.figures.keys() <= FIGURES.keys() for point in points)


def test_other_tools_are_compared_with_exact_distances(points: list[Point]) -> None:
    exact, off, unsigned = of(points, "distances at 2,000 random points")[-3:]
    methods = ["exact distances", "Off 1.0", "Unsigned 2.0"]
    assert [point.method for point in (exact, off, unsigned)] == methods
    assert exact.absent["rms"] == "errors are measured against it"
    mesh = mesh_from_arrays(*meshes.icosphere(1))
    origin, side = cube_of(mesh)
    distances = plan_distance(mesh).run()(origin + side * sample_cube(2000))
    inside = int(np.count_nonzero(distances < 0))
    for tool in (off, unsigned):
        assert tool.peer
        assert tool.figures["other sign"] == inside > 200
    assert [off.errors[name] for name in ("max", "rms", "p99")] == pytest.approx([0.5] * 3)
    assert unsigned.errors["max"] == pytest.approx(-2 * distances.min() / side)
    assert unsigned.figures["max unsigned"] == 0


# ---- points and keys


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


def test_keys_of_a_sphere() -> None:
    expected = []
    for level in range(5):
        for cell in np.ndindex((1 << level,) * 3):
            low = np.array(cell) / (1 << level) - (0.5, 0.48, 0.51)
            corners = low + np.array(list(np.ndindex(2, 2, 2))) / (1 << level)
            nearest = np.clip(0, low, low + 0.5**level)
            farthest = np.sqrt((corners**2).sum(axis=1)).max()
            if math.dist(nearest, (0, 0, 0)) <= adf.SPHERE_RADIUS <= farthest:
                expected.append(tuple((1 << level) + i for i in cell))
    assert sorted(map(tuple, adf.sphere_keys(4).tolist())) == sorted(expected)


# ---- figures


def test_errors() -> None:
    found, exact = np.array([-2.0, 1.5, 1.0, 4.0]), np.array([-2.0, -1.0, 1.0, 4.0])
    errors, signs = distances_compared(found, exact, 2.0)
    assert errors == {"rms": 0.625, "p99": 1.25, "max": 1.25}
    assert signs == {"max unsigned": 0.25, "other sign": 1}


@pytest.mark.parametrize(
    ("spent", "saved", "expected"), [(2.0, 0.5, 4.0), (-0.5, 0.1, 0.0), (2.0, 0.0, None)]
)
def test_break_even(spent: float, saved: float, expected: float | None) -> None:
    assert adf.break_even(spent, saved) == expected


# ---- other tools, where they are installed


@pytest.mark.parametrize(("module", "name"), [("open3d", "Open3D "), ("igl", "libigl ")])
def test_a_tool_gives_the_distance_to_a_box(module: str, name: str) -> None:
    pytest.importorskip(module)
    mesh = mesh_from_arrays(*meshes.box((0, 0, 0), (4, 3, 2)))
    (prepare,) = (tool for key, tool in peers.of_distance(mesh).items() if key.startswith(name))
    points = np.array([[5.0, 1.3, 0.7], [2.1, 1.2, 0.5], [2.1, 1.2, 3.0], [-3.0, -4.0, 1.0]])
    # libigl takes 1 - 2 w for the sign, and its w is approximate
    assert prepare()(points) == pytest.approx([1.0, -0.5, 1.0, 5.0], rel=0.03)
