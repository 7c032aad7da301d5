"""Morphology against scipy's distances and filters, and by its own laws."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import model
from helpers.morphology import morphed, near
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import voxtool
from voxtool.choices import ELEMENTS, MORPHOLOGY
from voxtool.svo.cells.subtrees import cube
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.tiling import Box, Tiling

RNG = np.random.default_rng(7)
SHAPES = ((8, 8, 8), (20, 9, 33), (40, 17, 5))
RADII = (1, 1.41, 2**0.5, 2.5, 7)


def sets_of(shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
    one = np.zeros(shape, bool)
    one[shape[0] // 2, 0, -1] = True
    return {
        "random": RNG.random(shape) < 0.5,
        "sparse": RNG.random(shape) < 0.01,
        "blobs": ndimage.gaussian_filter(RNG.random(shape), 2) > 0.5,
        "one": one,
        "none": np.zeros(shape, bool),
        "all": np.ones(shape, bool),
    }


def growth(octree: Octree, like: Octree) -> np.ndarray:
    """The voxels by which a grid has grown at its low sides."""
    steps = (np.array(like.grid.origin) - octree.grid.origin) / like.grid.pitch
    low = np.rint(steps).astype(int)
    assert (low % 16 == 0).all()
    return low


@pytest.mark.parametrize("shape", SHAPES)
def test_operations_are_those_of_scipy(device, shape) -> None:
    first = SHAPES.index(shape)
    for i, (kind, dense) in enumerate(sets_of(shape).items()):
        octree = Octree.from_dense(dense)
        radius, element = RADII[(i + 2 * first) % len(RADII)], ELEMENTS[(i + first) % 3]
        for operation in MORPHOLOGY:
            result = voxtool.morph(octree, operation, radius, shape=element, device=device)
            result.validate()
            if operation == "dilate":
                low, margin = growth(result, octree), int(radius)
                expected = np.argwhere(near(np.pad(dense, margin), radius, element))
                found = np.argwhere(result.to_dense()) - low + margin
                assert np.array_equal(found, expected), (kind, radius, element)
            else:
                expected = morphed(dense, operation, radius, element)
                assert np.array_equal(result.to_dense(), expected), (kind, radius, operation)


@pytest.mark.parametrize("seed", range(4))
def test_boundary_and_octree_of_a_box(seed: int) -> None:
    random = np.random.default_rng(seed)
    block = (16, 16, 32, 64)[seed]
    dense = np.kron(random.random((128 // block,) * 3) < 0.6, np.ones((block,) * 3, bool))
    voxels = Tiling.of(Octree.from_dense(dense ^ (random.random(dense.shape) < 1e-4)), 1)
    low = 16 * random.integers(-2, 6, 3)
    box = Box(low, low + 16 * random.integers(1, 6, 3))
    codes = voxels.boundary()
    assert np.array_equal(voxels.boundary(box), codes[voxels.within(codes, box)])
    everything = voxels.octree(cube(128), np.zeros(3, int)).to_dense()
    part = voxels.octree(cube(64), low).to_dense()
    wide = np.pad(everything, 64)[tuple(slice(64 + a, 128 + a) for a in low)]
    assert np.array_equal(part, wide)


def test_radius_beyond_a_tile(device) -> None:
    dense = ndimage.gaussian_filter(RNG.random((40, 20, 18)), 3) > 0.5
    octree = Octree.from_dense(dense)
    for operation in ("erode", "close"):
        found = voxtool.morph(octree, operation, 17.5, device=device)
        assert np.array_equal(found.to_dense(), morphed(dense, operation, 17.5, "ball")), operation


def test_voxels_that_are_no_cubes(device) -> None:
    dense = RNG.random((12, 10, 9)) < 0.1
    pitch = (0.5, 1.0, 2.0)
    octree = Octree.from_dense(dense, pitch=pitch)
    eroded = voxtool.morph(octree, "close", 2.0, world=True, device=device)
    padded = np.pad(dense, 10)
    grown = np.asarray(ndimage.distance_transform_edt(~padded, sampling=pitch)) <= 2.0
    closed = np.asarray(ndimage.distance_transform_edt(grown, sampling=pitch)) > 2.0
    assert np.array_equal(eroded.to_dense(), closed[10:-10, 10:-10, 10:-10])


@settings(max_examples=8)
@given(st.integers(0, 2**32), st.sampled_from(ELEMENTS), st.sampled_from((1, 1.5, 3)))
def test_laws(seed: int, element: str, radius: float) -> None:
    dense = np.random.default_rng(seed).random((19, 12, 9)) < 0.7
    octree = Octree.from_dense(dense)

    def after(octree: Octree, operation: str) -> Octree:
        return voxtool.plan_morph(octree, operation, radius, shape=element).run()

    opened, closed = after(octree, "open"), after(octree, "close")
    assert not (opened.to_dense() & ~dense).any()
    assert not (dense & ~closed.to_dense()).any()
    assert after(closed, "close") == closed
    assert after(opened, "open") == opened


def test_a_small_batch_changes_nothing(device) -> None:
    octree = Octree.from_dense(RNG.random((40, 40, 40)) < 0.3)
    job = voxtool.plan_morph(octree, "close", 3, device=device)
    assert job.with_(batch=2).run() == job.run()


def test_less_memory_makes_smaller_batches() -> None:
    octree = Octree.from_dense(RNG.random((40, 40, 40)) < 0.3)
    job = voxtool.plan_morph(octree, "close", 3)
    scratch = job.plan.element.scratch
    least = job.with_(batch=1).cost.device
    for more in (0, 2):
        short = voxtool.plan_morph(octree, "close", 3, max_memory=least + more * scratch)
        assert short.plan.batch == 1 + more < job.plan.batch
        assert short.cost.device == least + more * scratch
        assert short.run() == job.run()
    with pytest.raises(voxtool.MemoryLimitError, match="to close by 3 would need"):
        voxtool.plan_morph(octree, "close", 3, max_memory=least - 1).run()


def test_model(device) -> None:
    octree = voxtool.voxelize(model("spot.obj"), dim=48, device=device)
    dense = octree.to_dense()
    for operation in ("erode", "close"):
        found = voxtool.morph(octree, operation, 4, device=device)
        assert np.array_equal(found.to_dense(), morphed(dense, operation, 4, "ball"))


def test_large_empty_space_is_not_examined(device) -> None:
    grid = voxtool.Grid((4096, 4096, 4096), (0, 0, 0), (1, 1, 1))
    octree = Octree.from_voxels([(0, 0, 0), (4095, 4095, 4095), (2000, 2000, 2000)], grid)
    job = voxtool.plan_morph(octree, "dilate", 1, device=device)
    assert job.plan.tiles == 3
    assert job.run().count == 21


def test_tilings_are_sets() -> None:
    dense = RNG.random((40, 20, 33)) < 0.5
    dense[:32, :16, 16:32] = True
    octree = Octree.from_dense(dense)
    voxels, none = Tiling.of(octree, 5), np.zeros(3, np.int64)
    back = voxels.complement().complement()
    assert np.array_equal(back.octree(octree.grid, none).to_dense(), dense)
    assert voxels.octree(octree.grid, none) == octree


@pytest.mark.parametrize(
    ("operation", "radius", "shape", "message"),
    [
        ("grow", 1, "ball", "operation 'grow' is unknown"),
        ("dilate", -1, "ball", "radius -1 is no length"),
        ("dilate", float("nan"), "ball", "radius nan is no length"),
        ("dilate", 0, "ball", "radius 0 is less than one voxel, of 1: give 1 or more, in voxels"),
        ("shell", 0.999, "cube", r"radius 0\.999 is less than one voxel"),
        ("dilate", 129, "ball", "reaches more than the 128 voxels"),
        ("dilate", 1, "disc", "shape 'disc' is unknown"),
    ],
)
def test_refused(operation: str, radius: float, shape: str, message: str) -> None:
    octree = Octree.from_dense(np.ones((8, 8, 8), bool))
    with pytest.raises(voxtool.VoxtoolError, match=message):
        voxtool.plan_morph(octree, operation, radius, shape=shape)


@pytest.mark.parametrize("operation", MORPHOLOGY)
def test_a_length_of_less_than_a_voxel_is_refused(operation: str) -> None:
    """The message gives the pitch, and a radius that is taken and changes something."""
    pitch = (0.1234567, 0.5, 2.0)
    octree = Octree.from_dense(np.pad(np.ones((9, 9, 9), bool), 3), (0, 0, 0), pitch, units="mm")
    words = r"radius 0\.12 is less than one voxel, of 0\.1235 x 0\.5 x 2 mm: give (\S+) or more, "
    with pytest.raises(voxtool.VoxtoolError, match=words) as refused:
        voxtool.plan_morph(octree, operation, 0.12, world=True)
    least = float(re.findall(words, str(refused.value))[0])
    assert pitch[0] <= least < 1.001 * pitch[0]
    found = voxtool.morph(octree, operation, least, world=True)
    assert found.count
    assert operation in ("open", "close") or found.count != octree.count


def test_a_grid_that_would_grow_too_large_is_refused() -> None:
    octree = Octree.from_voxels([(0, 0, 0)], voxtool.Grid((65536, 8, 8), (0, 0, 0), (1, 1, 1)))
    with pytest.raises(voxtool.GridError, match="65552"):
        voxtool.plan_morph(octree, "dilate", 1)


def test_nothing_left_is_a_warning(device) -> None:
    octree = Octree.from_dense(np.ones((8, 8, 8), bool))
    with pytest.warns(voxtool.MeshWarning, match="no voxel is left"):
        assert not voxtool.morph(octree, "erode", 4.0, device=device).count
