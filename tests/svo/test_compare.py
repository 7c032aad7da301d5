"""Differences between octrees, and rows that leak, against dense arrays."""

from __future__ import annotations

import meshes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from svo.test_voxelize import lattice_grid

from voxtool.errors import GridError
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.compare import count_differences, leaking_rows
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import voxelize


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
