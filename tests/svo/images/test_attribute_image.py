"""Attributes of images: slabs, lists and blocks hold the values of the cells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed

from voxtool.morton import morton_encode
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.images.attribute_image import AttributeImage
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.attributes import KINDS

PARTS: list[dict[str, Any]] = [
    {},
    {"bbox": (3, 9, 1, 30, 27, 15)},
    {"level": 1},
    {"level": 1, "bbox": (3, 9, 1, 30, 27, 15), "isovalue": 0.6},
    {"level": 2},
    {"level": 4, "dtype": "float64"},
    {"level": 6},
]


def image_of(name: str, **part: Any) -> AttributeImage:
    return AttributeImage(VoxelImage.of(attributed(), **part), name)


def dense_of(found: AttributeImage) -> np.ndarray:
    """All values of an attribute of an image, from the values of the root's cells."""
    image, octree = found.image, found.octree
    cells = CellValues(octree, found.name, image.level)
    values = cells.of_cells(octree.depth - 1, np.zeros(1, np.int64))[0]
    if found.name == "label":
        values = values.astype(np.uint8) + np.uint8(1)
    low = np.array(image.low)
    codes = morton_encode(low + np.indices(image.shape).reshape(3, -1).T).reshape(image.shape)
    occupied = np.concatenate(list(image.slabs())) != 0
    return np.where(occupied.reshape(*occupied.shape, *(1,) * len(found.row)), values[codes], 0)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("part", PARTS, ids=str)
def test_slabs_and_lists_hold_the_values_of_cells(name: str, part: dict[str, Any]) -> None:
    found = image_of(name, **part)
    dense = dense_of(found)
    assert found.dtype == dense.dtype
    assert found.nbytes == dense.nbytes
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        rest = tuple(range(3, dense.ndim))
        slabs = np.concatenate(list(found.slabs(order)))
        assert np.array_equal(slabs, dense.transpose(*order, *rest))
    image = found.image
    listed = list(zip(image.listed(), found.listed(), strict=True))
    cells = np.concatenate([cells for (cells, _), _ in listed])
    values = np.concatenate([values for _, values in listed])
    assert np.array_equal(values, dense[tuple(cells.T)])
    assert len(cells) == np.count_nonzero(np.concatenate(list(image.slabs())))


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("part", PARTS[:4], ids=str)
def test_blocks_and_cubes_hold_the_values_of_cells(name: str, part: dict[str, Any]) -> None:
    found = image_of(name, **part)
    low, shape = np.array(found.image.low), found.shape
    dense, mine = dense_of(found), np.zeros_like(dense_of(found))
    for cubes in found.cubes(4):
        for corner, value in zip(cubes.corners - low, cubes.values, strict=True):
            mine[tuple(slice(n, n + cubes.side) for n in corner)] = value
    for corners, values in found.blocks(4):
        for corner, block in zip(corners - low, values, strict=True):
            first = np.maximum(-corner, 0)
            kept = block[tuple(map(slice, first, np.minimum(4, shape - corner)))]
            mine[tuple(map(slice, corner + first, corner + first + kept.shape[:3]))] = kept
    assert np.array_equal(mine, dense)


def test_labels_count_from_one() -> None:
    found = image_of("label")
    assert found.names == ("", "head", "größe", "a b")
    octree = attributed()
    label = replace(octree.attribute("label"), names=tuple(map(str, range(300))))
    many = replace(octree, attributes=(label,))
    assert AttributeImage(VoxelImage.of(many), "label").dtype == np.uint16
