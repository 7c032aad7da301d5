"""Images of octrees against dense arrays, and octrees of pieces."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from helpers.octree import ball, octree_from_dense

from voxtool.errors import GridError, VoxtoolError
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree import from_pieces
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree

RANDOM = np.random.default_rng(0)
SHAPES = {
    "ball": ball((40, 33, 21)),
    "noise": RANDOM.random((17, 30, 9)) < 0.3,
    "nothing": np.zeros((8, 8, 8), bool),
    "all": np.ones((20, 8, 16), bool),
    "thin": np.ones((1, 1, 8), bool),
}
BOX = (-1, 0.12, -0.2, 1.2, 2.1, 1.7)  # of the world of helpers.octree


def dense_image(dense: np.ndarray, image: VoxelImage) -> np.ndarray:
    """The values of an image, by sums over a dense array."""
    counted = ~dense if image.invert else dense
    s = image.side
    padded = np.pad(counted, [(0, -n % s) for n in dense.shape]).astype(np.int64)
    a, b, c = (n // s for n in padded.shape)
    counts = padded.reshape(a, s, b, s, c, s).sum(axis=(1, 3, 5))
    counts = counts[tuple(slice(n, n + m) for n, m in zip(image.low, image.shape, strict=True))]
    if image.dtype == bool:
        return counts >= Fraction(image.isovalue) * s**3
    return (counts / s**3 if image.dtype.kind == "f" else counts).astype(image.dtype)


@pytest.mark.parametrize("mode", ["solid", "surface26"])
@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_values(name: str, invert: bool, mode: str) -> None:
    """Slabs in every order, lists and blocks hold the same values, at every level, of a part."""
    octree = octree_from_dense(SHAPES[name], mode=mode)
    for level in range(octree.depth + 2):
        for bbox, dtype, isovalue in (
            (None, None, None), (BOX, "uint32", None), (BOX, "bool", None), (None, None, 0.3),
            (BOX, None, 1.0), (None, None, 1e-9),
        ):  # fmt: skip
            if (bbox and name == "thin") or (isovalue and not level):
                continue
            image = VoxelImage.of(
                octree, level=level, bbox=bbox, invert=invert, dtype=dtype, isovalue=isovalue
            )
            wanted = dense_image(SHAPES[name], image)
            for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
                found = np.concatenate(list(image.slabs(order)))
                assert found.dtype == image.dtype
                assert np.array_equal(found, wanted.transpose(order))
            cells = [np.concatenate(part) for part in zip(*image.listed(), strict=True)]
            assert np.array_equal(cells[0], np.argwhere(wanted))
            assert np.array_equal(cells[1], wanted[wanted != 0])
            assert image.count == np.count_nonzero(wanted)
            for side in (4, 16):
                assert np.array_equal(from_blocks(image, side), wanted)


def from_blocks(image: VoxelImage, side: int) -> np.ndarray:
    """The dense array of blocks and cubes, of which no two hold the same cell."""
    sides = np.add(image.all_cells, 2 * side)
    found, seen = np.zeros(sides, image.dtype), np.zeros(sides, int)
    for blocks in image.blocks(side):
        for corner, values in zip(*blocks, strict=True):
            assert values.any()
            place = tuple(slice(n, n + side) for n in corner)
            found[place] = values
            seen[place] += 1
    for cubes in image.cubes(side):
        assert cubes.side >= side
        for corner in cubes.corners:
            place = tuple(slice(n, n + cubes.side) for n in corner)
            found[place] = image.value(image.most)
            seen[place] += 1
    assert seen.max() <= 1
    part = tuple(slice(n, n + m) for n, m in zip(image.low, image.shape, strict=True))
    assert np.count_nonzero(found) == np.count_nonzero(found[part])
    return found[part]


def test_place() -> None:
    octree = octree_from_dense(SHAPES["ball"])
    image = VoxelImage.of(octree, level=2, bbox=(-0.5, 0.5, 0.1, 0.2, 1.5, 1))
    assert (image.low, image.shape, image.side) == ((2, 1, 0), (3, 3, 3), 4)
    assert image.origin == (-1.5 + 0.1 * 8, 0.1 + 0.1 * 4, 0.001)
    assert image.pitch == (0.4, 0.4, 0.4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": 7}, "level 7: choose one from 0 (voxels) to 6 (one cell, of 64 voxels a side)"),
        ({"level": -1}, "level -1: choose one from 0"),
        (
            {"dtype": "uint8", "level": 3},
            "a cell of level 3 has 512 voxels, more than uint8 counts",
        ),
        ({"dtype": "int7"}, "dtype 'int7' is unknown: choose one of bool, uint8"),
        ({"dtype": "complex64"}, "dtype 'complex64' is unknown"),
        ({"isovalue": 0.5}, "an isovalue is a share of a cell: choose a level, too"),
        ({"isovalue": 1.5, "level": 1}, "isovalue 1.5: choose a share of set voxels, above 0 and"),
        ({"isovalue": 0.0, "level": 1}, "isovalue 0.0: choose a share of set voxels"),
        ({"isovalue": np.nan, "level": 1}, "isovalue nan: choose a share of set voxels"),
        (
            {"isovalue": 0.5, "level": 1, "dtype": "float32"},
            "an isovalue makes cells bool, not float32: drop one",
        ),
    ],
)
def test_requests_out_of_range(options: dict, message: str) -> None:
    with pytest.raises(VoxtoolError) as error:
        VoxelImage.of(octree_from_dense(SHAPES["ball"]), **options)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    "box", [(9, 9, 9, 10, 10, 10), (1, 0, 0, 0, 1, 1), (0, 0, 0, 1, 1, np.inf)]
)
def test_boxes_out_of_range(box: tuple) -> None:
    with pytest.raises(GridError, match="box"):
        VoxelImage.of(octree_from_dense(SHAPES["ball"]), bbox=box)


@pytest.mark.parametrize("apart", [from_pieces.APART, 5])
@pytest.mark.parametrize("name", SHAPES)
def test_octree_of_pieces(name: str, apart: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers of any thickness, blocks and cubes make the octree of the dense array."""
    monkeypatch.setattr(from_pieces, "APART", apart)
    dense = SHAPES[name]
    octree = Octree.from_dense(dense)
    for axis in (0, 2):
        for thick in (1, 3, 8):
            collector = Collector(octree.grid)
            for first in range(0, dense.shape[axis], thick):
                corner = np.where(np.arange(3) == axis, first, 0)[None]
                layers = dense.take(range(first, min(first + thick, dense.shape[axis])), axis)
                collector.add_boxes(corner, layers[None])
            assert collector.octree().digest() == octree.digest()
    image = VoxelImage.of(octree)
    for side in (4, 8):
        collector = Collector(octree.grid)
        for blocks in image.blocks(side):
            collector.add_boxes(*blocks)
        for cubes in image.cubes(side):
            collector.add_cubes(*cubes)
        assert collector.octree().digest() == octree.digest()
    collector = Collector(octree.grid)
    collector.add_cubes(np.argwhere(dense), 1)
    assert collector.octree().digest() == octree.digest()


def test_cube_between_cells() -> None:
    """A cube whose corner is no multiple of its side, twice, and one that lies in it."""
    dense = np.zeros((64, 64, 64), bool)
    dense[3:35, 5:37, 1:33] = True
    collector = Collector(Octree.from_dense(dense).grid)
    for side in (32, 32, 8):
        collector.add_cubes(np.array([[3, 5, 1]]), side)
    assert collector.octree() == Octree.from_dense(dense)
    collector.add_cubes(np.array([[60, 60, 60]]), 8)
    with pytest.raises(GridError, match="not in the grid of 64 x 64 x 64"):
        collector.octree()
