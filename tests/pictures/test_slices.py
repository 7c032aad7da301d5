"""Slices of octrees show voxels and outline leaves; those of fields show the values drawn."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.field import plain_field, sphere
from helpers.octree import ball, octree_from_dense
from PIL import Image

from voxtool import files
from voxtool.adf.queries.query import FieldQuery
from voxtool.errors import FileError, GridError, VoxtoolError
from voxtool.files.pictures.picture import rounded
from voxtool.opencl import Device
from voxtool.pictures.slices import LINE, draw_field_slice, draw_octree_slice


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
    assert np.array_equal(centres[:, : expected.shape[1]] % LINE > 0, expected)


def test_png_outlines_every_leaf(dense: np.ndarray) -> None:
    octree = octree_from_dense(dense)
    picture = draw_octree_slice(octree, "z", 10)[::-1]
    scale = (picture.shape[1] - 1) // 40
    for level in octree.levels():
        for x, y, z in level.cells[~level.refined | (level.number == 0)]:
            if z <= 10 < z + level.side and x < 40 and y < 33:
                assert picture[y * scale, x * scale] >= LINE


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


def test_a_slice_is_a_picture_and_its_values(device: Device) -> None:
    field = plain_field(sphere, 5e-3, 4, origin=(-1.0, 2.0, 0.5), side=4.0, units="mm")
    picture, answer = draw_field_slice(FieldQuery(field, device), "y", 3.3, size=300)
    assert picture.dtype == np.float32
    assert picture.shape[1:] == (300, 4)
    assert (picture[..., 3] == 1).all()
    count = int(len(answer.distance) ** 0.5)
    plot = rounded(picture)[:, :, :3].reshape(-1, 3).astype(int)
    red = np.count_nonzero(plot[:, 0] > plot[:, 2] + 30)
    inside = np.count_nonzero(answer.distance < 0)
    assert count**2 == len(answer.distance)
    assert 0.8 * inside < red < 1.3 * inside  # the scale is red, too


@pytest.mark.parametrize(
    ("axis", "value", "message"),
    [("w", 1.0, "choose x, y or z"), ("y", 9.0, "lies outside of the cube: choose 2 to 6")],
)
def test_no_such_plane(device: Device, axis: str, value: float, message: str) -> None:
    field = plain_field(sphere, 5e-3, 2, origin=(-1.0, 2.0, 0.5), side=4.0)
    with pytest.raises(VoxtoolError, match=message):
        draw_field_slice(FieldQuery(field, device), axis, value)
