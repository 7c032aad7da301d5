"""Transfer functions: what they say, how segments are cut at their points, and what they hide."""

from __future__ import annotations

import itertools
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.tets import SIX, boxes, grid_corners, grid_points, tet_mesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from voxtool.errors import VoxtoolError
from voxtool.opencl import Device
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.maps import MAPS
from voxtool.tets.pictures.transfer import (
    DEFAULT_MAP,
    MOST_POINTS,
    LocalTransfer,
    TransferFunction,
    cell_sizes,
    default_transfer,
    named,
    scalars_at,
)

FIGURE_28 = (0.25, 0.5, 0.75)


def volume(low: float = 0.0, high: float = 1.0, scale: float = 1.0) -> Any:
    """The attributes of a volume that a transfer function reads; its cells are equally large."""
    corners = np.array([[0, 0, 0], [4, 2, 1]]) * scale
    vertices = np.linspace((0, 0, 0, 0), (0, 0, 0, 1), 101, dtype=np.float32)
    vertices[:100, :3] = np.tile(np.eye(4, 3, -1), (25, 1))
    return SimpleNamespace(
        scalar_range=(low, high), scale=scale, bounds=lambda: corners, constant=False,
        vertices=vertices, cells=np.arange(100).reshape(-1, 4),
    )  # fmt: skip


def function(scalars, extinctions=None, seed: int = 0) -> TransferFunction:
    random = np.random.default_rng(seed)
    count = len(scalars)
    taus = random.uniform(0, 9, count) if extinctions is None else extinctions
    return TransferFunction(scalars, random.random((count, 3)), taus)


def held(local: LocalTransfer, scalars: np.ndarray) -> np.ndarray:
    """(N, 4) float32: what the rows say of scalars, as kernels read them."""
    row = local.rows[np.searchsorted(local.points, scalars, side="right")]
    w = np.clip((scalars - row[:, 0]) * row[:, 1], 0, 1)
    return row[:, 2:6] + row[:, 6:10] * w[:, None]


# ---- what a function says


def test_it_is_linear_between_points_and_constant_beyond() -> None:
    f = TransferFunction([1, 3], [[0, 0, 1], [1, 0.5, 0]], [2, 6])  # pyright: ignore
    colours, extinctions = f.evaluate(np.array([-9, 1, 1.5, 3, 99]))
    assert extinctions.tolist() == [2, 2, 3, 6, 6]
    assert colours[2].tolist() == [0.25, 0.125, 0.75]
    assert colours[[0, 4]].tolist() == [[0, 0, 1], [1, 0.5, 0]]


def test_at_a_step_the_later_point_holds() -> None:
    f = function([0, 1, 1, 2], [0, 1, 5, 6])
    assert f.evaluate(np.array([np.nextafter(1, 0), 1, 1.5]))[1] == pytest.approx([1, 5, 5.5])
    local = f.local(volume(0, 2))
    below, at = held(local, np.array([0.5 - 2**-25, 0.5], np.float32))[:, 3]
    assert below == pytest.approx(1)
    assert at == 5


@pytest.mark.parametrize(
    ("scalars", "colours", "extinctions", "says"),
    [
        ([], np.zeros((0, 3)), [], "of 0 points"),
        (range(MOST_POINTS + 1), np.zeros((MOST_POINTS + 1, 3)), range(MOST_POINTS + 1), "of 256"),
        ([0, 2, 1], np.zeros((3, 3)), [1] * 3, "point 3: its scalar is less"),
        ([0, 1, 1, 1], np.zeros((4, 3)), [1] * 4, "point 4: the two before it"),
        ([0, np.nan], np.zeros((2, 3)), [1, 1], "point 2: scalar nan"),
        ([0, 1e308], np.zeros((2, 3)), [1, 1], "point 2: scalar 1e[+]308"),
        ([0], [[0, 1.5, 0]], [1], "point 1: colour .*1.5.* from 0 to 1"),
        ([0], [[0, np.nan, 0]], [1], "point 1: colour"),
        ([0, 1], np.zeros((2, 3)), [1, -1], "point 2: extinction -1.0 is not 0 or more"),
        ([0], np.zeros((1, 3)), [np.inf], "point 1: extinction inf"),
        ([0], np.zeros((1, 4)), [1], "three numbers"),
        ([0, 1], np.zeros((2, 3)), [1], "an extinction"),
        (["red"], np.zeros((1, 3)), [1], "scalars are not numbers"),
        ([10**400], np.zeros((1, 3)), [1], "scalars are not numbers"),
        (0.5, np.zeros((1, 3)), [1], "give each point"),
    ],
)
def test_what_is_no_transfer_function_is_refused(scalars, colours, extinctions, says: str) -> None:
    with pytest.raises(VoxtoolError, match=says) as error:
        TransferFunction(scalars, colours, extinctions)
    assert "\n" not in str(error.value)


def test_its_points_are_copies() -> None:
    scalars = np.array([0.0, 1.0])
    f = function(scalars)
    scalars[0] = 5
    assert f.scalars.tolist() == [0, 1]


# ---- JSON


def test_json_brings_back_every_bit() -> None:
    f = function(np.sort(np.random.default_rng(1).normal(size=9)) * 1e-7)
    again = TransferFunction.from_json(f.to_json())
    for name in ("scalars", "colours", "extinctions"):
        assert np.array_equal(getattr(again, name), getattr(f, name))


POINT = {"scalar": 0.2, "color": [1, 0.5, 0], "extinction": 3.5}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "no JSON"),
        ("[" * 100_000, "no JSON"),
        ("[]", "and nothing else"),
        ({"points": [POINT], "name": "x"}, "and nothing else"),
        ({"points": []}, "of 0 points"),
        ({"points": [POINT, 7]}, "point 2: an object"),
        ({"points": [{"scalar": 1, "color": [0, 0, 0]}]}, "point 1: it has no extinction"),
        ({"points": [POINT, {**POINT, "opacity": 1}]}, "point 2: 'opacity' is unknown"),
        ({"points": [POINT, {**POINT, "a\nb": 1}]}, "point 2: 'a.b' is unknown"),
        ({"points": [{**POINT, "color": "red"}]}, "point 1: its color"),
        ({"points": [{**POINT, "color": [1, 0]}]}, "point 1: its color"),
        ({"points": [{**POINT, "color": [1, 0, True]}]}, "point 1: its color"),
        ({"points": [{**POINT, "scalar": "0"}]}, "point 1: its scalar is not a number"),
        ({"points": [{**POINT, "extinction": None}]}, "point 1: its extinction is not a number"),
        ({"points": [{**POINT, "scalar": float("nan")}]}, "point 1: scalar nan"),
        ({"points": [{**POINT, "scalar": 10**400}]}, "scalars are not numbers"),
    ],
)
def test_json_that_holds_none_is_refused(text: Any, says: str) -> None:
    with pytest.raises(VoxtoolError, match=says) as error:
        TransferFunction.from_json(text if isinstance(text, str) else json.dumps(text))
    assert "\n" not in str(error.value)


# ---- named maps


@pytest.mark.parametrize("name", MAPS)
def test_a_map_goes_over_the_range_and_its_ramp_over_its_own(name: str) -> None:
    f = named(name, 10, 20, 4, (12, 21))
    colours, extinctions = f.evaluate(np.array([9, 10, 12, 16.5, 20, 21, 30]))
    words = MAPS[name].split()
    for at, word in ((1, words[0]), (4, words[-1])):
        assert (255 * colours[at]).round().astype(int).tolist() == list(bytes.fromhex(word))
    assert extinctions == pytest.approx([0, 0, 0, 0.125, 0.25 * 8 / 9, 0.25, 0.25])


def test_a_ramp_may_fall_or_be_a_step() -> None:
    at = np.array([0.0, 0.29, 0.3, 0.4, 0.6, 0.7, 1.0])
    falling = named("gray", 0, 1, 0.5, (0.7, 0.3)).evaluate(at)[1]
    assert falling == pytest.approx([2, 2, 2, 1.5, 0.5, 0, 0])
    step = named("gray", 0, 1, 0.5, (0.3, 0.3)).evaluate(at)[1]
    assert step.tolist() == [0, 0, 2, 2, 2, 2, 2]


@pytest.mark.parametrize(
    "how",
    [("grey", 0, 1, 1), ("gray", 1, 0, 1), ("gray", 0, 1, 0), ("gray", 0, 1, np.nan),
     ("gray", 0, np.inf, 1), ("gray", 0, 1, 1, (0, np.nan)), ("gray", -1e308, 1e308, 1),
     ("gray", 0, 1, 1e-320)],
)  # fmt: skip
def test_what_makes_no_map_is_refused(how) -> None:
    with pytest.raises(VoxtoolError):
        named(*how)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_default_shows_something_of_any_mesh(scale: float) -> None:
    """At full extinction the longest side takes much of the light; at the least, none."""
    f = default_transfer(volume(-3, 5, scale))
    tau = f.evaluate(np.array([-3, 5]))[1]
    assert tau[0] == 0
    assert 0.9 < 1 - np.exp(-tau[1] * 4 * scale) <= 1
    assert f.evaluate(np.array([-3.0]))[0][0] * 255 == pytest.approx(
        list(bytes.fromhex(MAPS[DEFAULT_MAP].split()[0]))
    )


def test_the_default_hides_what_three_quarters_of_the_volume_have() -> None:
    usual = default_transfer(volume(0, 100)).evaluate(np.array([70, 74, 99, 100]))[1]
    assert usual[:2].tolist() == [0, 0]
    assert usual[2] == pytest.approx(usual[3]) != 0
    full = default_transfer(volume(0, 100), opacity_range="full").evaluate(np.array([50, 100]))[1]
    assert full[0] == pytest.approx(full[1] / 2)
    with pytest.raises(VoxtoolError, match="give two scalars, or 'full'"):
        default_transfer(volume(), opacity_range="all")
    for text in ("101%", "-1%", "75", "x%", "nan%"):
        with pytest.raises(VoxtoolError, match="is no percentile: write 75%"):
            default_transfer(volume(), opacity_range=(text, 1.0))


def test_percentiles_are_by_volume(device: Device) -> None:
    """The scalar is x over the unit cube: a percentile is itself, however the cells are graded."""
    shape = (24, 2, 2)
    points = grid_points(shape) / np.array(shape)
    points[:, 0] **= 3  # half of the vertices are in an eighth of the cube
    cells = grid_corners(shape)[:, SIX].reshape(-1, 4)
    found = build_tet(tet_mesh(points, cells, points[:, 0]), device=device)
    at = scalars_at(found, ("0%", "25%", "50%", 0.3, "99%", "100%"))
    assert at == pytest.approx((0, 0.25, 0.5, 0.3, 0.99, 1), abs=0.07)
    assert float(cell_sizes(found).sum()) * found.scale**3 == pytest.approx(1)
    boxes_, _ = boxes(grid_points((3, 1, 1)), (3, 1, 1), np.array([5.0, 7.0, 6.0]))
    whole = build_tet(boxes_, "hexahedra", device=device)
    assert cell_sizes(whole) * whole.scale**3 == pytest.approx(np.ones(3))
    assert scalars_at(whole, ("30%", "60%", "90%")) == (5, 6, 7)


@pytest.mark.parametrize("high", [2.0, np.nextafter(2, 3)])
def test_the_default_of_a_field_that_hardly_varies_is_seen(high: float) -> None:
    local = default_transfer(volume(2, high)).local(volume(2, high))
    assert held(local, np.array([high > 2], np.float32))[0, 3] > 0


# ---- on the device's terms

scalar = st.floats(-3, 3, width=32)


@st.composite
def functions(draw) -> TransferFunction:
    """Functions of up to eight points; steps and near neighbours are frequent."""
    some = draw(
        st.lists(scalar | st.sampled_from([0.0, 0.5, 1.0, 1.0 + 1e-9]), min_size=1, max_size=8)
    )
    kept = [s for s, group in itertools.groupby(sorted(some)) for _ in range(min(2, len([*group])))]
    taus = draw(st.lists(st.sampled_from([0.0, 0.0, 1.0, 4.0]), min_size=8, max_size=8))
    return function(kept, taus[: len(kept)], draw(st.integers(0, 99)))


@given(functions())
@settings(max_examples=150)
def test_rows_say_what_the_function_says(f: TransferFunction) -> None:
    where = volume(-1, 2, 8.0)
    local = f.local(where)
    s = np.linspace(0, 1, 97, dtype=np.float32)
    colours, extinctions = f.evaluate(-1 + 3 * s.astype(np.float64))
    wanted = np.column_stack([colours, 8 * extinctions])
    far = np.abs(local.points[:, None] - s).min(axis=0) > 1e-6  # steps are rounded
    assert np.abs(held(local, s) - wanted)[far].max(initial=0) < 1e-3
    assert ((local.points >= 0) & (local.points <= 1)).all()
    assert (np.diff(local.points) >= 0).all()
    assert (held(local, s) >= 0).all()
    assert (held(local, s)[:, :3] <= 1).all()


def test_rows_are_to_rounding_where_points_are_far_beyond_the_range() -> None:
    f = function([-1e9, 0.5, 1e12], [1e9, 1e-3, 0])
    s = np.linspace(0, 1, 33, dtype=np.float32)
    wanted = f.evaluate(s)[1]
    assert np.abs(held(f.local(volume()), s)[:, 3] - wanted).max() < 2e-7 * wanted.max()


@pytest.mark.parametrize(
    "scalars", [[0.5], [2.0], [-1.0], [0.5, 0.5], [-1, 0, 0.5, 3], [0.5, 1, 2]]
)
def test_a_constant_field_has_what_its_scalar_has(scalars) -> None:
    f = function(scalars)
    local = f.local(volume(0.5, 0.5))
    wanted = f.evaluate(np.array([0.5]))
    assert held(local, np.zeros(1, np.float32))[0] == pytest.approx(np.append(*wanted))


def test_a_constant_interval_stays_constant() -> None:
    f = TransferFunction([0.1, 0.9], [[0.1, 0.7, 0.3]] * 2, [0.3, 0.3])  # pyright: ignore
    found = held(f.local(volume()), np.linspace(0, 1, 100, dtype=np.float32))
    assert (found == np.array([0.1, 0.7, 0.3, 0.3], np.float32)).all()


def test_points_that_float32_cannot_tell_apart_make_a_step() -> None:
    local = function([0.5, 0.5 + 1e-12, 0.5 + 2e-12, 0.5 + 2e-12], [1, 2, 3, 4]).local(volume())
    assert np.isfinite(local.rows).all()
    below, at = held(local, np.array([0.4, 0.5], np.float32))[:, 3]
    assert (below, at) == (1, 4)


def test_the_same_function_on_a_larger_mesh_has_the_same_points() -> None:
    f = function(FIGURE_28)
    small, large = f.local(volume(scale=1.0)), f.local(volume(scale=64.0))
    assert np.array_equal(small.points, large.points)
    assert np.array_equal(64 * small.rows[:, [5, 9]], large.rows[:, [5, 9]])


@pytest.mark.parametrize("scale", [1e20, 1e300])
def test_an_extinction_beyond_float32_is_refused(scale: float) -> None:
    with pytest.raises(VoxtoolError, match=r"point 2: extinction 1e\+15 .* choose a smaller one"):
        function([0, 1], [1, 1e15]).local(volume(scale=scale))


# ---- cutting [TetVol, section 4.2]


def crossings(count: int) -> np.ndarray:
    """The control points that a ray crosses first and next, or -1, for each pair of intervals of
    s_f and s_b: (count + 1, count + 1, 2), the texture of [TetVol, figure 28]."""
    front, back = np.indices((count + 1, count + 1))
    up, down = back > front, back < front
    first = np.where(up, front, np.where(down, front - 1, -1))
    following = np.where(up, front + 1, np.where(down, front - 2, -1))
    return np.stack([first, np.where(following >= count, -1, following).clip(-1)], -1)


def test_figure_28() -> None:
    table = crossings(len(FIGURE_28))

    def texture(s_f: float, s_b: float) -> list[float]:
        i, j = np.searchsorted(FIGURE_28, [s_f, s_b], side="right")
        return [FIGURE_28[k] if k >= 0 else -1 for k in table[i, j]]

    assert texture(0.9, 0.3) == [0.75, 0.5]
    assert texture(0.75, 0.3) == [0.75, 0.5]
    assert texture(0.5, 0.3) == [0.5, 0.25]
    assert texture(0.1, 0.9) == [0.25, 0.5]
    assert texture(0.6, 0.9) == [0.75, -1]
    assert texture(0.3, 0.1) == [0.25, -1]
    assert texture(0.3, 0.4) == [-1, -1]
    assert (np.diagonal(table) == -1).all()


def listing(local: LocalTransfer, s_f: float, s_b: float) -> list[float]:
    """The ends of the pieces of a segment, by the listing of [TetVol]; all points differ."""
    ends, table = [], crossings(len(local.points))
    while True:
        i, j = np.searchsorted(local.points, [s_f, s_b], side="right")
        s_iso, following = (float(local.points[k]) if k >= 0 else -1.0 for k in table[i, j])
        end = s_b
        if s_iso >= 0:
            if s_f == s_iso:
                s_iso = following
            if abs(s_b - s_f) > abs(s_iso - s_f):
                end = s_iso
        ends.append(end)
        if end == s_b:
            return ends
        s_f = end


CUT = """
__kernel void cut_once(__global const float *points, __global const float *rows, const int count,
                       __global const float *from, __global const float *to,
                       __global const int *interval, __global float *ends, __global int *owns,
                       __global int *follows, __global int *cuts)
{
    const size_t i = get_global_id(0) * LANES;
    const Transfer transfer = {points, rows, count};
    const floats end_at = load(to + i);
    const Segment segment = {load(from + i), end_at, load(interval + i),
                             interval_of(&transfer, end_at)};
    floats end;
    ints own, next;
    const ints is_cut = cut(&transfer, &segment, &end, &own, &next);
    store(end, ends + i);
    store(own, owns + i);
    store(next, follows + i);
    store(is_cut ? (ints)1 : (ints)0, cuts + i);
}
"""
SOURCE = '#include "tets/pictures/transfer.h"\n' + CUT


def pieces(
    device: Device, local: LocalTransfer, s_f, s_b, lanes: int
) -> list[list[tuple[float, float, int]]]:
    """The pieces of each of 16 n segments, in order: both ends and the interval."""
    count, points = len(s_f), len(local.points)
    s_f, s_b = np.asarray(s_f, np.float32), np.asarray(s_b, np.float32)
    interval = np.searchsorted(local.points, s_f, side="right").astype(np.int32)
    found: list[list[tuple[float, float, int]]] = [[] for _ in range(count)]
    going = np.ones(count, bool)
    kernel = device.kernel(SOURCE, "cut_once", LANES=lanes)
    while going.any():
        out = [device.empty(count, t) for t in (np.float32, np.int32, np.int32, np.int32)]
        kernel(
            count // lanes,
            device.put(local.points),
            device.put(local.rows),
            np.int32(points),
            *(device.put(v) for v in (s_f, s_b, interval)),
            *out,
            local=1,
        )
        ends, owns, follows, cuts = (array.get() for array in out)
        for i in np.flatnonzero(going):
            found[i].append((float(s_f[i]), float(ends[i]), int(owns[i])))
            assert len(found[i]) <= points + 1
        going &= cuts == 1
        s_f, interval = np.where(going, ends, s_f), np.where(going, follows, interval)
    return found


@pytest.mark.parametrize("lanes", [1, 16])
def test_the_worked_example(device: Device, lanes: int) -> None:
    """ "O raio deve ser integrado entre 0,9 e 0,75 ... 0,75 e 0,5 ... 0,5 e 0,3.\""""
    local = function(FIGURE_28).local(volume())
    start, end = float(np.float32(0.9)), float(np.float32(0.3))
    assert listing(local, start, end) == [0.75, 0.5, end]
    found = pieces(device, local, [0.9] * 16, [0.3] * 16, lanes)[7]
    assert found == [(start, 0.75, 3), (0.75, 0.5, 2), (0.5, end, 1)]


@pytest.mark.parametrize("lanes", [1, 16])
@given(
    st.lists(st.sampled_from(np.linspace(0, 1, 11).tolist()), min_size=1, max_size=8, unique=True),
    st.lists(st.sampled_from(np.linspace(0, 1, 21).tolist()), min_size=32, max_size=32),
)
@settings(max_examples=40)
def test_segments_are_cut_as_the_listing_says(device: Device, lanes: int, at, ends) -> None:
    local = function(sorted(at)).local(volume())
    s_f, s_b = np.array(ends, np.float32).reshape(2, 16)
    for found, front, back in zip(pieces(device, local, s_f, s_b, lanes), s_f, s_b, strict=True):
        assert [end for _, end, _ in found] == listing(local, float(front), float(back))


@pytest.mark.parametrize("lanes", [1, 16])
@given(functions(), st.lists(st.floats(0, 1, width=32), min_size=32, max_size=32), st.data())
@settings(max_examples=40)
@example(function([0.5, 0.5]), [0.5] * 16 + [0.0] * 8 + [1.0] * 8, None)
def test_pieces_follow_on_each_other_within_one_interval_each(
    device: Device, lanes: int, f: TransferFunction, ends, data
) -> None:
    local = f.local(volume(-1, 2))
    s_f, s_b = np.array(ends, np.float32).reshape(2, 16)
    if data is not None:
        s_f[:4] = data.draw(st.sampled_from(local.points.tolist()))
        s_b[2:6] = data.draw(st.sampled_from(local.points.tolist()))
    bounds = np.concatenate([[-np.inf], local.points, [np.inf]])
    for found, front, back in zip(pieces(device, local, s_f, s_b, lanes), s_f, s_b, strict=True):
        chain = [found[0][0], *(end for _, end, _ in found)]
        assert chain[0] == front
        assert chain[-1] == back
        assert [start for start, _, _ in found] == chain[:-1]
        assert chain == sorted(chain, reverse=bool(back < front))
        for start, end, interval in found:
            assert bounds[interval] <= min(start, end)
            assert max(start, end) <= bounds[interval + 1]


# ---- what is hidden


@given(functions(), scalar, scalar)
@settings(max_examples=400)
@example(function([0, 1], [0, 1]), -3.0, 0.0)
@example(function([0, 1], [1, 0]), 1.0, 3.0)
@example(function([0, 0, 1], [1, 0, 0]), 0.0, 1.0)
@example(function([0, 0, 1], [0, 1, 0]), -1.0, 0.0)
@example(function([0, 1], [0, 0]), -3.0, 3.0)
def test_transparent_is_where_extinction_is_nothing(f: TransferFunction, one, other) -> None:
    """It is linear between points: both sides of each, and the range's ends, say it all."""
    local = f.local(volume(-1, 2))
    low, high = sorted(np.clip((np.array([one, other], np.float32) + 1) / 3, 0, 1))
    inner = local.points[(local.points > low) & (local.points <= high)]
    within = [low, high, *inner, *np.nextafter(inner, np.float32(-1))]
    wanted = not held(local, np.array(within, np.float32))[:, 3].any()
    assert local.transparent(np.array([low]), np.array([high])).tolist() == [wanted]


def test_transparent_of_many_ranges() -> None:
    local = function([0.25, 0.5, 0.5, 0.75], [0, 0, 2, 0]).local(volume())
    low = np.array([0, 0.25, 0.3, 0.3, 0.5, 0.6, 0.75, 0.8], np.float32)
    high = np.array([0.2, 0.25, 0.49, 0.5, 0.5, 0.7, 1.0, 0.9], np.float32)
    hidden = np.array([1, 1, 1, 0, 0, 0, 1, 1], bool)
    assert np.array_equal(local.transparent(low, high), hidden)
