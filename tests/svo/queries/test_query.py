"""Queries at points: against dense arrays, and planes against rational arithmetic."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers.merged import OCTREES
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree
from voxtool.svo.queries.points import voxels_around
from voxtool.svo.queries.query import OctreeQuery, plan_query

COORDINATES = st.floats(-1e6, 1e6)
PITCHES = st.floats(1e-6, 1e6)


def random_points(grid: Grid, count: int = 900) -> np.ndarray:
    """Points in the grid and around it, a third of them on planes between voxels."""
    rng = np.random.default_rng(5)
    places = rng.random((count, 3)) * (np.array(grid.shape) + 4) - 2
    places[::3] = np.rint(places[::3])
    return grid.to_world(places)


def voxel_of(grid: Grid, point: np.ndarray) -> list[int]:
    """The voxel around a point, in rational numbers; it may lie beyond the grid."""
    rows = zip(point.tolist(), grid.origin, grid.pitch, strict=True)
    return [math.floor((Fraction(p) - Fraction(o)) / Fraction(s)) for p, o, s in rows]


# ---- in which voxel


@given(
    origin=st.tuples(*[COORDINATES] * 3),
    pitch=st.tuples(*[PITCHES] * 3),
    planes=st.tuples(*[st.integers(-1, 65536)] * 3),
    steps=st.tuples(*[st.integers(-3, 3)] * 3),
)
@settings(max_examples=200)
def test_voxels_are_those_of_rational_arithmetic(origin, pitch, planes, steps) -> None:
    grid = Grid((65536, 40000, 9), origin, pitch)
    point = np.array(origin) + np.array(planes) * np.array(pitch)
    for axis, step in enumerate(steps):  # a few float64 beside a plane
        for _ in range(abs(step)):
            point[axis] = np.nextafter(point[axis], math.copysign(math.inf, step))
    expected = voxel_of(grid, point)
    held = all(0 <= i < n for i, n in zip(expected, grid.shape, strict=True))
    within, voxels = voxels_around(grid, point[None])
    assert within.tolist() == [held]
    assert voxels.tolist() == ([expected] if held else [])


def test_points_far_away_are_outside() -> None:
    grid = Grid((8, 8, 8), (1e90, 0, 0), (1e70, 1e-60, 1))
    far = np.array([(math.inf, 0, 0), (0, -math.inf, 0), (1e308, 1e308, 1), (0, 1e308, 1)])
    assert not voxels_around(grid, far)[0].any()


# ---- what is there


@pytest.mark.parametrize("name", OCTREES)
def test_answers_are_those_of_the_dense_array(name: str, device: Device) -> None:
    octree = OCTREES[name]()
    dense = np.zeros((octree.grid.side,) * 3, bool)
    dense[tuple(map(slice, octree.grid.shape))] = octree.to_dense()
    points = random_points(octree.grid)
    cells = [voxel_of(octree.grid, point) for point in points]
    held = ((np.array(cells) >= 0) & (np.array(cells) < octree.grid.shape)).all(axis=1)
    x, y, z = np.where(held[:, None], cells, 0).T
    merged = MergedOctree.of(octree)
    for each in (octree, merged):
        np.testing.assert_array_equal(each.contains(points, device=device), dense[x, y, z] & held)
    for level in ("voxel", *range(octree.depth)):
        side = 1 if level == "voxel" else 4 << int(level)
        n = octree.grid.side // side
        shares = dense.reshape(n, side, n, side, n, side).mean(axis=(1, 3, 5))
        expected = np.where(held, shares[x // side, y // side, z // side], 0)
        for each in (octree, merged):
            found = OctreeQuery(each, level, device)(points)
            np.testing.assert_array_equal(found.coverage, expected)
            np.testing.assert_array_equal(found.outside, ~held)


def test_the_largest_dim(device: Device) -> None:
    """A cube of 32,769 voxels a side, in a corner of a grid of 65,536."""
    grid = Grid((65536,) * 3, (0, 0, 0), (1, 1, 1))
    collector = Collector(grid)
    collector.add_cubes(np.zeros((1, 3), np.int64), 32768)
    octree = collector.octree() | Octree.from_voxels([(32768, 7, 65535)], grid)
    points = [(32767.5, 32767, 0), (32768, 0, 0), (32768, 7.9, 65535.9), (32768, 8, 65535)]
    found = OctreeQuery(octree, octree.depth - 1, device)(points)
    assert found.contains.tolist() == [True, False, True, False]
    assert found.coverage is not None
    assert found.coverage.tolist() == [(32768**3 + 1) / 65536**3] * 4


def nearest_by_all(octree: Octree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest set voxels and their distances, by comparing all."""
    voxels, grid = octree.occupied(), octree.grid
    longest, found, distances = max(grid.pitch), [], []
    for place in (points - np.array(grid.origin)) / np.array(grid.pitch):
        x, y, z = (np.abs(voxels + 0.5 - place) * (np.array(grid.pitch) / longest)).T
        squares = x * x + y * y + z * z
        found.append(voxels[np.argmin(squares)])
        distances.append(np.sqrt(squares.min()) * longest)
    return np.array(found), np.array(distances)


@pytest.mark.parametrize("name", [n for n in OCTREES if n != "empty"])
@pytest.mark.parametrize("pitch", [(1, 1, 1), (0.3, 1, 7)])
def test_nearest_voxels_are_those_of_comparing_all(name: str, pitch, device: Device) -> None:
    """Among the points are centres, corners and planes of voxels, with many equal distances."""
    octree = OCTREES[name]()
    octree = replace(octree, grid=Grid(octree.grid.shape, (0.5, -3, 7), pitch))
    places = np.random.default_rng(8).random((60, 3)) * (np.array(octree.grid.shape) * 3) - 20
    places[::3] = np.rint(places[::3])
    places[1::6] = np.rint(places[1::6]) + 0.5
    points = octree.grid.to_world(places)
    voxels, distances = nearest_by_all(octree, points)
    for each in (octree, octree.pruned(), MergedOctree.of(octree)):
        found = OctreeQuery(each, device=device, nearest=True)(points)
        np.testing.assert_array_equal(found.nearest, voxels)
        np.testing.assert_array_equal(found.distance, distances)


def test_nearest_of_an_empty_octree_and_far_points(device: Device) -> None:
    found = OctreeQuery(OCTREES["empty"](), device=device, nearest=True)([(0, 0, 0)])
    assert found.nearest is not None
    assert found.distance is not None
    assert (found.nearest.tolist(), found.distance.tolist()) == ([[-1, -1, -1]], [math.inf])
    octree = OCTREES["one voxel"]()
    query = OctreeQuery(octree, device=device, nearest=True)
    for far in (math.inf, 1e300, -2e5):
        with pytest.raises(VoxtoolError, match=r"point 1 .* is 1,048,576 voxels or more away"):
            query([(0, 0, 0), (0, far, 0)])
    long = replace(octree, grid=Grid(octree.grid.shape, (0, 0, 0), (1, 1, 1e7)))
    with pytest.raises(GridError, match="times as long as wide"):
        plan_query(long, nearest=True, device=device)


def test_one_point_and_none(device: Device) -> None:
    octree = OCTREES["full"]()
    query = OctreeQuery(octree, 0, device)
    one = query(octree.grid.to_world(np.array([1.5, 2.5, 3.5])))
    assert (one.contains, one.coverage, one.outside) == (True, 1.0, False)
    assert query(np.empty((0, 3))).contains.shape == (0,)
    assert bool(octree.contains(octree.grid.origin)) is True


# ---- what is refused


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([(0, 0, 0), (0, math.nan, 0)], r"point 1 \(the first is 0\) is NaN: leave it out"),
        ([[1, 2]], r"points of shape \(1, 2\)"),
        ("a", "points"),
    ],
)
def test_points_that_are_refused(points: object, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message):
        OCTREES["full"]().contains(points)


def test_jobs_are_planned(device: Device) -> None:
    octree = OCTREES["random 0"]()
    for level in ("voxel", 1, None):
        job = plan_query(octree, level=level, device=device)
        assert job.plan.level == level
        assert (job.cost.host > 0) == (level == 1)
        assert job.run()(octree.grid.origin).outside == False  # noqa: E712 (a numpy bool)
    with pytest.raises(VoxtoolError, match="level 9: choose 'voxel' or a level"):
        plan_query(octree, level=9, device=device)
    with pytest.raises(MemoryLimitError, match="queries of the octree would need"):
        plan_query(octree, device=device, max_memory=100).run()
