"""A slice of an octree shows its voxels and outlines its leaves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_octree import ball, octree_from_dense
from PIL import Image

from voxtool import files
from voxtool.errors import FileError, GridError
from voxtool.plots import octree_slice


@pytest.fixture
def dense() -> np.ndarray:
    return ball((40, 33, 21))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_png_shows_the_slice(dense: np.ndarray, tmp_path: Path, axis: str) -> None:
    path = tmp_path / "a.png"
    files.export(octree_from_dense(dense), path, axis=axis, value=10)
    expected = np.take(dense, 10, "xyz".index(axis)).T[::-1]  # right, up
    with Image.open(path) as picture:
        pixels = np.array(picture)
    scale = round(1024 / max(expected.shape))
    assert pixels.shape == tuple(n * scale + 1 for n in expected.shape)
    # its lowest row closes the frame at the top, so voxels start one pixel lower
    centres = pixels[1 + scale // 2 :: scale, scale // 2 :: scale][: expected.shape[0]]
    assert np.array_equal(centres[:, : expected.shape[1]] % octree_slice.LINE > 0, expected)


def test_png_outlines_every_leaf(dense: np.ndarray) -> None:
    octree = octree_from_dense(dense)
    picture = octree_slice.draw_octree_slice(octree, "z", 10)[::-1]
    scale = (picture.shape[1] - 1) // 40
    for level in octree.levels():
        for x, y, z in level.cells[~level.refined | (level.number == 0)]:
            if z <= 10 < z + level.side and x < 40 and y < 33:
                assert picture[y * scale, x * scale] >= octree_slice.LINE


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axis": "z", "value": 21}, "slice z=21 lies outside the grid: choose 0 to 20"),
        ({"axis": "x", "value": -1}, "slice x=-1 lies outside"),
        ({"axis": "w"}, "axis 'w' is unknown: choose x, y or z"),
    ],
)
def test_png_refuses_a_slice_outside(dense, tmp_path, options, message) -> None:
    with pytest.raises(GridError, match=message):
        files.export(octree_from_dense(dense), tmp_path / "a.png", **options)
    assert list(tmp_path.iterdir()) == []


def test_png_without_pillow_names_the_extra(dense, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(FileError, match=r"pip install 'voxtool\[pictures\]'"):
        files.export(octree_from_dense(dense), tmp_path / "a.png")
