"""Queries on the device against DistanceField.query, the oracle in numpy: equal bit for bit."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers_field import cells_of, plain_field, point, sphere
from hypothesis import given
from hypothesis import strategies as st

from voxtool.adf.cells import key_of
from voxtool.adf.field import DistanceField, assemble
from voxtool.adf.host_query import CHUNK, POINT_BITS, QueryResult, to_fixed
from voxtool.adf.query import (
    BLOCK,
    GPU,
    GPU_COHERENT,
    HOST_POINTS,
    SEARCHES,
    FieldQuery,
    inverses,
    levels_to_search,
    query_adf,
)
from voxtool.adf.spatial_hash import SpatialHash
from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from voxtool.opencl import Device

EVERYTHING = {"gradient": True, "bounds": True, "cell": True}
ORIGIN, SIDE = (-3.7, 0.1, 12.0), 2.3


def equal(found: QueryResult, expected: QueryResult) -> None:
    for name, array in vars(expected).items():
        other = getattr(found, name)
        if array is None:
            assert other is None, name
        else:
            assert other.dtype == array.dtype, name
            assert np.array_equal(other, array, equal_nan=array.dtype.kind == "f"), name


def on_device(field: DistanceField, device: Device, **options: Any) -> FieldQuery:
    """Queries that the host answers none of."""
    return FieldQuery(field, device, host_points=0, **options)


def spike(p: np.ndarray) -> np.ndarray:
    """As far from linear in a cell of any size: refined to any level, in a few cells of each."""
    return np.log2(point(p) + 1e-12)


def points_of(field: DistanceField, n: int = 3000, seed: int = 1) -> np.ndarray:
    """Random points in the cube and about it, and in deep cells; faces and vertices of cells; the
    cube's corners; NaN, infinite and huge ones."""
    random = np.random.default_rng(seed)
    levels, cells = cells_of(field)
    chosen = random.integers(0, len(cells), n)
    edge = 0.5 ** levels[chosen][:, None]
    in_cells = (cells[chosen] + random.random((n, 3))) * edge
    on_faces = (cells[chosen] + random.integers(0, 3, (n, 3)) / 2) * edge
    corners = np.indices((2, 2, 2)).reshape(3, 8).T.astype(float)
    unit = [
        random.random((n, 3)), random.uniform(-0.3, 1.3, (n // 4, 3)), in_cells, on_faces, corners,
        np.nextafter(corners, -1), np.nextafter(corners, 2),
    ]  # fmt: skip
    odd = [
        (math.nan, 0, 0), (0, math.nan, math.inf), (math.inf, 0, 0), (-math.inf,) * 3,
        (1e308, -1e308, 0), (1e300, 0, 13), (5e-324, -5e-324, 12.5), (-0.0, 0.1, 12),
    ]  # fmt: skip
    world = np.concatenate(unit) * field.side + np.array(field.origin)
    return np.concatenate([world, np.array(odd, float)])


@pytest.fixture(scope="module")
def balls() -> DistanceField:
    """Leaves of levels 2 to 7."""

    def function(p: np.ndarray) -> np.ndarray:
        small = np.sqrt(((p - (0.1, 0.15, 0.9)) ** 2).sum(axis=1)) - 0.02
        return np.minimum(sphere(p), small)

    return plain_field(function, 2e-3, 7, origin=ORIGIN, side=SIDE)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("asked", [{}, *({name: True} for name in EVERYTHING), EVERYTHING])
def test_answers_are_the_oracles(device, balls, search, asked) -> None:
    points = points_of(balls)
    equal(on_device(balls, device)(points, search=search, **asked), balls.query(points, **asked))


@pytest.mark.parametrize("search", SEARCHES)
def test_other_shapes_of_the_work_give_the_same(device, balls, search) -> None:
    """As a GPU is given it."""
    shape = GPU_COHERENT if search == "coherent" else GPU
    points = points_of(balls, 300)
    found = on_device(balls, device, shape=shape)(points, search=search, **EVERYTHING)
    equal(found, balls.query(points, **EVERYTHING))


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("max_level", [11, 12, 14, 21])
def test_deep_fields(device, search, max_level) -> None:
    """Identifiers have 64 bits from leaves of level 12 on."""
    field = plain_field(spike, 0.2, max_level, origin=ORIGIN, side=SIDE)
    assert field.depth == max_level
    assert field.cells.shape[-1] == (3 if max_level > 11 else 2)
    points = points_of(field)
    found = on_device(field, device)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))
    assert found.level is not None
    assert found.level.max() == max_level


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("deep", [False, True])
def test_a_hash_with_w(device, balls, search, deep) -> None:
    field = with_w(plain_field(spike, 0.2, 14) if deep else balls)
    points = points_of(field)
    found = on_device(field, device)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("w", [False, True])
@pytest.mark.slow
def test_offsets_of_16_bits(device, search, w) -> None:
    field = with_w(plain_field(sphere, 1e-2, 5), m=300 if w else 299, w=w)
    assert field.hash.offsets.dtype == np.uint16
    points = points_of(field)
    found = on_device(field, device)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))


def with_w(field: DistanceField, m: int = 101, *, w: bool = True) -> DistanceField:
    """The same field with a hash that is sparse, so that random offsets, and w, do."""
    random = np.random.default_rng(3)
    levels, cells = cells_of(field)
    keys, r = key_of(levels, cells), 37
    table = np.zeros((r, r, r, 4 if w else 3), np.uint8 if m < 256 else np.uint16)
    table[..., 3:] = m
    place = keys % r
    taken: set[tuple[int, ...]] = set()
    for bucket in np.unique(place, axis=0):
        own = keys[(place == bucket).all(axis=1)]
        while True:
            offset = random.integers(0, m, 3)
            modulus = int(random.integers(m // 2, m + 1)) if w else m
            slots = {tuple(s) for s in ((own % modulus + offset) % m).tolist()}
            if len(slots) == len(own) and not slots & taken:
                break
        taken |= slots
        x, y, z = bucket
        table[z, y, x] = [*offset, modulus][: table.shape[-1]]
    hash = SpatialHash(m, r, table)
    head = {
        name: getattr(field, name)
        for name in ("origin", "side", "sign", "tolerance", "max_level", "band", "continuous",
                     "lipschitz")
    }  # fmt: skip
    made = assemble(field.blocks, field.voxels, field.bounds, hash, **head)
    made.validate()
    return made


@pytest.mark.parametrize("search", SEARCHES)
def test_a_root_alone(device, search) -> None:
    field = plain_field(sphere, 10.0, 3)
    assert levels_to_search(field) == (0, 0)
    points = points_of(field, 100)
    found = on_device(field, device)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))


@pytest.mark.parametrize("search", SEARCHES)
def test_a_full_octree(device, search) -> None:
    field = plain_field(lambda p: np.sin(40 * p).sum(axis=1), 1e-9, 3)
    assert levels_to_search(field) == (2, 2)
    points = points_of(field, 100)
    found = on_device(field, device)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))


def test_levels_to_search(balls) -> None:
    leaves = balls.leaves_by_level()
    full, deepest = levels_to_search(balls)
    assert deepest == len(leaves) - 1
    assert not any(leaves[:full])
    assert leaves[full]
    assert full < deepest - 2


@pytest.mark.parametrize("search", SEARCHES)
def test_order_changes_nothing(device, balls, search) -> None:
    """Points that jump between the coarsest and the deepest cells, and those along a line."""
    levels, cells = cells_of(balls)
    deep = (cells[levels == levels.max()] + 0.3) / 2.0 ** levels.max()
    coarse = np.random.default_rng(2).uniform(0.85, 1, (len(deep), 3))
    mixed = np.stack([deep, coarse], axis=1).reshape(-1, 3)
    line = np.linspace(0, 1, 5000)[:, None] * (0.9, 0.6, 0.5) + (0.05, 0.2, 0.25)
    for unit in (mixed, mixed[::-1], line):
        points = unit * SIDE + np.array(ORIGIN)
        equal(
            on_device(balls, device)(points, search=search, cell=True),
            balls.query(points, cell=True),
        )


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, CHUNK - 1, CHUNK + 1])
def test_any_number_of_points(device, balls, n) -> None:
    query = on_device(balls, device)
    points = np.random.default_rng(n).random((n, 3)) * SIDE + np.array(ORIGIN)
    for search in SEARCHES:
        for asked in ({}, EVERYTHING):
            equal(query(points, search=search, **asked), balls.query(points, **asked))


def test_blocks(device, balls) -> None:
    """Blocks are in their places, those with points outside between others without."""
    points = np.random.default_rng(4).random((7777, 3))
    points[2500:2600] += 1
    points[7000] = math.nan
    points = points * SIDE + np.array(ORIGIN)
    found = on_device(balls, device, block=1000)(points, **EVERYTHING)
    equal(found, balls.query(points, **EVERYTHING))


def test_more_points_than_a_block_has(device, balls) -> None:
    points = np.random.default_rng(5).random((2 * BLOCK + 17, 3)) * SIDE + np.array(ORIGIN)
    query = on_device(balls, device)
    found = query(points)
    equal(query(points, search="coherent"), found)
    for part in (slice(0, 999), slice(BLOCK - 500, BLOCK + 500), slice(2 * BLOCK - 500, None)):
        assert np.array_equal(found.distance[part], balls.query(points[part]).distance)


def test_without_bounds(device) -> None:
    field = plain_field(sphere, 1e-2, 5, bounds=False, origin=ORIGIN, side=SIDE)
    points = points_of(field)
    asked = {"gradient": True, "cell": True}
    equal(on_device(field, device)(points, **asked), field.query(points, **asked))
    with pytest.raises(VoxtoolError, match="no bounds"):
        on_device(field, device)(points, bounds=True)


@pytest.mark.parametrize("outside", ["some", "all"])
def test_outside_the_distance_is_a_lower_bound(device, balls, outside) -> None:
    random = np.random.default_rng(6)
    unit = random.uniform(-2, 3, (4000, 3))
    if outside == "all":
        unit = unit[((unit < 0) | (unit > 1)).any(axis=1)]
    points = unit * SIDE + np.array(ORIGIN)
    answer = on_device(balls, device)(points, **EVERYTHING)
    assert answer.outside.all() == (outside == "all")
    far = answer.outside
    assert np.array_equal(far, ((points < ORIGIN) | ((points - ORIGIN) / SIDE > 1)).any(axis=1))
    exact = SIDE * np.minimum(
        sphere(unit), np.sqrt(((unit - (0.1, 0.15, 0.9)) ** 2).sum(axis=1)) - 0.02
    )
    assert (answer.distance[far] >= 0).all()
    assert (answer.distance[far] <= exact[far] + 1e-2 * SIDE).all()
    assert answer.bound is not None
    assert np.isinf(answer.bound[far]).all()


@pytest.mark.parametrize("exponent", [-300, -20, 0, 20, 300])
def test_points_are_rounded_down_to_the_lattice(exponent: int) -> None:
    """In blocks, of which some have no point outside."""
    random = np.random.default_rng(7)
    side = math.ldexp(1.37, exponent)
    origin = random.uniform(-2, 2, 3) * side
    field = replace(plain_field(sphere, 0.1, 2), origin=tuple(origin.tolist()), side=side)
    points = random.uniform(-0.1, 1.1, (5000, 3)) * side + origin
    points[:CHUNK] = np.clip(points[:CHUNK], origin, origin + side)
    points[-4:] = [(math.inf, 0, 0), (0, -math.inf, 0), (math.nan, 0, 0), (1e308,) * 3]
    fixed, outside = np.empty((5000, 3), np.uint32), np.zeros(5000, bool)
    to_fixed(field, points, fixed, outside)
    with np.errstate(over="ignore"):
        u = (points - origin) / side
        within = np.fmin(np.fmax(u, 0) * 2.0**POINT_BITS, 2.0**POINT_BITS - 1)
    assert np.array_equal(fixed, np.floor(within).astype(np.uint32))
    assert np.array_equal(outside, ~((u >= 0) & (u <= 1)).all(axis=1))
    assert 0 < np.count_nonzero(outside) < 1000


@given(st.integers(1, (1 << 21) - 1), st.integers(1, (1 << 21) - 1))
def test_remainders_are_exact(key: int, n: int) -> None:
    """Those of query.cl, in float32, for the keys that are hardest for a divisor."""
    for hard in {key, key - key % n, max(key - key % n - 1, 0), ((1 << 21) - 1) // n * n - 1}:
        if hard >= 0:
            assert remainders(np.array([hard]), n)[0] == hard % n


def test_remainders_of_every_divisor_that_a_table_has() -> None:
    for n in range(1, 3300):
        multiples = np.arange(0, 1 << 21, n)
        for keys in (multiples, multiples[1:] - 1):
            assert np.array_equal(remainders(keys, n), keys % n), n


def remainders(keys: np.ndarray, n: int) -> np.ndarray:
    """As query.cl has it; 2**21 bounds both keys and divisors."""
    inverse = np.float32(1) / np.float32(n)
    k = keys.astype(np.float32)
    quotient = ((k + np.float32(0.5)) * inverse).astype(np.int32).astype(np.float32)
    return k - quotient * np.float32(n)


def test_inverses() -> None:
    table = inverses(300)
    assert table.dtype == np.float32
    assert table[0] == 0
    assert all(table[n] == np.float32(1 / n) for n in range(1, 301))


def test_strided_and_integer_points(device, balls) -> None:
    query = on_device(balls, device)
    wide = np.random.default_rng(8).random((100, 6)) * SIDE + np.array(ORIGIN * 2)
    for points in (wide[:, ::2], np.asfortranarray(wide[:, :3]), wide[::-1, 3:]):
        equal(query(points), balls.query(points))
    whole = [(-3, 1, 13), (-2, 2, 14), (0, 0, 0)]
    equal(query(whole, **EVERYTHING), balls.query(np.array(whole), **EVERYTHING))


def test_refusals(device, balls) -> None:
    query = on_device(balls, device)
    with pytest.raises(VoxtoolError, match=r"points of shape \(4,\): give \(N, 3\) or"):
        query([1, 2, 3, 4])
    with pytest.raises(VoxtoolError, match="not an array of numbers"):
        query([("a", "b", "c")])
    with pytest.raises(VoxtoolError, match="search 'quick' is unknown: choose linear, binary"):
        query([(0, 0, 0)], search="quick")


def test_one_call_for_any_number_of_points(device, balls) -> None:
    for n in (1, HOST_POINTS, HOST_POINTS + 1):  # on the host, and on the device
        points = points_of(balls, n)[:n]
        found = query_adf(balls, points, search="linear", device=device, **EVERYTHING)
        equal(found, balls.query(points, **EVERYTHING))


@pytest.mark.parametrize("point", [(0.4, 0.5, 0.6), (-1, 0.5, 2), (math.nan, 0, 0)])
def test_one_point_is_a_point(device, balls, point) -> None:
    point = list(np.array(point) * SIDE + np.array(ORIGIN))
    several = balls.query([point], **EVERYTHING)
    for query in (partial(query_adf, balls), on_device(balls, device), balls.query):
        found = query(point, **EVERYTHING)
        equal(found, several[0])
        assert np.shape(found.distance) == ()
        assert np.shape(found.gradient) == np.shape(found.cell) == (3,)
    assert np.shape(balls.gradient(point)) == (3,)


def test_textures_stay_on_the_device_while_the_field_does(device, balls) -> None:
    field, began = replace(balls, units="mm"), []
    points = points_of(field, 300)
    with device.reporting(began.append):
        for _ in range(3):
            query_adf(field, points, bounds=True, device=device)
        assert began.count("upload") == 4  # three textures, and the bounds
        kept = [key for key in device._kept if key[0] == id(field)]
        assert len(kept) == 2
        del field
        assert not [key for key in device._kept if key in kept]


def test_fields_and_queries_pickle(balls) -> None:
    field, query = pickle.loads(pickle.dumps((balls, FieldQuery(balls))))
    assert field == balls == query.field
    assert field != replace(balls, side=1.0)
    assert not field.voxels.flags.writeable
    point = [0.5 * SIDE + x for x in ORIGIN]
    assert query(point) == query_adf(balls, point)
    assert repr(field) == f"DistanceField({len(field.voxels):,} blocks, levels to 7, tolerance " + (
        "0.002, sign pseudonormal, side 2.3)"
    )
    assert repr(query).startswith("FieldQuery(DistanceField(")


def test_only_what_is_needed_is_compiled(device, balls, monkeypatch) -> None:
    seen: list[dict] = []
    kernel = type(device).kernel

    def recorded(self, source, name, **defines):
        seen.append(defines)
        return kernel(self, source, name, **defines)

    monkeypatch.setattr(type(device), "kernel", recorded)
    inside = np.full((5, 3), 0.4) * SIDE + np.array(ORIGIN)
    query = on_device(balls, device)
    query(inside)
    optional = {"W", "WIDE", "GRADIENT", "BOUNDS", "CELL"}
    assert optional & set(seen[-1]) == ({"W"} if balls.hash.has_w else set())
    query(inside, bounds=True)
    assert optional & set(seen[-1]) - {"W"} == {"BOUNDS"}
    assert len(seen) == 2
