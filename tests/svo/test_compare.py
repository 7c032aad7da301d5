"""Counting what octrees differ in, and rows that leak, against dense arrays."""

from __future__ import annotations

import meshes
import numpy as np
import pytest
from conftest import model
from hypothesis import given, settings
from hypothesis import strategies as st

from voxtool.errors import GridError
from voxtool.files.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.compare import count_differences, leaking_rows
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import voxelize


def octree_of(device: Device, pair, shape, mode: str = "solid", fill: str = "parity") -> Octree:
    """Of a mesh in voxels."""
    mesh = Mesh(np.asarray(pair[0], np.float64), np.asarray(pair[1]).astype(np.int32))
    return voxelize(mesh, Grid(shape, (0, 0, 0), (1, 1, 1)), mode, fill=fill, device=device)


def check(one: Octree, other: Octree) -> None:
    a, b = one.to_dense(), other.to_dense()
    expected = int(np.count_nonzero(a & ~b)), int(np.count_nonzero(b & ~a))
    assert count_differences(one, other) == expected
    assert count_differences(other, one) == expected[::-1]
    assert count_differences(one, one) == (0, 0)


def check_rows(octree: Octree) -> None:
    rows = leaking_rows(octree)
    assert rows.tolist() == np.argwhere(octree.to_dense()[-1]).tolist()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_random_triangles(device: Device, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(3, 40, 3))
    if max(shape) < 8:
        shape = (8, *shape[1:])
    octrees = []
    for mode in ("solid", "surface26"):
        vertices, faces = meshes.random_triangles(rng, 3, shape)
        octrees.append(octree_of(device, (vertices / meshes.UNIT, faces), shape, mode))
        check_rows(octrees[-1])
    check(*octrees)


def test_full_and_empty(device: Device) -> None:
    """A grid wholly inside, one wholly outside, one with a ball; none or one of whose roots is
    refined."""
    for side in (8, 32, 20):
        shape = (side,) * 3
        full = octree_of(device, meshes.box(-50, 100), shape)
        empty = octree_of(device, meshes.box(-50, -40), shape)
        ball = octree_of(device, meshes.icosphere(2, side / 2, side / 3), shape)
        assert full.count == side**3
        assert empty.count == 0
        assert count_differences(full, empty) == (side**3, 0)
        for one, other in ((full, empty), (full, ball), (ball, empty)):
            check(one, other)
        for octree in (full, empty, ball):
            check_rows(octree)


def test_an_open_box_leaks_through_its_side(device: Device) -> None:
    shape = (40, 24, 24)
    for missing, leaks in ((0, True), (1, True), (2, False)):
        box = meshes.open_box(8, 16, missing)
        octree = octree_of(device, box, shape)
        check_rows(octree)
        expected = [[y, z] for y in range(8, 16) for z in range(8, 16)] if leaks else []
        assert leaking_rows(octree).tolist() == expected


def test_grids_must_be_the_same(device: Device) -> None:
    one = octree_of(device, meshes.box(1, 5), (8, 8, 8))
    with pytest.raises(GridError, match="of different grids"):
        count_differences(one, octree_of(device, meshes.box(1, 5), (8, 8, 9)))


def test_the_bunny(device: Device) -> None:
    mesh = load_mesh(model("stanford-bunny.obj"))
    grid = Grid.fit(mesh, 128)
    parity, winding = (
        voxelize(mesh, grid, fill=fill, device=device) for fill in ("parity", "winding")
    )
    check(parity, winding)
    check_rows(parity)
    assert len(leaking_rows(parity)) > 0
    assert len(leaking_rows(winding)) == 0
