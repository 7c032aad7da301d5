"""Labels of components against scipy's, in memory and in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.morphology import scenes, sizes_of
from scipy import ndimage

import voxtool
from voxtool.choices import NEIGHBOURS
from voxtool.files.formats import IMAGES
from voxtool.svo.octree.from_pieces import Collector
from voxtool.svo.octree.octree import Octree

WORLD: dict[str, Any] = {"origin": (-3.5, 7, 100.25), "pitch": (0.5, 0.25, 2)}
RNG = np.random.default_rng(8)


@pytest.mark.parametrize("neighbours", NEIGHBOURS)
def test_labels_are_those_of_scipy(neighbours: int) -> None:
    for name, dense in scenes().items():
        found = voxtool.components(Octree.from_dense(dense, **WORLD), neighbours)
        labels = found.to_dense()
        assert np.array_equal(labels > 0, dense), name
        assert np.array_equal(np.bincount(labels.ravel())[1:], found.sizes), name
        assert np.array_equal(found.sizes, sizes_of(dense, neighbours)), name
        structure = ndimage.generate_binary_structure(3, NEIGHBOURS.index(neighbours) + 1)
        theirs = np.asarray(ndimage.label(dense, structure)[0])  # pyright: ignore
        pairs = np.unique(np.stack([labels[dense], theirs[dense]]), axis=1)
        assert pairs.shape[1] == len(found), name  # each is one of theirs
        boxes = [[(a.start, a.stop) for a in box] for box in ndimage.find_objects(labels)]
        expected = np.array(boxes, int).reshape(-1, 3, 2).transpose(0, 2, 1)
        assert np.array_equal(found.boxes, expected), name
        numbers = np.arange(1, len(found) + 1)
        means = np.reshape(ndimage.center_of_mass(labels, labels, numbers), (-1, 3))
        centers = (means + 0.5) * WORLD["pitch"] + WORLD["origin"]
        assert np.allclose(found.centers, centers, rtol=0, atol=1e-12), name


def test_slabs_run_along_any_axis() -> None:
    found = voxtool.components(Octree.from_dense(scenes()["leaves"]))
    assert len(found) == 3
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        slabs = np.concatenate(list(found.slabs(order)))
        assert np.array_equal(slabs, found.to_dense().transpose(order))


def test_the_type_is_the_smallest() -> None:
    for count, dtype in ((0, "uint8"), (255, "uint8"), (256, "uint16")):
        dense = np.zeros((16, 32, 32), bool)
        dense[::2, ::2, ::2].flat[:count] = True
        found = voxtool.components(Octree.from_dense(dense))
        assert (len(found), found.dtype) == (count, dtype)
        assert found.to_dense().max() == count


def test_sums_do_not_overflow() -> None:
    """The largest component there is: all of the largest grid but a corner."""
    grid = voxtool.Grid((65536, 65536, 65536), (0, 0, 0), (1, 1, 1))
    collector = Collector(grid)
    collector.add_cubes(np.zeros((1, 3), np.int64), grid.side)
    found = voxtool.components(collector.octree() - Octree.from_voxels([(65535, 0, 0)], grid))
    assert found.sizes.tolist() == [65536**3 - 1]
    assert np.allclose(found.centers, 32768, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", sorted(IMAGES))
def test_labels_in_files(name: str, tmp_path: Path) -> None:
    dense = RNG.random((13, 9, 20)) < 0.3
    found = voxtool.components(Octree.from_dense(dense, **WORLD))
    labels, path = found.to_dense(), tmp_path / f"labels.{name}"
    assert found.dtype == np.uint8
    voxtool.export(found, path)
    for label in (1, 2, len(found)):
        held = voxtool.read_voxels(path, label=label)
        assert np.array_equal(held.to_dense(), labels == label)
        assert name == "npy" or held.grid == found.octree.grid


def test_refused(tmp_path: Path) -> None:
    octree = Octree.from_dense(RNG.random((40, 40, 40)) < 0.5)
    with pytest.raises(voxtool.MemoryLimitError, match="components would need"):
        voxtool.components(octree, max_memory=1000)
    with pytest.raises(voxtool.VoxtoolError, match="neighbours 8: choose one of 6, 18, 26"):
        voxtool.components(octree, 8)
    found = voxtool.components(octree)
    with pytest.raises(voxtool.VoxtoolError, match=r"\.vox holds no labels: choose \.npy, \.npz"):
        voxtool.export(found, tmp_path / "a.vox")
    with pytest.raises(voxtool.VoxtoolError, match="labels take no level"):
        voxtool.export(found, tmp_path / "a.npy", level=1)
