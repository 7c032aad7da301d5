"""Octrees as data: made from arrays, compared, kept."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.octree import WORLD, ball, octree_from_dense
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from voxtool.errors import FileError, GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.svo.octree.octree import Octree

SHAPES = st.tuples(*[st.integers(1, 20)] * 3).filter(lambda shape: max(shape) >= 8)


@given(
    dense=SHAPES.flatmap(lambda shape: hnp.arrays(bool, shape)),
    mode=st.sampled_from(["solid", "surface26"]),
)
@settings(max_examples=60)
def test_a_dense_array_and_its_voxels_give_the_canonical_octree(dense, mode: str) -> None:
    expected = octree_from_dense(dense, mode, "none")
    octree = Octree.from_dense(dense, **WORLD, mode=mode)
    octree.validate()
    assert octree.digest() == expected.digest()
    assert np.array_equal(np.asarray(octree), dense)
    voxels = np.argwhere(dense)
    twice = np.concatenate([voxels, voxels[::-1]])
    assert Octree.from_voxels(twice, octree.grid, mode=mode).digest() == octree.digest()


@pytest.mark.parametrize("fill", [True, False])
def test_uniform_arrays_are_the_root_alone(fill: bool) -> None:
    octree = Octree.from_dense(np.full((16, 16, 16), fill))
    assert len(octree.nodes) == 1
    assert (octree.mode, octree.fill, octree.count) == ("solid", "none", 4096 * fill)


def test_voxels_of_a_large_grid_need_no_dense_array() -> None:
    grid = Grid((65536,) * 3, (0, 0, 0), (1, 1, 1))  # pyright: ignore[reportArgumentType]
    voxels = np.array([[0, 0, 0], [65535, 65535, 65535], [40000, 3, 7]])
    octree = Octree.from_voxels(voxels, grid)
    octree.validate()
    assert octree.occupied().tolist() == sorted(voxels.tolist())
    with pytest.raises(MemoryLimitError, match="dense array"):
        np.asarray(octree)


@pytest.mark.parametrize(
    ("voxels", "message"),
    [
        ([[0, 0, 8]], r"voxel \(0, 0, 8\) is not in the grid of 8 x 8 x 8"),
        ([[-1, 0, 0]], "is not in the grid"),
        ([[0.5, 0, 0]], "whole numbers"),
        ([0, 0, 0], "whole numbers"),
    ],
)
def test_voxels_that_are_refused(voxels, message: str) -> None:
    with pytest.raises(GridError, match=message):
        Octree.from_voxels(voxels, Grid((8, 8, 8), (0, 0, 0), (1, 1, 1)))


def test_what_is_no_octree_is_refused() -> None:
    octree = octree_from_dense(ball((16, 16, 16)))
    with pytest.raises(VoxtoolError, match="octree offsets: give a one-dimensional array"):
        replace(octree, offsets=None)
    with pytest.raises(VoxtoolError, match="choose one of surface26"):
        replace(octree, mode="thick")
    with pytest.raises(FileError, match="they end at"):
        replace(octree, nodes=octree.nodes[:-8])
    with pytest.raises(GridError, match="three axes"):
        Octree.from_dense(np.zeros((8, 8)))


def test_octrees_are_values() -> None:
    octree = octree_from_dense(ball((16, 16, 16)))
    other = pickle.loads(pickle.dumps(octree))
    assert octree == other
    assert octree == replace(octree, plan={"a": 1}, units="mm", fill="winding")
    assert octree != replace(octree, grid=replace(octree.grid, pitch=(0.1, 0.1, 0.2)))
    assert octree != "octree"
    bricks = octree.bricks.copy()
    bricks[3] ^= np.uint64(1)
    assert octree != replace(octree, bricks=bricks)
    assert len({octree, other}) == 2  # by identity
    for each in (octree, other):
        with pytest.raises(ValueError, match="read-only"):
            each.nodes["child"] = 0
    assert repr(octree) == "<Octree 16 x 16 x 16, solid by parity, 1,328 voxels, 1.1 kB>"
