"""The perfect spatial hash and the identifiers of cells, against sets of keys of every shape."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import opened, usable_devices
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.adf.field import hashing
from voxtool.adf.field.cells import MAX_LEVEL, cell_identifier, cell_of, identifier_type, key_of
from voxtool.adf.field.hashing import build_hash
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.opencl import Device
from voxtool.selftest.fields import slots as slots_by_definition


def near_box(level: int, low: tuple[float, ...], high: tuple[float, ...]) -> list[np.ndarray]:
    """Return the cells of each level that the surface of a box passes."""
    levels = []
    for number in range(level + 1):
        cells = np.indices((1 << number,) * 3).reshape(3, -1).T
        begin, end = cells * 0.5**number, (cells + 1) * 0.5**number
        touched = ((begin <= high) & (end >= low)).all(1)
        inside = ((begin > low) & (end < high)).all(1)
        levels.append(cells[touched & ~inside])
    return levels


def near_sphere(level: int, radius: float) -> list[np.ndarray]:
    """Return the cells of each level that a sphere passes."""
    cells, levels = np.zeros((1, 3), np.int64), []
    for number in range(level + 1):
        low = cells * 0.5**number - np.array([0.5, 0.48, 0.51])
        high = low + 0.5**number
        near = np.maximum(np.maximum(low, -high), 0)
        far = np.maximum(abs(low), abs(high))
        passed = ((near**2).sum(1) <= radius**2) & ((far**2).sum(1) >= radius**2)
        cells = cells[passed]
        levels.append(cells)
        cells = (2 * cells[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T).reshape(-1, 3)
    return levels


def full_with_blobs(level: int) -> list[np.ndarray]:
    """Return the cells of each level of a full octree that lacks some balls in its last level but
    two, and has nothing except some balls in the last two."""
    levels = [np.indices((1 << number,) * 3).reshape(3, -1).T for number in range(level + 1)]
    rng = np.random.default_rng(level)
    for number, share in ((level - 2, 0.97), (level - 1, 0.4), (level, 0.09)):
        centres = rng.random((12, 1, 3)) * (1 << number)
        near = (((levels[number] - centres) ** 2).sum(axis=2) / rng.random((12, 1))).min(axis=0)
        levels[number] = levels[number][near <= np.quantile(near, share)]
    return levels


def keys_of(levels: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([key_of(level, cells) for level, cells in enumerate(levels)])


def block(nx: int, ny: int, nz: int, low: int = 1, step: int = 1) -> np.ndarray:
    return low + step * np.indices((nx, ny, nz)).reshape(3, -1).T


def random_keys(n: int, top: int) -> np.ndarray:
    return np.unique(np.random.default_rng(n).integers(1, top + 1, (n, 3)), axis=0)


def check(keys: np.ndarray) -> SpatialHash:
    """Return the table of keys, which is the same on every device, after checking all of it."""
    tables, n = [build_hash(keys, opened(index)) for index, _ in usable_devices()], len(keys)
    table = tables[0]
    assert all(other == table for other in tables)
    table.validate(keys)
    assert table.m**3 >= n
    assert table.m == 1 or (table.m - 1) ** 3 < n
    channels = 4 if table.has_w else 3
    assert table.offsets.shape == (table.r,) * 3 + (channels,)
    assert table.offsets.dtype == (np.uint8 if table.m < 256 else np.uint16)
    assert not table.has_w or (table.offsets[..., 3] != table.m).any()
    assert table.nbytes == table.r**3 * channels * table.offsets.itemsize
    assert table.bits_a_key(n) == 8 * table.nbytes / max(n, 1)
    assert table.load(n) == n / table.m**3
    slots = table.slots(keys)
    assert slots.dtype == np.int64
    assert len(np.unique(slots)) == n
    assert ((slots >= 0) & (slots < table.m**3)).all()
    assert slots[:500].tolist() == slots_by_definition(table, keys[:500])
    return table


# --- sets of keys --------------------------------------------------------------------------------


SHAPES = {  # keys, and the bits a key that their table takes at most, or infinity
    "one": (block(1, 1, 1, 5), math.inf),
    "two": (np.array([[5, 6, 7], [5, 6, 8]], np.int32), math.inf),
    "far apart": (np.array([[1, 1, 1], [2**21 - 1] * 3]), math.inf),
    "line x": (block(2000, 1, 1, 50), math.inf),
    "line z": (block(1, 1, 900, 1024), math.inf),
    "plane": (block(120, 120, 1, 512), math.inf),
    "cube": (block(32, 32, 32, 17), math.inf),
    "box": (block(31, 32, 33, 1024), math.inf),
    "lattice": (block(20, 20, 20, 1, 400), math.inf),
    "full octree": (keys_of([block(*[1 << n] * 3, 0) for n in range(6)]), math.inf),
    "floor": (keys_of(near_box(7, (0.1, 0.1, 0.3), (0.9, 0.9, 0.3))), 10),
    "surface of a box": (keys_of(near_box(7, (0.21, 0.2, 0.3), (0.8, 0.7, 0.77))), 20),
    **{
        f"sphere to level {level}": (keys_of(near_sphere(level, radius)), bits)
        for level, radius, bits in [(2, 0.4, math.inf), (5, 0.4, math.inf), (7, 0.4, 8),
                                    (9, 0.15, 8), (10, 0.06, math.inf), (12, 0.01, math.inf)]
    },
    **{
        f"{n} random to {top}": (random_keys(n, top), math.inf)
        for n in (7, 1000)
        for top in (4, 100, 8191, 2**21 - 1)
    },
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_shapes(name: str) -> None:
    keys, bits = SHAPES[name]
    assert check(keys).bits_a_key(len(keys)) < bits


def test_no_key() -> None:
    assert check(np.empty((0, 3), np.int32)).m == 1


def test_cells_of_an_octree_that_is_nearly_full() -> None:
    keys = keys_of(full_with_blobs(6))
    table = check(keys)
    assert table.has_w  # its buckets are alike
    assert table.bits_a_key(len(keys)) < 9


@pytest.mark.parametrize("m", [59, 60])
def test_the_load_is_over_95_percent_where_the_least_table_allows_it(m: int) -> None:
    keys = np.random.default_rng(m).permutation(block(128, 128, 128, 900))[: m**3 + 1]
    assert check(keys).load(len(keys)) > 0.95


@given(st.sets(st.tuples(*[st.integers(1, 8191)] * 3), max_size=60))
@settings(max_examples=100)
def test_any_few_keys(keys: set[tuple[int, int, int]]) -> None:
    check(np.array(sorted(keys), np.int64).reshape(-1, 3))


@given(
    st.tuples(*[st.integers(1, 12)] * 3),
    st.integers(1, 300),
    st.sampled_from([1, 2, 3, 7, 16, 30, 210, 256, 360]),
)
@settings(max_examples=100)
def test_any_lattice_of_keys(shape: tuple[int, int, int], low: int, step: int) -> None:
    check(block(*shape, low, step))


def test_keys_equal_mod_r_and_m_are_parted_by_w() -> None:
    keys = block(10, 10, 5)
    assert not check(keys).has_w
    m, r = 8, 5
    keys[-1] = (1 + r * m, 1, 1)  # where (1, 1, 1) is
    table = check(keys)
    assert (table.m, table.r, table.has_w) == (m, r, True)
    assert table.offsets[1, 1, 1, 3] in (3, 7)
    assert np.count_nonzero(table.offsets[..., 3] != m) == 1


def test_keys_equal_mod_everything_need_another_r() -> None:
    """The w that are coprime to r = 7 and m = 10 are 9 and 3, and separate them as little as 10."""
    assert check(block(10, 10, 10, 1, 2 * 3 * 4 * 5 * 7)).r > 7


def search_of(keys: np.ndarray, m: int, r: int, device: Device) -> hashing._Search:
    on_device = hashing._sort_keys(device, keys)
    buckets = hashing._fill_buckets(on_device, r, hashing._count_keys(on_device, r))
    return hashing._Search(buckets, m, hashing._Way.PACKED)


def test_w_is_coprime_and_parts_the_keys(device: Device) -> None:
    keys = np.array([[1, 1, 1], [1 + 3 * 10, 1, 1], [2, 2, 2]])
    search = search_of(keys, 10, 3, device)
    assert search.choices.tolist() == [10, 7]
    assert search.buckets.sizes.tolist() == [2, 1]
    assert search.run() is not None
    assert search.w.get().tolist() == [7, 10]
    keys[1, 0] = 1 + 3 * 10 * 7
    search = search_of(keys, 10, 3, device)
    assert search.run() is None
    assert search.w.get().tolist() == [0, 10]


def test_without_w_offsets_separate_the_keys_alone_or_there_is_no_table() -> None:
    keys = keys_of(near_sphere(6, 0.4))
    assert build_hash(keys).has_w
    table = build_hash(keys, with_w=False)
    table.validate(keys)
    assert not table.has_w
    keys = np.ones((2, 3), np.int64)
    keys[1, 0] += 10 * 3  # the keys are equal modulo m, 1 and 3
    assert build_hash(keys, side=10, max_r=3).has_w
    with pytest.raises(MemoryLimitError, match="no perfect hash of 2 keys"):
        build_hash(keys, side=10, max_r=3, with_w=False)


@pytest.mark.parametrize(("m", "r", "dtype"), [(255, 4, np.uint8), (256, 3, np.uint16)])
def test_offsets_have_16_bits_where_m_needs_them(m: int, r: int, dtype: type) -> None:
    keys = block(5, 5, 5)
    keys[-1] = (1 + r * m, 1, 1)  # so w is stored too, and it is m in most places
    table = build_hash(keys, side=m, max_r=r)
    table.validate(keys)
    assert (table.m, table.r, table.offsets.max()) == (m, r, m)
    assert table.has_w
    assert table.offsets.dtype == dtype
    assert table.slots(keys).tolist() == slots_by_definition(table, keys)


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32])
def test_the_order_and_type_of_keys_change_nothing(dtype: type) -> None:
    keys = keys_of(near_sphere(7, 0.4))
    shuffled = np.random.default_rng(3).permutation(keys).astype(dtype)
    before = shuffled.copy()
    assert build_hash(shuffled) == build_hash(keys)
    assert (shuffled == before).all()


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (np.array([[1, 2, 3], [4, 5, 6], [1, 2, 3]]), r"key \(1, 2, 3\) is repeated"),
        (np.array([[1, 2, 3], [4, 0, 6]]), r"key \(4, 0, 6\) is out of range"),
        (np.array([[1, 2, -3]]), r"key \(1, 2, -3\) is out of range"),
        (np.array([[1, 2, 2**21]]), r"key \(1, 2, 2097152\) is out of range.*2097151"),
        (np.array([1, 2, 3]), "integers"),
        (np.array([[1.0, 2.0, 3.0]]), "integers"),
        (np.array([[1, 2]]), "integers"),
        (
            np.broadcast_to(np.ones(3, np.int32), (2**30 + 1, 3)),
            r"1,073,741,825 keys.*1024\^3 slots.*smaller",
        ),
    ],
)
def test_bad_keys_are_named(keys: np.ndarray, message: str) -> None:
    with pytest.raises(VoxtoolError, match=message) as error:
        build_hash(keys)
    assert "\n" not in str(error.value)


def test_no_table_within_bounds_is_one_line() -> None:
    with pytest.raises(MemoryLimitError, match="no perfect hash of 41 keys") as error:
        build_hash(keys_of(near_sphere(2, 0.3)), max_r=1)
    assert "\n" not in str(error.value)


def test_a_broken_table_is_found() -> None:
    keys = block(12, 12, 12, 100)  # the table is full: no key can move to a free slot
    table = build_hash(keys)

    def offsets(value: int) -> np.ndarray:
        changed = table.offsets.copy()
        x, y, z = keys[777] % table.r
        changed[z, y, x, 0] = value
        return changed

    moved = (int(table.offsets[tuple(keys[777] % table.r)[::-1]][0]) + 1) % table.m
    zero_w = np.zeros((table.r,) * 3 + (4,), np.uint8)
    for change, message in [
        ({"offsets": offsets(moved)}, r"keys \(.*\) and \(.*\) have the same slot"),
        ({"offsets": offsets(table.m)}, "out of range"),
        ({"offsets": zero_w}, "out of range"),
        ({"offsets": table.offsets.astype(np.uint16)}, "type"),
        ({"r": table.r + 1}, "shape"),
    ]:
        with pytest.raises(VoxtoolError, match=message):
            replace(table, **change).validate(keys)


# --- identifiers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("level", range(MAX_LEVEL + 1))
def test_identifiers_go_there_and_back(level: int) -> None:
    cells = np.random.default_rng(level).integers(0, 1 << level, (100, 3))
    cells[0], cells[1] = 0, (1 << level) - 1
    identifiers = cell_identifier(level, cells)
    assert identifiers.dtype == identifier_type(level)
    assert identifiers.dtype == (np.uint32 if level <= 10 else np.uint64)
    assert all(int(i).bit_length() == 3 * level + 1 for i in identifiers)
    levels, back = cell_of(identifiers)
    assert (levels == level).all()
    assert (back == cells).all()
    assert (key_of(levels, back) == cells + 2**level).all()


def test_an_identifier_is_a_morton_code_with_a_leading_one() -> None:
    assert cell_identifier(0, np.array([[0, 0, 0]])).tolist() == [1]
    assert cell_identifier(1, np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])).tolist() == [9, 10, 12]
    assert cell_identifier(2, np.array([[2, 0, 3]])).tolist() == [0b1_101_100]


@pytest.mark.parametrize(
    ("level", "cell"), [(-1, 0), (MAX_LEVEL + 1, 0), (3, 8), (3, -1), (0, 1), (10, 1024)]
)
def test_cells_that_do_not_exist_have_no_identifier(level: int, cell: int) -> None:
    with pytest.raises(VoxtoolError, match="level"):
        cell_identifier(level, np.array([[0, 0, cell]]))


def test_absent_cells_are_recognised_on_every_level() -> None:
    levels = near_sphere(6, 0.3)
    table = build_hash(keys_of(levels))
    stored = np.zeros(table.m**3, np.uint32)  # no cell has identifier 0
    for level, cells in enumerate(levels):
        stored[table.slots(key_of(level, cells))] = cell_identifier(level, cells)
    for level in range(8):
        every = np.indices((1 << level,) * 3).reshape(3, -1).T
        found = stored[table.slots(key_of(level, every))] == cell_identifier(level, every)
        present = levels[level].tolist() if level < len(levels) else []
        assert sorted(every[found].tolist()) == sorted(present)
