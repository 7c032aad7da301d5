"""Set operations on octrees, against numpy on dense arrays and by the laws of sets."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from conftest import model
from helpers import meshes
from helpers.octree import WORLD, ball, octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st

import voxtool
from voxtool.choices import OPERATIONS
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine, plan_combine
from voxtool.svo.voxelization.voxelize import voxelize

PITCH = 0.37
DENSE = {
    "union": np.logical_or,
    "intersection": np.logical_and,
    "difference": lambda a, b: a & ~b,
    "xor": np.logical_xor,
}
operations = pytest.mark.parametrize("operation", OPERATIONS)


def dense_set(rng: np.random.Generator, shape: np.ndarray) -> np.ndarray:
    """Noise, single voxels, nothing, everything, or boxes, whose octrees have coarse leaves."""
    kind = rng.integers(6)
    if kind < 4:
        return rng.random(shape) < (0.5, 0.003, 0.0, 1.0)[kind]
    boxes = np.zeros(shape, bool)
    for _ in range(3):
        low = rng.integers(0, shape)
        box = tuple(map(slice, low, rng.integers(low, shape) + 1))
        boxes[box] = ~boxes[box]
    return boxes


def in_common(arrays: list[np.ndarray], lows: np.ndarray) -> list[np.ndarray]:
    """Each array in the smallest box that holds all of them at these low corners."""
    lows = lows - lows.min(axis=0)
    shape = np.max([low + array.shape for low, array in zip(lows, arrays, strict=True)], axis=0)
    padded = []
    for low, array in zip(lows, arrays, strict=True):
        after = shape - low - array.shape
        padded.append(np.pad(array, list(zip(low.tolist(), after.tolist(), strict=True))))
    return padded


@given(seed=st.integers(0, 1 << 32), spread=st.sampled_from([0, 0, 4, 8, 40]))
@settings(max_examples=25)
def test_against_dense_arrays(device: Device, seed: int, spread: int) -> None:
    """One to four octrees of several modes and depths, up to `spread` voxels from the origin."""
    rng = np.random.default_rng(seed)
    lows = rng.integers(-spread, spread + 1, (rng.integers(1, 5), 3))
    if spread == 8:
        lows *= 4  # whole bricks
    shapes = rng.integers((8, 1, 1), 41, lows.shape)
    arrays = [dense_set(rng, shape) for shape in shapes]
    octrees = [
        Octree.from_dense(
            array, 0.1 + PITCH * low, PITCH, mode=("solid", "surface26")[rng.integers(2)]
        )
        for array, low in zip(arrays, lows, strict=True)
    ]
    padded = in_common(arrays, lows)
    for operation in OPERATIONS:
        found = combine(octrees, operation, device=device)
        found.validate()
        expected = functools.reduce(DENSE[operation], padded)
        assert np.array_equal(found.to_dense(), expected)
        canonical = Octree.from_dense(expected, found.grid.origin, PITCH)
        assert found.digest() == canonical.digest()  # pruned, of mode "solid" and fill "none"
        assert np.allclose(found.grid.origin, 0.1 + PITCH * lows.min(axis=0))


@given(seed=st.integers(0, 1 << 32))
@settings(max_examples=8)
def test_the_laws_of_sets(device: Device, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = rng.integers((8, 3, 3), 30)
    a, b, c = (octree_from_dense(dense_set(rng, shape)) for _ in range(3))
    box = octree_from_dense(np.ones(shape, bool))
    together = functools.partial(combine, [a, b, c], device=device)
    assert together() == a | (b | c) == (a | b) | c
    assert together("xor") == a ^ (b ^ c) == (a ^ b) ^ c
    assert together("intersection") == a & (b & c) == (a & b) & c
    assert together("difference") == a - (b | c) == (a - b) - c
    assert a | a == a & a == a == a - (box ^ a)
    assert box - (a | b) == (box - a) & (box - b)  # De Morgan
    assert box ^ (a & b) == (box - a) | (box - b)
    assert a ^ b == (a | b) - (a & b)
    assert (a & (b | c)).digest() == ((a & b) | (a & c)).digest()


def test_three_hundred_in_one_pass(device: Device) -> None:
    rng = np.random.default_rng(5)
    counts = np.zeros((40, 24, 33), int)
    octrees = []
    for _ in range(300):
        array = np.zeros(counts.shape, bool)
        low = rng.integers(0, np.array(counts.shape) - 6)
        array[tuple(slice(n, n + 6) for n in low)] = True
        counts += array
        octrees.append(Octree.from_dense(array))
    assert np.array_equal(combine(octrees, device=device), counts > 0)
    assert np.array_equal(combine(octrees, "xor", device=device), counts % 2 == 1)
    expected = octrees[0].to_dense() & (counts == 1)
    assert np.array_equal(combine(octrees, "difference", device=device), expected)
    assert not combine(octrees, "intersection", device=device).count


def test_a_small_and_a_large_grid(device: Device) -> None:
    """Octrees of 2 and of 14 levels: the nodes of the large one are neither visited nor copied."""
    small = Octree.from_dense(np.ones((8, 8, 8)))
    corner, far = np.array([[7, 7, 7]]), np.array([[32_000, 1, 40_000]])
    large = Octree.from_voxels(
        np.concatenate([corner, far]), Grid((40_960, 40_960, 40_960), (0, 0, 0), (1, 1, 1))
    )
    union = combine([small, large], device=device)
    assert union.count == 513
    assert combine([small, large], "intersection", device=device).occupied().tolist() == [[7, 7, 7]]
    moved = Octree.from_voxels(far % 7, Grid((9, 9, 9), (39_000, -3, 0), (1, 1, 1)))
    found = combine([moved, large], "xor", device=device)
    assert found.count == 3
    expected = np.concatenate([corner, far, np.add(far % 7, (39_000, -3, 0))])
    expected[:, 1] += 3
    assert found.occupied().tolist() == sorted(expected.tolist())
    assert found.grid.shape == (40_960, 40_963, 40_960)


def test_real_models(device: Device) -> None:
    """The bunny, and the armadillo as large as the bunny, in grids of one lattice."""
    one, other = (
        voxtool.load_mesh(model(f"{name}.obj")) for name in ("stanford-bunny", "armadillo")
    )
    low, high = one.bounds
    unit = (other.vertices - other.bounds[0]) / np.ptp(other.bounds, axis=0)
    other = voxtool.mesh_from_arrays(low + unit * (high - low), other.faces)
    a = voxelize(one, Grid.fit(one, 72), device=device)
    window = (8, -5, 3), (61, 90, 50)
    b = voxelize(other, a.grid.window(*window), device=device)
    padded = in_common([a.to_dense(), b.to_dense()], np.array([(0, 0, 0), window[0]]))
    for operation in OPERATIONS:
        found = combine([a, b], operation, device=device)
        assert np.array_equal(found, DENSE[operation](*padded))
        assert found.count > 1000


def test_boxes_that_are_combined_as_voxels_or_as_meshes(device: Device) -> None:
    """The voxels of a box with a hole, whose inner faces are turned, are a difference."""
    grid = Grid((40, 40, 40), (0, 0, 0), (1, 1, 1))
    outer, inner = (meshes.box(a, b) for a, b in ((3, 37), (9, 21)))
    both = (
        np.concatenate([outer[0], inner[0]]),
        np.concatenate([outer[1], inner[1][:, ::-1] + len(outer[0])]),
    )
    a, b, c = (
        voxelize(
            voxtool.mesh_from_arrays(np.asarray(v, float), f), grid, fill="parity", device=device
        )
        for v, f in (outer, inner, both)
    )
    assert a - b == c == a ^ b
    assert (a - b).set_digest() == c.set_digest()


def test_operators_and_equality() -> None:
    array = ball((20, 16, 12))
    solid, surface = (octree_from_dense(array, mode) for mode in ("solid", "surface26"))
    assert solid == surface
    assert solid.digest() != surface.digest()
    assert solid.set_digest() == surface.set_digest() == surface.pruned().set_digest()
    assert solid != octree_from_dense(~array)
    assert solid.set_digest() != octree_from_dense(~array).set_digest()
    with pytest.raises(TypeError, match="unsupported operand"):
        _ = solid | array.tolist()  # pyright: ignore[reportOperatorIssue]


def test_what_a_combination_keeps() -> None:
    a, b = (octree_from_dense(ball((8, 8, 8)), units=units) for units in ("mm", ""))
    both = a | b
    assert (both.mode, both.fill, both.units, both.source_sha256) == ("solid", "none", "mm", "")
    assert both.plan == {"operation": "union", "operands": 2}
    with pytest.raises(GridError, match=r"octrees 1 and 2 are in mm and in in: 1 in is 25\.4 mm: "):
        combine([a, octree_from_dense(ball((8, 8, 8)), units="in")])


def test_what_is_refused(device: Device) -> None:
    a = Octree.from_dense(np.ones((8, 8, 8)))
    with pytest.raises(GridError, match=r"octrees 1 and 3 have voxels of .* --lattice"):
        combine([a, a, Octree.from_dense(np.ones((8, 8, 8)), pitch=(1, 1, 1.5))])
    with pytest.raises(GridError, match=r"octrees 1 and 2 have origins .* whole numbers of voxels"):
        combine([a, Octree.from_dense(np.ones((8, 8, 8)), (0, 0.25, 0))])
    with pytest.raises(GridError, match="must have 8 to 65536"):
        combine([a, Octree.from_dense(np.ones((8, 8, 8)), (1e7, 0, 0))])
    with pytest.raises(VoxtoolError, match="operation 'and' is unknown: choose one of union,"):
        combine([a, a], "and")
    with pytest.raises(VoxtoolError, match="there is no octree"):
        combine([])
    b = octree_from_dense(ball((30, 30, 30)))
    with pytest.raises(MemoryLimitError, match="union of 2 octrees would need"):
        combine([b, b], device=device, max_memory=1000)


def test_origins_that_were_rounded() -> None:
    """Windows of a grid, whose origins are rounded, are of its lattice."""
    grid = Grid((50, 50, 50), **{name: WORLD[name] for name in ("origin", "pitch")})
    lows = [(3, 7, 11), (29, 1, 17), (0, 0, 0)]
    octrees = [Octree.from_voxels([[1, 2, 3]], grid.window(low, (12, 12, 12))) for low in lows]
    expected = sorted(np.add(lows, (1, 2, 3)).tolist())
    assert combine(octrees).occupied().tolist() == expected


def test_the_plan_bounds_the_memory(device: Device) -> None:
    rng = np.random.default_rng(2)
    arrays = [rng.random((60, 60, 60)) < share for share in (0.5, 0.001)]
    job = plan_combine([Octree.from_dense(array) for array in arrays], "xor", device=device)
    octree = job.run()
    assert job.cost.host >= octree.nbytes
    assert job.cost.largest >= max(octree.nodes.nbytes, octree.bricks.nbytes)
    assert job.describe()["operands"] == 2
