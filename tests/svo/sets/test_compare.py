"""Differences between octrees, and rows that leak, against dense arrays."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st
from svo.voxelization.test_voxelize import lattice_grid

from voxtool.errors import GridError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.compare import bounding_box, compare, count_differences, leaking_rows
from voxtool.svo.voxelization.voxelize import voxelize


def check(one: Octree, other: Octree) -> None:
    a, b = one.to_dense(), other.to_dense()
    expected = int(np.count_nonzero(a & ~b)), int(np.count_nonzero(b & ~a))
    assert count_differences(one, other) == expected
    assert count_differences(other, one) == expected[::-1]
    assert count_differences(one, one) == (0, 0)
    assert leaking_rows(one).tolist() == np.argwhere(a[-1]).tolist()


@given(seed=st.integers(0, 1 << 32), side=st.sampled_from([1, 4, 8]))
@settings(max_examples=30)
def test_octrees_against_dense_arrays(seed: int, side: int) -> None:
    """Voxels and aligned boxes, whose octrees have leaves of all sizes."""
    rng = np.random.default_rng(seed)
    shape = np.maximum(rng.integers(3, 40, 3), (8, 3, 3))
    dense = []
    for share in (0.1, 0.5):
        boxes = rng.random(-(-shape // side)) < share
        boxes = np.kron(boxes, np.ones((side,) * 3, bool)).astype(bool)
        dense.append(boxes[tuple(map(slice, shape))])
    one, other = dense
    octrees = [Octree.from_dense(one), Octree.from_dense(one | other)]
    check(*octrees)
    check(octrees[1], Octree.from_dense(other, mode="surface26"))


@pytest.mark.parametrize("side", [8, 32, 20])
def test_full_and_empty(side: int) -> None:
    """Octrees whose roots are not refined, and one with a single voxel."""
    full = Octree.from_dense(np.ones((side,) * 3))
    empty = Octree.from_dense(np.zeros((side,) * 3))
    voxel = Octree.from_voxels([[side - 1, 1, 2]], full.grid)
    assert count_differences(full, empty) == (side**3, 0)
    for one, other in ((full, empty), (full, voxel), (voxel, empty)):
        check(one, other)


def test_an_open_box_leaks_through_its_side(device: Device) -> None:
    for missing, leaks in ((0, True), (1, True), (2, False)):
        vertices, faces = meshes.open_box(8, 16, missing)
        mesh = Mesh(np.asarray(vertices, np.float64), faces.astype(np.int32))
        octree = voxelize(mesh, lattice_grid((40, 24, 24)), fill="parity", device=device)
        expected = [[y, z] for y in range(8, 16) for z in range(8, 16)] if leaks else []
        assert leaking_rows(octree).tolist() == expected


def test_grids_must_be_the_same() -> None:
    one, other = (Octree.from_dense(np.ones((8, 8, n))) for n in (8, 9))
    with pytest.raises(GridError, match="of different grids"):
        count_differences(one, other)


@given(seed=st.integers(0, 1 << 32))
@settings(max_examples=15)
def test_comparison_against_dense_arrays(device: Device, seed: int) -> None:
    """Random sets and boxes, of grids whose origins are some voxels apart."""
    rng = np.random.default_rng(seed)
    low = tuple((rng.integers(-9, 10, 3) * rng.integers(2)).tolist())
    arrays = []
    for _ in range(2):
        shape, share = rng.integers((8, 3, 3), 30), rng.choice([0.0, 0.001, 0.5, 1.0])
        arrays.append(rng.random(shape) < share)
    a, b = (
        Octree.from_dense(array, o, 1.0) for array, o in zip(arrays, ((0, 0, 0), low), strict=True)
    )
    found = compare(a, b, device=device)
    first, second = (
        {tuple(v) for v in np.argwhere(x) + o} for x, o in zip(arrays, (0, low), strict=True)
    )
    summary, shift = found.summary(), found.both.grid.origin
    for name, expected in (
        ("only_first", first - second), ("only_second", second - first), ("both", first & second),
    ):  # fmt: skip
        part = summary[name]
        assert part["voxels"] == part["volume"] == len(expected)
        if expected:
            voxels = np.array(sorted(expected))
            box = np.stack([voxels.min(axis=0), voxels.max(axis=0) + 1])
            assert part["bounds"] == box.tolist()
            assert part["box"] == (box - shift).tolist()
        else:
            assert part["bounds"] is part["box"] is None
    assert summary["equal"] == found.equal == (first == second)
    assert summary["jaccard"] == (
        len(first & second) / len(first | second) if first | second else 1
    )
    assert (found.first | found.second) == a ^ b


def test_a_bounding_box_across_levels() -> None:
    voxels = np.zeros((64, 64, 64), bool)
    voxels[32:64, :32, :32] = True  # a leaf of 32 voxels
    voxels[30, 40, 63] = True
    box = bounding_box(Octree.from_dense(voxels))
    assert box is not None
    assert box.tolist() == [[30, 0, 0], [64, 41, 64]]
