"""Normals of cells: a convolution of the dense array, balls and planes; trimesh reads them."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.octree import ball

import voxtool
from voxtool.errors import VoxtoolError
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.normals import Normals

PITCH = (0.5, 2.0, 1.0)


def normals_of(image: VoxelImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of an image and their normals."""
    normals = Normals(image)
    pieces = [(cells, normals.of(cells)) for cells in image.coordinates()]
    cells, found = zip(*pieces, strict=True)
    return np.concatenate(cells), np.concatenate(found)


def expected(counts: np.ndarray, pitch: tuple[float, float, float]) -> np.ndarray:
    """Return the normals of all cells of a dense array of counts, by shifted copies of it."""
    around = np.pad(counts.astype(np.int64), 2)
    sums = np.zeros((*counts.shape, 3), np.int64)
    binomial = np.array([1, 4, 6, 4, 1])
    for offset in itertools.product(range(5), repeat=3):
        shifted = around[tuple(slice(o, o + n) for o, n in zip(offset, counts.shape, strict=True))]
        for axis, along in enumerate(offset):
            weight = np.array([1, 2, 0, -2, -1])[along]
            weight *= np.prod([binomial[o] for n, o in enumerate(offset) if n != axis])
            sums[..., axis] += weight * shifted
    gradient = sums / np.array(pitch)
    length = np.linalg.norm(gradient, axis=-1, keepdims=True)
    return gradient / np.where(length == 0, 1, length)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("invert", [False, True])
def test_against_a_dense_convolution(level: int, invert: bool) -> None:
    """Also of a part of the grid, whose surroundings count."""
    rng = np.random.default_rng(level)
    dense = ball((37, 20, 29)) & (rng.random((37, 20, 29)) < 0.9)
    octree = voxtool.Octree.from_dense(dense, pitch=PITCH)
    image = VoxelImage.of(octree, level=level, invert=invert, dtype="float64" if level else "bool")
    counts = np.concatenate(list(image.with_dtype("uint16").slabs()))
    all_normals = expected(counts, PITCH)
    for bbox in (None, (5.5, 11.0, 6.0, 13.0, 28.0, 27.0)):
        part = VoxelImage.of(octree, level=level, invert=invert, bbox=bbox, dtype=image.dtype)
        cells, found = normals_of(part)
        assert found.dtype == np.float32
        assert np.abs(found - all_normals[tuple((cells + part.low).T)]).max() < 1e-6


def test_gaps_along_x() -> None:
    """Layers without a cell between those that have some."""
    dense = np.zeros((64, 8, 8), bool)
    dense[21, 3, 3] = dense[22, 3, 4] = dense[60, :, 5] = True
    cells, found = normals_of(VoxelImage.of(voxtool.Octree.from_dense(dense)))
    assert np.abs(found - expected(dense, (1, 1, 1))[tuple(cells.T)]).max() < 1e-6


def test_a_ball() -> None:
    """The normals of its outer layer point along the radius."""
    dense = ball((64, 64, 64))
    cells, found = normals_of(VoxelImage.of(voxtool.Octree.from_dense(dense)))
    depth = np.linalg.norm(cells + 0.5 - 32, axis=1)
    outer = depth > depth.max() - 1
    along = np.einsum("ij,ij->i", found[outer], (cells[outer] + 0.5 - 32) / depth[outer, None])
    angles = np.degrees(np.arccos(np.minimum(along, 1)))
    assert angles.mean() < 4  # 3.4
    assert (found[depth < depth.max() - 5] == 0).all()


def test_planes_and_corners_are_exact() -> None:
    dense = np.zeros((16, 16, 16), bool)
    dense[:, :, :9] = True
    cells, found = normals_of(VoxelImage.of(voxtool.Octree.from_dense(dense)))
    top = (cells[:, 2] == 8) & (abs(cells[:, :2] - 7.5) < 5).all(axis=1)
    assert top.any()
    assert (found[top] == (0, 0, 1)).all()
    corner = found[(cells == (0, 0, 0)).all(axis=1)][0]
    assert np.array_equal(corner, np.full(3, -1 / np.sqrt(3), np.float32))
    alone = np.zeros((8, 8, 8), bool)
    alone[3, 3, 3] = True
    assert (normals_of(VoxelImage.of(voxtool.Octree.from_dense(alone)))[1] == 0).all()


def test_trimesh_reads_them(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(ball((20, 17, 9)), (1.0, 2.0, 3.0), PITCH)
    image = VoxelImage.of(octree, level=1)
    _, normals = normals_of(image)
    voxtool.export(octree, tmp_path / "a.ply", level=1, normals=True)
    cloud: Any = trimesh.load(tmp_path / "a.ply")
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(np.stack([raw[f"n{axis}"].ravel() for axis in "xyz"], axis=1), normals)
    assert np.array_equal(raw["value"].ravel(), np.concatenate([v for _, v in image.listed()]))
    voxtool.export(octree, tmp_path / "a.xyz", level=1, normals=True)
    rows = np.loadtxt(tmp_path / "a.xyz")
    assert np.array_equal(rows[:, :3], cloud.vertices)
    assert np.array_equal(rows[:, 3:].astype(np.float32), normals)
    job = voxtool.plan_export(octree, tmp_path / "b.ply", level=1, normals=True)
    assert 0 <= job.plan.size - job.run() < 200


def test_only_points_have_normals(tmp_path: Path) -> None:
    octree = voxtool.Octree.from_dense(np.ones((8, 8, 8)))
    with pytest.raises(VoxtoolError, match=r"\.vti holds no normals: choose \.ply, \.xyz"):
        voxtool.export(octree, tmp_path / "a.vti", normals=True)
