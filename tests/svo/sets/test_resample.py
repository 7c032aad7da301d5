"""Resampling against coverages computed with fractions, on dense arrays."""

from __future__ import annotations

import math
from fractions import Fraction as F
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import model

import voxtool
from voxtool.grid import Grid
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.resample import Steps, simplest

RNG = np.random.default_rng(5)
# Sizes and origins of the new voxels in the old ones, as they are meant, and the new shape.
PLACES = {
    "same": ((1, 1, 1), (0, 0, 0), (13, 9, 16)),
    "twice": ((2, 2, 2), (0, 0, 0), (8, 8, 8)),
    "half": ((F(1, 2),) * 3, (0, 0, 0), (26, 18, 32)),
    "three halves": ((F(3, 2),) * 3, (F(-1, 2), 1, F(1, 4)), (9, 8, 11)),
    "thirds": ((F(2, 3), F(4, 3), 1), (F(1, 3), 0, -3), (18, 7, 20)),
    "tenths": ((F(7, 10), F(13, 10), F(1, 10)), (F(-1, 10), F(1, 5), 7), (20, 8, 33)),
    "large": ((7, 20, 5), (-3, -2, 1), (8, 1, 3)),
}


def scene() -> np.ndarray:
    dense = RNG.random((13, 9, 16)) < 0.5
    dense[4:12, 0:8, 8:16] = True
    dense[:4, :, :8] = False
    return dense


def coverages(dense: np.ndarray, ratio: Any, start: Any, shape: Any) -> np.ndarray:
    """Return the covered shares of the voxels of a grid, as fractions."""
    found = dense.astype(object)
    for axis in range(3):
        low = [F(start[axis]) + F(ratio[axis]) * n for n in range(shape[axis] + 1)]
        weights = np.array(
            [
                [max(F(0), min(F(i + 1), b) - max(F(i), a)) for i in range(dense.shape[axis])]
                for a, b in pairwise(low)
            ]
        )
        found = np.moveaxis(np.tensordot(weights, found, (1, axis)), 0, axis)
    return found / math.prod(map(F, ratio))


@pytest.mark.parametrize("place", PLACES)
def test_coverage_is_decided_exactly(device, place: str) -> None:
    """Also where the numbers are rounded: at pitches of 0.1."""
    ratio, start, shape = PLACES[place]
    dense = scene()
    octree = Octree.from_dense(dense, (0.3, -7, 0), 0.1)
    origin = [o + 0.1 * float(s) for o, s in zip(octree.grid.origin, start, strict=True)]
    grid = Grid(shape, tuple(origin), tuple(0.1 * float(r) for r in ratio))  # pyright: ignore
    shares = coverages(dense, ratio, start, shape)
    for threshold in (0.5, 0.3, 1.0, 1e-9):
        job = voxtool.plan_resample(octree, grid, threshold=threshold, device=device)
        result = job.run()
        result.validate()
        assert job.plan.exact
        assert np.array_equal(result.to_dense(), shares >= F(repr(threshold))), threshold


def test_a_ratio_that_is_no_small_fraction(device) -> None:
    ratio, start, shape = (math.sqrt(2), math.e / 2, 1 / math.pi), (-0.3, 0.01, math.pi), (9, 8, 30)
    dense = scene()
    octree = Octree.from_dense(dense)
    job = voxtool.plan_resample(octree, Grid(shape, start, ratio), device=device)
    assert not job.plan.exact
    shares = coverages(dense, ratio, start, shape)
    assert np.array_equal(job.run().to_dense(), shares >= F(1, 2))


def test_a_model_at_half_its_dim(device) -> None:
    octree = voxtool.voxelize(model("spot.obj"), dim=64, device=device)
    dense = octree.to_dense()
    coarse = voxtool.resample(octree, dim=32, device=device)
    counts = dense.reshape(32, 2, 32, 2, 32, 2).sum(axis=(1, 3, 5))
    assert np.array_equal(coarse.to_dense(), counts >= 4)
    assert coarse.grid.pitch == tuple(2 * p for p in octree.grid.pitch)
    assert voxtool.resample(octree, dim=64, device=device) == octree  # the same grid, too
    fine = voxtool.resample(octree, pitch=octree.grid.pitch[0] / 2, device=device)
    assert fine.count == 8 * octree.count
    low, high = octree.grid.to_world(np.array([(8, 20, 4), (40, 60, 36)]))
    part = voxtool.resample(octree, bbox=[*low, *high], device=device)
    assert np.array_equal(part.to_dense(), dense[8:40, 20:60, 4:36])


def test_large_empty_space_is_not_examined(device) -> None:
    grid = Grid((65536, 65536, 65536), (0, 0, 0), (1, 1, 1))
    two = Octree.from_voxels([(0, 0, 0), (65535, 65535, 65535)], grid)
    job = voxtool.plan_resample(two, dim=32768, threshold=0.125, device=device)
    assert job.plan.bricks == 16
    assert job.run().occupied().tolist() == [[0, 0, 0], [32767, 32767, 32767]]


def test_grids_far_apart(device) -> None:
    octree = Octree.from_dense(np.ones((8, 8, 8), bool))
    with pytest.warns(voxtool.MeshWarning, match="no voxel is set: none has a share of 0.5"):
        far = voxtool.resample(octree, Grid((8, 8, 8), (1e80, 0, 0), (1, 1, 1)), device=device)
    assert far.count == 0


def test_fractions() -> None:
    assert simplest(F(14, 10), F(16, 10)) == F(3, 2)
    assert simplest(F(-4, 3), F(-5, 4)) == F(-4, 3)
    assert simplest(F(-1, 9), F(1, 9)) == 0
    assert simplest(F(31, 10), F(32, 10)) == F(16, 5)
    rounded = Steps.of(0, Grid((8,) * 3, 0, 1), Grid((9,) * 3, 0, math.pi), 9)  # pyright: ignore
    assert not rounded.exact
    assert np.abs(rounded.planes / rounded.unit - np.arange(10) * math.pi).max() < 2**-18
    assert set(np.diff(rounded.planes) - rounded.least) <= {0, 1}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({}, "to what\\? Give a dim"),
        ({"dim": 32, "pitch": 1}, "dim and pitch both set"),
        ({"dim": 32, "threshold": 0}, "threshold 0 is no share"),
        ({"dim": 32, "threshold": 1.5}, "threshold 1.5 is no share"),
        ({"dim": 7}, "dim 7 is out of range"),
        ({"grid": Grid((8, 8, 8), (0, 0, 0), (1e6, 1, 1))}, "more than 65536 times"),
        ({"grid": Grid((8, 8, 8), (0, 0, 0), (1, 1, 1)), "dim": 8}, "a grid has its own dim"),
    ],
)
def test_refused(words: dict[str, Any], message: str) -> None:
    octree = Octree.from_dense(np.ones((8, 8, 8), bool))
    with pytest.raises(voxtool.VoxtoolError, match=message):
        voxtool.plan_resample(octree, **words)


def test_memory_is_planned() -> None:
    octree = Octree.from_dense(RNG.random((40, 40, 40)) < 0.5)
    with pytest.raises(voxtool.MemoryLimitError, match=r"need .*choose a larger pitch"):
        voxtool.resample(octree, dim=2000, max_memory=400_000)
