"""The grid: where it is placed, and the fixed-point lattice."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from voxtool.errors import GridError
from voxtool.grid import FIXED_POINT_LIMIT, MAX_DIM, MIN_DIM, Grid
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.svo.sets.placing import common_grid

UNIT = 256
BOX = [(0.0, 0.0, 0.0), (4.0, 2.0, 1.0)]


def mesh_of(points) -> Mesh:
    """A mesh that has these vertices and uses them all."""
    faces = [(i, i, i) for i in range(len(points))]
    return mesh_from_arrays(np.asarray(points, float), np.array(faces))


def refused(*args, **options) -> str:
    with pytest.raises(GridError) as caught:
        Grid.fit(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- what a grid is


def test_a_grid_is_its_numbers() -> None:
    grid = Grid((20, 9, 5), (1.0, 2.0, 3.0), (0.5, 0.5, 0.25))
    assert (grid.dim, grid.side) == (20, 32)
    assert grid.voxel_volume == 0.0625
    assert grid == Grid(*(np.array(v) for v in (grid.shape, grid.origin, grid.pitch)))  # pyright: ignore
    assert [type(v) for v in (*grid.shape, *grid.origin, *grid.pitch)] == [int] * 3 + [float] * 6
    assert grid == Grid((20, 9, 5), (1, 2, 3), (0.5, 0.5, 0.25))
    assert Grid((8,) * 3, (0,) * 3, (1,) * 3) == Grid(8, 0, 1)  # pyright: ignore
    with pytest.raises(AttributeError):
        grid.shape = (1, 2, 3)  # pyright: ignore


@pytest.mark.parametrize("dim", [8, 9, 63, 64, 65, 4096, 4097, 65535, 65536])
def test_side_is_the_least_power_of_two(dim: int) -> None:
    side = Grid((dim, 1, 1), (0, 0, 0), (1, 1, 1)).side
    assert side & (side - 1) == 0
    assert side // 2 < dim <= side


@pytest.mark.parametrize(
    ("shape", "origin", "pitch", "message"),
    [
        ((7, 7, 7), (0, 0, 0), (1, 1, 1), "must have 8 to 65536"),
        ((65537, 8, 8), (0, 0, 0), (1, 1, 1), "must have 8 to 65536"),
        ((8, 8, 0), (0, 0, 0), (1, 1, 1), "every side at least 1"),
        ((8, -8, 8), (0, 0, 0), (1, 1, 1), "grid of 8 x -8 x 8 voxels"),
        ((8, 8, 8), (0, math.nan, 0), (1, 1, 1), "not finite"),
        ((8, 8, 8), (0, 0, math.inf), (1, 1, 1), "not finite"),
        ((8, 8, 8), (0, 0, 0), (1, 0, 1), "not positive"),
        ((8, 8, 8), (0, 0, 0), (1, 1, -1), "not positive"),
        ((8, 8, 8), (0, 0, 0), (math.nan, 1, 1), "not positive"),
        ((8, 8, 8), (0, 0, 0), (1, math.inf, 1), "not positive"),
    ],
)
def test_a_grid_out_of_range_is_refused(shape, origin, pitch, message) -> None:
    with pytest.raises(GridError, match=message) as caught:
        Grid(shape, origin, pitch)
    assert "\n" not in str(caught.value)


# ---- to the lattice and back


def test_to_fixed_rounds_half_to_even() -> None:
    grid = Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))
    halves = np.array([[0.5, 1.5, 2.5], [3.5, -0.5, -1.5], [-2.5, 0.75, 0.25]]) / UNIT
    fixed = grid.to_fixed(halves)
    assert fixed.dtype == np.int32
    assert fixed.tolist() == [[0, 2, 2], [4, 0, -2], [-2, 1, 0]]


@given(
    st.lists(st.integers(-(1 << 20), 1 << 20), min_size=3, max_size=3),
    st.integers(-8, 8),
    st.lists(st.integers(-100, 100), min_size=3, max_size=3),
)
def test_to_fixed_is_the_nearest_lattice_point(numerators, exponent, origin) -> None:
    """Compare with fractions, for values whose quotients are exact."""
    pitch = 2.0**exponent
    grid = Grid((8, 8, 8), tuple(map(float, origin)), (pitch,) * 3)  # pyright: ignore
    point = np.array(numerators) / 1024
    expected = [
        round((Fraction(n, 1024) - o) / Fraction(pitch) * UNIT)
        for n, o in zip(numerators, origin, strict=True)
    ]
    assume(max(map(abs, expected)) <= FIXED_POINT_LIMIT)
    assert grid.to_fixed(point[None]).tolist() == [expected]


def test_to_fixed_leaves_its_input_alone() -> None:
    points = np.array([[1.0, 2.0, 3.0]])
    Grid((8, 8, 8), (1, 1, 1), (2, 2, 2)).to_fixed(points)
    assert points.tolist() == [[1.0, 2.0, 3.0]]
    assert Grid((8, 8, 8), (0, 0, 0), (1, 1, 1)).to_fixed(np.empty((0, 3))).shape == (0, 3)


def test_to_fixed_refuses_what_is_beyond_2_to_the_30() -> None:
    grid = Grid((8, 8, 8), (0, 0, 0), (1, 1, 1))
    most = FIXED_POINT_LIMIT / UNIT
    assert FIXED_POINT_LIMIT <= 1 << 30
    for sign in (1, -1):
        fixed = grid.to_fixed(np.array([[0, 0, sign * most]]))
        assert fixed.tolist() == [[0, 0, sign * FIXED_POINT_LIMIT]]
    points = np.zeros((5, 3))
    for wrong in (most + 1, -most - 1, 1e300, math.inf, -math.inf, math.nan):
        points[3, 1] = wrong
        with pytest.raises(GridError) as caught:
            grid.to_fixed(points)
        assert str(caught.value) == (
            f"vertex 3 lies more than {FIXED_POINT_LIMIT // UNIT} voxels from the grid's corner: "
            "choose a larger pitch or a nearer box"
        )


@pytest.mark.filterwarnings("error")
def test_extreme_numbers_make_no_noise() -> None:
    small = Grid((8, 8, 8), (0, 0, 0), (1e-95,) * 3)
    with pytest.raises(GridError, match="vertex 0"):
        small.to_fixed(np.array([[1e300, 0, 0]]))
    for far in (1.7e308, 1e91, 5e-324, 1e-91):
        assert "1e±90" in refused(mesh_of([(-far, 0, 0), (far, 0, 0)]))
    Grid.fit(mesh_of([(-4e89, 0, 0), (4e89, 0, 0)]), 65536)
    Grid.fit(mesh_of([(-4e-90, 0, 0), (4e-90, 0, 0)]), 65536)
    for pitch in (1e-320, 1e-300, 1e-9):
        assert "choose at least" in refused(mesh_of(BOX), pitch=pitch)


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3),
    st.lists(st.floats(-100, 100), min_size=3, max_size=3),
)
def test_to_world_and_back(origin, pitch, point) -> None:
    grid = Grid((8, 8, 8), tuple(origin), tuple(pitch))  # pyright: ignore
    world = grid.to_world(np.array([point]))
    unit = np.array(point) * UNIT
    slack = 1 + 1e-9 * (1 + np.abs(unit) + UNIT * np.abs(origin) / np.array(pitch))
    assert (np.abs(grid.to_fixed(world)[0] - unit) <= slack).all()


def test_to_world_of_corners() -> None:
    grid = Grid((20, 9, 5), (1.0, 2.0, 3.0), (0.5, 0.5, 0.25))
    assert grid.to_world(np.array([[0, 0, 0], [20, 9, 5]])).tolist() == [[1, 2, 3], [11, 6.5, 4.25]]
    assert (grid.to_fixed(grid.to_world(np.indices((3, 3, 3)).reshape(3, -1).T)) % UNIT == 0).all()


def test_window_is_the_grid_of_some_of_its_voxels() -> None:
    grid = Grid((20, 16, 12), (1.0, 2.0, 3.0), (0.5, 0.25, 0.125))
    window = grid.window((4, 0, 2), (9, 16, 3))
    assert window == Grid((9, 16, 3), (3.0, 2.0, 3.25), (0.5, 0.25, 0.125))
    assert grid.window((0, 0, 0), grid.shape) == grid
    points = np.random.default_rng(0).uniform(0, 8, (50, 3))
    shift = np.array([4, 0, 2]) * UNIT
    assert np.array_equal(window.to_fixed(points), grid.to_fixed(points) - shift)
    with pytest.raises(GridError, match="must have 8 to 65536"):
        grid.window((0, 0, 0), (4, 4, 4))


# ---- placing it


def test_fit_dim() -> None:
    grid = Grid.fit(mesh_of(BOX), 40)
    assert grid == Grid((40, 40, 40), (-0.5, -0.5, -0.5), (0.125, 0.125, 0.125))
    assert Grid.fit(mesh_of(BOX), 40, margin=0) == Grid((40,) * 3, (0.0,) * 3, (0.1,) * 3)  # pyright: ignore
    assert Grid.fit(mesh_of(BOX)) == Grid.fit(mesh_of(BOX), 256)


@pytest.mark.parametrize(("dim", "margin"), [(8, 1), (15, 1), (16, 2), (31, 3), (32, 4), (999, 4)])
def test_the_default_margin(dim: int, margin: int) -> None:
    grid = Grid.fit(mesh_of(BOX), dim)
    assert grid == Grid.fit(mesh_of(BOX), dim, margin=margin)
    fixed = grid.to_fixed(np.array(BOX))
    assert fixed[0].tolist() == [margin * UNIT] * 3
    assert fixed[1, 0] == (dim - margin) * UNIT


def test_fit_pitch() -> None:
    assert Grid.fit(mesh_of(BOX), pitch=0.125) == Grid(
        (40, 24, 16), (-0.5, -0.5, -0.5), (0.125, 0.125, 0.125)
    )
    assert Grid.fit(mesh_of(BOX), pitch=0.3, margin=1).shape == (16, 9, 6)
    for pitch in (1.0, 4.0, 1000.0):  # few voxels: the longest side is 8
        grid = Grid.fit(mesh_of(BOX), pitch=pitch)
        assert grid.pitch == (pitch,) * 3
        assert grid.dim == MIN_DIM


def test_fit_bbox() -> None:
    box = (-1, -1, -1, 7, 5, 3)
    assert Grid.fit(mesh_of(BOX), 32, bbox=box) == Grid((32, 24, 16), (-1,) * 3, (0.25,) * 3)  # pyright: ignore
    assert Grid.fit(mesh_of(BOX), pitch=0.5, bbox=box) == Grid((16, 12, 8), (-1,) * 3, (0.5,) * 3)  # pyright: ignore
    grid = Grid.fit(mesh_of(BOX), 34, bbox=box, margin=1)
    assert grid == Grid((34, 26, 18), (-1.25,) * 3, (0.25,) * 3)  # pyright: ignore


def test_fit_stretch_is_equation_5_1() -> None:
    points = np.array([(1.0, 2.0, 3.0), (5.0, 4.0, 4.0)])
    for dim in (8, 64, 100):
        grid = Grid.fit(mesh_of(points), dim, fit="stretch")
        assert grid.shape == (dim,) * 3
        low, high = grid.to_fixed(points)
        assert low.tolist() == [4 * UNIT] * 3
        assert high.tolist() == [dim * UNIT] * 3
    flat = Grid.fit(mesh_of([(0, 0, 1), (2, 1, 1)]), 64, fit="stretch")
    assert flat.pitch[2] == flat.pitch[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dim": 64, "pitch": 1.0}, "dim and pitch both set the voxel size: give one of them"),
        ({"dim": 7}, "dim 7 is out of range: choose from 8 to 65536"),
        ({"dim": 65537}, "dim 65537 is out of range"),
        ({"dim": -5}, "dim -5 is out of range"),
        ({"pitch": 0.0}, "pitch 0.0 is not a positive size"),
        ({"pitch": -1.0}, "pitch -1.0 is not a positive size"),
        ({"pitch": math.nan}, "pitch nan is not a positive size"),
        ({"pitch": math.inf}, "pitch inf is not a positive size"),
        ({"margin": -1}, "margin -1 is negative"),
        ({"dim": 8, "margin": 4}, "choose at most 3"),
        ({"dim": 64, "margin": 40}, "choose at most 31"),
        ({"pitch": 0.1, "margin": 40000}, "must have 8 to 65536"),
        ({"fit": "tight"}, "fit 'tight' is neither 'uniform' nor 'stretch'"),
        ({"fit": "stretch", "pitch": 1.0}, "fit 'stretch' goes with dim alone"),
        ({"fit": "stretch", "margin": 1}, "fit 'stretch' goes with dim alone"),
        ({"fit": "stretch", "bbox": (0, 0, 0, 1, 1, 1)}, "fit 'stretch' goes with dim alone"),
        ({"bbox": (0, 0, 0, 1, 1, 0)}, "box 0 0 0 1 1 0 is empty or not finite"),
        ({"bbox": (0, 0, 0, 1, -1, 1)}, "is empty or not finite"),
        ({"bbox": (0, 0, 0, 1, math.nan, 1)}, "is empty or not finite"),
        ({"bbox": (0, 0, 0, 1, math.inf, 1)}, "is empty or not finite"),
    ],
)
def test_what_cannot_be_placed_is_one_line(options, message) -> None:
    assert message in refused(mesh_of(BOX), **options)


def test_the_pitch_that_is_proposed_works() -> None:
    for extent in (1.0, 3.3333, 0.0123456, 98765.4321):
        mesh = mesh_of([(0, 0, 0), (extent, 1e-3, 1e-3)])
        message = refused(mesh, pitch=extent / 1e6)
        pitch = float(message.rsplit(" ", 1)[1])
        assert MAX_DIM * 0.99 < Grid.fit(mesh, pitch=pitch).dim <= MAX_DIM


def test_voxels_finer_than_floating_point_are_refused() -> None:
    far = [(1e15, 0, 0), (1e15 + 1, 1, 1)]
    assert "move the mesh to the origin" in refused(mesh_of(far), 512)
    assert "move the mesh to the origin" in refused(mesh_of(far), pitch=0.01)
    assert "move the mesh to the origin" in refused(mesh_of(far), 512, fit="stretch")
    assert Grid.fit(mesh_of([(1e9, 0, 0), (1e9 + 1, 1, 1)]), 512).dim == 512


COORDINATE = st.floats(-1e4, 1e4, allow_subnormal=False).map(lambda v: round(v, 6))
POINTS = st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), min_size=2, max_size=6)
DIMS = st.one_of(st.integers(MIN_DIM, 40), st.sampled_from([64, 512, 4096, 65535, MAX_DIM]))


def fixed_or_refused(mesh: Mesh, **options) -> tuple[Grid, np.ndarray]:
    try:
        grid = Grid.fit(mesh, **options)
    except GridError as error:
        assume("move the mesh to the origin" not in str(error))
        assume("choose at least" not in str(error))
        raise
    return grid, grid.to_fixed(mesh.vertices)


@given(points=POINTS, dim=DIMS, margin=st.sampled_from([None, 0, 1, 3]))
def test_every_vertex_lies_within_the_margins(points, dim, margin) -> None:
    assume(len(set(points)) > 1)
    mesh = mesh_of(points)
    grid, fixed = fixed_or_refused(mesh, dim=dim, margin=margin)
    least = min(4, dim // 8) if margin is None else margin
    assert grid.shape == (dim,) * 3
    assert len(set(grid.pitch)) == 1
    slack = slack_of(grid, mesh)
    assert fixed.min() >= least * UNIT - slack
    assert fixed.max() <= (dim - least) * UNIT + slack
    longest = (fixed.max(axis=0) - fixed.min(axis=0)).max()
    assert abs(longest - (dim - 2 * least) * UNIT) <= 1 + 2 * slack  # nothing is wasted


@given(points=POINTS, pitch=st.sampled_from([0.25, 1.0, 7.3, 400.0]))
def test_every_vertex_lies_within_the_margins_by_pitch(points, pitch) -> None:
    assume(len(set(points)) > 1)
    mesh = mesh_of(points)
    grid, fixed = fixed_or_refused(mesh, pitch=pitch)
    margins = fixed.min(axis=0) / UNIT
    least = round(float(margins.min()))
    assert 0 <= least <= 4
    slack = slack_of(grid, mesh) + 1  # a side that is whole to 1/512 voxel stays so
    assert (fixed.min(axis=0) >= least * UNIT - slack).all()
    assert (fixed.max(axis=0) <= (np.array(grid.shape) - least) * UNIT + slack).all()


@given(
    points=POINTS,
    pitch=st.tuples(*[st.sampled_from([0.1, 1.0, 7.3, 400.0])] * 3),
    origin=st.tuples(*[st.sampled_from([0.0, -0.3, 1e3])] * 3),
    margin=st.sampled_from([None, 0, 1, 3]),
)
def test_a_lattice_holds_the_mesh_in_its_own_voxels(points, pitch, origin, margin) -> None:
    assume(len(set(points)) > 1)
    mesh, lattice = mesh_of(points), Grid((9, 8, 8), origin, pitch)
    try:
        grid = Grid.fit(mesh, lattice=lattice, margin=margin)
    except GridError as error:
        assume("choose a lattice of larger voxels" not in str(error))
        assume("too small for" not in str(error))
        raise
    assert grid.pitch == lattice.pitch
    nearby = lattice.window(np.rint((grid.origin - np.array(origin)) / pitch), (9, 8, 8))
    common_grid([grid, nearby, grid])  # or GridError
    fixed = grid.to_fixed(mesh.vertices)
    least = margin or 0
    slack = slack_of(grid, mesh)
    assert (fixed >= least * UNIT - slack).all()
    assert (fixed <= (np.array(grid.shape) - least) * UNIT + slack).all()
    used = (
        np.ceil(np.ptp(mesh.vertices, axis=0) / pitch) + 1 + 2 * (4 if margin is None else margin)
    )
    assert (np.array(grid.shape) <= np.maximum(used, 8)).all()  # nothing is wasted
    if margin == 0:  # the voxels do not depend on where the lattice's grid lies
        again = Grid.fit(mesh, lattice=lattice.window((5, -7, 11), (8, 8, 8)), margin=0)
        assert not common_grid([again, grid])[1].any()


@given(points=POINTS, dim=DIMS)
def test_stretch_fills_every_axis(points, dim) -> None:
    assume(len(set(points)) > 1)
    mesh = mesh_of(points)
    grid, fixed = fixed_or_refused(mesh, dim=dim, fit="stretch")
    slack = slack_of(grid, mesh)
    assert (np.abs(fixed.min(axis=0) - 4 * UNIT) <= slack).all()
    flat = np.ptp(mesh.vertices, axis=0) == 0
    assert (np.abs(fixed.max(axis=0) - np.where(flat, 4, dim) * UNIT) <= slack).all()


def slack_of(grid: Grid, mesh: Mesh) -> int:
    """Units that rounding in floating point may cost: none in a mesh near the origin."""
    farthest = np.abs(mesh.vertices).max() + max(grid.pitch) * 4
    return math.ceil(4 * UNIT * np.spacing(farthest) / min(grid.pitch) - 0.5)


def test_finer_grids_have_smaller_voxels() -> None:
    pitches = [Grid.fit(mesh_of(BOX), dim).pitch[0] for dim in (8, 16, 64, 1024, MAX_DIM)]
    assert all(a > b for a, b in pairwise(pitches))


def test_numbers_of_many_digits_are_short_in_messages() -> None:
    with pytest.raises(GridError, match=r"grid of 1e300 x -1e300 x 7 voxels") as caught:
        Grid((10**300, -(10**300), 7), (0, 0, 0), (1, 1, 1))
    assert len(str(caught.value)) < 120
