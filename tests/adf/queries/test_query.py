"""Queries on the device against DistanceField.query, the oracle in numpy: equal bit for bit."""

from __future__ import annotations

import itertools
import math
import pickle
import weakref
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers.field import cells_of, plain_field, point, sphere
from hypothesis import given
from hypothesis import strategies as st

from voxtool.adf.field.cells import key_of
from voxtool.adf.field.field import DistanceField, assemble
from voxtool.adf.field.host_query import CHUNK, POINT_BITS, QueryResult, to_fixed
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.adf.queries.query import HOST_POINTS, FieldQuery, query_adf
from voxtool.adf.queries.textures import GPU, GPU_COHERENT, levels_to_search
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.opencl import open_device

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
    """Return queries of which the host answers none."""
    return FieldQuery(field, device, host_points=0, **options)


def check(
    field: DistanceField, device: Device, points: Any, search: str = "binary", **options: Any
) -> QueryResult:
    """Return all values on the device, which are those of the host."""
    found = on_device(field, device, **options)(points, search=search, **EVERYTHING)
    equal(found, field.query(points, **EVERYTHING))
    return found


def spike(p: np.ndarray) -> np.ndarray:
    """Return values that are as far from linear in large cells as in small ones."""
    return np.log2(point(p) + 1e-12)


def points_of(field: DistanceField, n: int = 3000, seed: int = 1) -> np.ndarray:
    """Return random points in the cube, about it and in deep cells; points on faces and vertices of
    cells; the cube's corners; NaN, infinite and huge ones."""
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


def two_balls(p: np.ndarray) -> np.ndarray:
    small = np.sqrt(((p - (0.1, 0.15, 0.9)) ** 2).sum(axis=1)) - 0.02
    return np.minimum(sphere(p), small)


@pytest.fixture(scope="module")
def balls() -> DistanceField:
    """Return a field with leaves of levels 2 to 7."""
    return plain_field(two_balls, 2e-3, 7, origin=ORIGIN, side=SIDE)


@pytest.mark.parametrize(
    ("search", "request_"),
    [
        *itertools.product(SEARCHES, ({}, EVERYTHING)),
        *(("binary", {name: True}) for name in EVERYTHING),  # each is a program of its own
    ],
)
def test_values_are_those_of_the_host(device, balls, search, request_) -> None:
    points = points_of(balls)
    found = on_device(balls, device)(points, search=search, **request_)
    equal(found, balls.query(points, **request_))


def deep(max_level: int) -> DistanceField:
    field = plain_field(spike, 0.2, max_level, origin=ORIGIN, side=SIDE)
    assert field.depth == max_level
    assert field.cells.shape[-1] == (3 if max_level > 11 else 2)  # identifiers of 64 bits
    return field


HASHES = {
    "w": lambda: with_w(plain_field(two_balls, 2e-3, 7)),
    "w and level 14": lambda: with_w(deep(14)),
    "16-bit offsets": lambda: with_w(plain_field(sphere, 1e-2, 4), m=299, w=False),
    "16-bit offsets with w": lambda: with_w(plain_field(sphere, 1e-2, 4), m=300),
}
FIELDS = {
    **HASHES,
    **{f"level {level}": partial(deep, level) for level in (11, 12, 14, 21)},
    "a root alone": lambda: plain_field(sphere, 10.0, 3),
    "a full octree": lambda: plain_field(lambda p: np.sin(40 * p).sum(axis=1), 1e-9, 3),
}


@cache
def field_of(name: str) -> tuple[DistanceField, np.ndarray, QueryResult]:
    """A field, points, and the values of all of them by the host."""
    field = FIELDS[name]()
    points = points_of(field, 1000)
    return field, points, field.query(points, **EVERYTHING)


@pytest.mark.parametrize("name", FIELDS)
def test_any_field(device, name) -> None:
    field, points, expected = field_of(name)
    # the hash is read by one function for all searches; each pair would be a program of its own
    for search in ("binary",) if name in HASHES else SEARCHES:
        found = on_device(field, device)(points, search=search, **EVERYTHING)
        equal(found, expected)
        assert found.level is not None
        assert found.level.max() == field.depth
    if name in ("a root alone", "a full octree"):
        assert levels_to_search(field) == (field.depth - 1, field.depth - 1)


@pytest.mark.parametrize("search", SEARCHES)
def test_other_shapes_of_the_work_give_the_same(device, balls, search) -> None:
    """These are the work-groups of a GPU."""
    shape = GPU_COHERENT if search == "coherent" else GPU
    check(balls, device, points_of(balls, 300), search, shape=shape)


def with_w(field: DistanceField, m: int = 101, *, w: bool = True) -> DistanceField:
    """Return the same field with a sparse hash, for which random offsets, and w, suffice."""
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
    made = assemble(field.blocks, keys, field.voxels, field.bounds, hash, **head)
    made.validate()
    return made


def test_levels_to_search(balls) -> None:
    leaves = balls.leaves_by_level()
    full, deepest = levels_to_search(balls)
    assert deepest == len(leaves) - 1
    assert not any(leaves[:full])
    assert leaves[full]
    assert full < deepest - 2


@pytest.mark.parametrize("search", SEARCHES)
def test_order_changes_nothing(device, balls, search) -> None:
    """Points may alternate between the coarsest and the deepest cells, or follow a line."""
    levels, cells = cells_of(balls)
    deep = (cells[levels == levels.max()] + 0.3) / 2.0 ** levels.max()
    coarse = np.random.default_rng(2).uniform(0.85, 1, (len(deep), 3))
    mixed = np.stack([deep, coarse], axis=1).reshape(-1, 3)
    line = np.linspace(0, 1, 5000)[:, None] * (0.9, 0.6, 0.5) + (0.05, 0.2, 0.25)
    for unit in (mixed, mixed[::-1], line):
        check(balls, device, unit * SIDE + np.array(ORIGIN), search)


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, CHUNK - 1, CHUNK + 1])
def test_any_number_of_points(device, balls, n) -> None:
    points = np.random.default_rng(n).random((n, 3)) * SIDE + np.array(ORIGIN)
    for search in SEARCHES:
        check(balls, device, points, search)
        equal(on_device(balls, device)(points, search=search), balls.query(points))


def test_blocks(device, balls) -> None:
    """Only some blocks have points outside."""
    points = np.random.default_rng(4).random((7777, 3))
    points[2500:2600] += 1
    points[7000] = math.nan
    check(balls, device, points * SIDE + np.array(ORIGIN), block=1000)


def test_more_points_than_a_block_has(device, balls) -> None:
    block = 1 << 17
    points = np.random.default_rng(5).random((2 * block + 17, 3)) * SIDE + np.array(ORIGIN)
    query = on_device(balls, device, block=block)
    found = query(points)
    equal(query(points, search="coherent"), found)
    equal(on_device(balls, device)(points), found)
    for part in (slice(0, 999), slice(block - 500, block + 500), slice(2 * block - 500, None)):
        assert np.array_equal(found.distance[part], balls.query(points[part]).distance)


@pytest.mark.parametrize("begin", [0, 1, 3, 8, 15, 16, 1001])
def test_points_anywhere_in_memory(device, balls, begin: int) -> None:
    """The device reads points of this number where they are, and lets them go."""
    numbers = np.random.default_rng(6).uniform(-0.02, 1.02, begin + 3 * 5000)
    points = numbers[begin:].reshape(-1, 3) * SIDE + np.array(ORIGIN)
    owner = np.empty_like(numbers)
    place = owner[begin:].reshape(-1, 3)
    place[:] = points
    check(balls, device, place)
    assert np.array_equal(place, points)
    place.flags.writeable = False
    check(balls, device, place)
    numbers = place.tobytes()
    alive = weakref.ref(owner)
    del owner, place
    assert alive() is None
    odd = np.frombuffer(b"_" + numbers, np.uint8)[1:].view(np.float64).reshape(-1, 3)
    check(balls, device, odd)


def test_without_bounds(device) -> None:
    field = plain_field(sphere, 1e-2, 5, bounds=False, origin=ORIGIN, side=SIDE)
    points = points_of(field)
    found = on_device(field, device)(points, gradient=True, cell=True)
    equal(found, field.query(points, gradient=True, cell=True))
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
    exact = SIDE * two_balls(unit)
    assert (answer.distance[far] >= 0).all()
    assert (answer.distance[far] <= exact[far] + 1e-2 * SIDE).all()
    assert answer.bound is not None
    assert np.isinf(answer.bound[far]).all()


def test_at_infinity_gradients_are_limits(device, balls) -> None:
    inf, half = math.inf, np.float32(math.sqrt(0.5))
    points = [(inf, 0, 0.5), (-inf, 3, inf), (1e308, -1e308, 7)]
    found = FieldQuery(balls, device, host_points=0)(points, gradient=True, bounds=True)
    equal(found, balls.query(points, gradient=True, bounds=True))
    assert (found.distance[:2] == inf).all()
    assert found.outside.all()
    expected = [(1, 0, 0), (-half, 0, half), (half, -half, 0)]
    np.testing.assert_allclose(found.gradient, expected, rtol=1e-6)


@pytest.mark.parametrize("exponent", [-300, -20, 0, 20, 300])
def test_points_are_rounded_down_to_the_lattice(device, exponent: int) -> None:
    """Points are rounded in blocks, some of which have no point outside."""
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
    check(field, device, points)


@given(st.integers(1, (1 << 21) - 1), st.integers(1, (1 << 21) - 1))
def test_remainders_are_exact(key: int, n: int) -> None:
    """These keys are the hardest for a divisor in float32."""
    for hard in {key, key - key % n, max(key - key % n - 1, 0), ((1 << 21) - 1) // n * n - 1}:
        if hard >= 0:
            assert remainders(np.array([hard]), n)[0] == hard % n


def test_remainders_of_every_divisor_that_a_table_has() -> None:
    for n in range(1, 3300):
        multiples = np.arange(0, 1 << 21, n)
        for keys in (multiples, multiples[1:] - 1):
            assert np.array_equal(remainders(keys, n), keys % n), n


def remainders(keys: np.ndarray, n: int) -> np.ndarray:
    """Return keys mod n as search.h computes them; 2**21 bounds both keys and divisors."""
    inverse = np.float32(1) / np.float32(n)
    k = keys.astype(np.float32)
    quotient = ((k + np.float32(0.5)) * inverse).astype(np.int32).astype(np.float32)
    return k - quotient * np.float32(n)


def test_strided_and_integer_points(device, balls) -> None:
    query = on_device(balls, device)
    wide = np.random.default_rng(8).random((100, 6)) * SIDE + np.array(ORIGIN * 2)
    for points in (wide[:, ::2], np.asfortranarray(wide[:, :3]), wide[::-1, 3:]):
        equal(query(points), balls.query(points))
    whole = [(-3, 1, 13), (-2, 2, 14), (0, 0, 0)]
    check(balls, device, whole)


def test_refusals(device, balls) -> None:
    query = on_device(balls, device)
    with pytest.raises(VoxtoolError, match=r"points of shape \(4,\): give \(N, 3\) or"):
        query([1, 2, 3, 4])
    with pytest.raises(VoxtoolError, match="not an array of numbers"):
        query([("a", "b", "c")])
    with pytest.raises(VoxtoolError, match="search 'quick' is unknown: choose linear, binary"):
        query([(0, 0, 0)], search="quick")


@pytest.mark.parametrize("n", [1, HOST_POINTS, HOST_POINTS + 1])
def test_one_call_for_any_number_of_points(device, balls, n) -> None:
    points = points_of(balls, n)[:n]  # on the host, and on the device
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
        assert len(kept) == 3  # the blocks, cells and hash, and the bounds
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


def test_only_what_is_needed_is_compiled(device, balls) -> None:
    points = np.full((5, 3), 0.4) * SIDE + np.array(ORIGIN)
    optional = {"W", "WIDE", "GRADIENT", "BOUNDS", "CELL"}
    query = on_device(balls, fresh := open_device(str(device.info.index)))
    for request_, needed in (({}, set()), ({"bounds": True}, {"BOUNDS"})):
        known = set(fresh._kernels)
        query(points, **request_)
        (built,) = {key for key in fresh._kernels if key not in known}
        used = {define[0] for define in built[2:]}
        assert used & optional == needed | ({"W"} if balls.hash.has_w else set())
