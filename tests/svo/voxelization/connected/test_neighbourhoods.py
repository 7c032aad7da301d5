"""Neighbourhoods against scipy's labels of 3 x 3 x 3 voxels, and parts of meshes."""

from __future__ import annotations

from itertools import product

import numpy as np
from helpers import meshes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from voxtool.svo.voxelization.connected.neighbourhoods import is_simple, separates
from voxtool.svo.voxelization.connected.parts import Shells, contains, meet

FACES = ndimage.generate_binary_structure(3, 1)
EIGHTEEN = ndimage.generate_binary_structure(3, 2)


def answers(dense: np.ndarray) -> tuple[bool, bool]:
    """Return whether the middle voxel is simple, and whether it separates, by definition."""
    others = dense.copy()
    others[1, 1, 1] = False
    outside = ~dense & EIGHTEEN
    outside[1, 1, 1] = False
    labels, _ = ndimage.label(outside, FACES)
    reached = len(set(labels[FACES].tolist()) - {0})
    return ndimage.label(others, np.ones((3, 3, 3)))[1] == 1 and reached == 1, reached > 1


def test_simple_voxels_and_those_that_separate() -> None:
    rng = np.random.default_rng(1)
    shares = rng.choice([0.1, 0.3, 0.5, 0.7, 0.9], (1000, 1, 1, 1))
    dense = rng.random((1000, 3, 3, 3)) < shares
    dense[0], dense[1] = False, True
    dense[:, 1, 1, 1] = True
    bits = np.uint32(1) << np.arange(27, dtype=np.uint32)
    masks = (dense.transpose(0, 3, 2, 1).reshape(-1, 27) * bits).sum(axis=1).astype(np.uint32)
    expected = np.array([answers(one) for one in dense])
    assert np.array_equal(is_simple(masks), expected[:, 0])
    assert np.array_equal(separates(masks), expected[:, 1])
    assert 0.1 < expected[:, 0].mean() < 0.9


def apart(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether a plane lies between two triangles, across the axes of [Gottschalk 1996]."""
    edges = [[t[i] - t[i - 1] for i in range(3)] for t in (one, other)]
    axes = [np.cross(e[0], e[1]) for e in edges]
    axes += [np.cross(a, b) for a, b in product(*edges)]
    for axis in axes:
        p, q = one @ axis, other @ axis
        if p.max() < q.min() or q.max() < p.min():
            return True
    return False


def flat(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two triangles lie in one plane, or one of them in a line."""
    normals = [np.cross(t[1] - t[0], t[2] - t[0]) for t in (one, other)]
    return not all(n.any() for n in normals) or not np.cross(*normals).any()


@settings(max_examples=30)
@given(st.integers(0, 1 << 32), st.sampled_from([2, 5, 200, 1 << 21]))
def test_triangles_that_meet(seed: int, size: int) -> None:
    one, other = np.random.default_rng(seed).integers(-size, size + 1, (2, 12, 3, 3))
    found = meet(one, other)
    for a, b, met in zip(one.astype(object), other.astype(object), found, strict=True):
        if not flat(a, b):
            assert met != apart(a, b)


@given(st.integers(0, 1 << 32))
def test_points_in_boxes(seed: int) -> None:
    """Rays that pass through edges and corners count once."""
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.integers(0, 6, (2, 3)), axis=0)
    vertices, faces = meshes.box(low, high + 1)
    turned = rng.permutation(3)
    vertices = vertices[:, turned]
    low, high = low[turned], (high + 1)[turned]
    for point in rng.integers(-1, 8, (20, 3)):
        on = ((point >= low) & (point <= high)).all() and ((point == low) | (point == high)).any()
        if not on:
            assert contains(vertices[faces], point) == ((point > low) & (point < high)).all()


def test_shells_that_bound_one_part() -> None:
    """Boxes that share a voxel: apart, crossing, a cavity, one in a cavity, two cavities."""
    whole, half = meshes.box([0] * 3, [9] * 3), meshes.box([1] * 3, [4] * 3)
    for boxes, parts in (
        ((half, meshes.box([5] * 3, [8] * 3)), 2),
        ((half, meshes.box([2, 2, 0], [3, 3, 9])), 1),
        ((whole, half), 1),
        ((whole, meshes.box([1] * 3, [8] * 3), meshes.box([2] * 3, [3] * 3)), 2),
        ((whole, half, meshes.box([5] * 3, [8] * 3)), 1),
    ):
        mesh = meshes.mesh_of(*meshes.join(*boxes))
        faces = np.arange(len(mesh.faces))
        shells = Shells(mesh, mesh.vertices.astype(np.int32))
        assert shells.several
        assert len(set(shells.united(np.zeros_like(faces), faces)[shells.of].tolist())) == parts
        assert len(set(shells.united(faces, faces)[shells.of].tolist())) == len(boxes)
