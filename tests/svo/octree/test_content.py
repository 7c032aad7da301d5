"""Octrees that are read in blocks from a file: the same answers as in memory, in little memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from voxtool.arrays import digest_of
from voxtool.errors import FileError
from voxtool.files import open_svo, read_svo, write_svo
from voxtool.grid import Grid
from voxtool.svo.octree import content, links
from voxtool.svo.octree.octree import Octree


def octree_of(seed: int, mode: str = "solid", cells: int = 9) -> Octree:
    """Return an octree with full, empty and mixed nodes, whose grid is not a cube."""
    random = np.random.default_rng(seed)
    coarse = random.random((cells, cells + 2, cells - 3)) < random.choice([0.02, 0.5, 0.95])
    dense = np.kron(coarse, np.ones((4, 4, 4), bool))[:-1]
    dense ^= random.random(dense.shape) < random.choice([0, 0.02])
    return Octree.from_dense(dense, mode=mode)


@pytest.fixture(params=[8, 24, 1 << 16])
def blocks(request, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read blocks of so many nodes."""
    monkeypatch.setattr(content, "BLOCK", request.param)
    monkeypatch.setattr(links, "BLOCK", request.param)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("mode", ["solid", "surface26"])
@pytest.mark.parametrize("seed", range(6))
def test_a_file_is_read_as_memory_is(seed: int, mode: str, tmp_path: Path) -> None:
    octree = octree_of(seed, mode)
    write_svo(octree, tmp_path / "a.svo.h5")
    head = {**octree.grid.exact, "mode": mode, "fill": "none"}
    pruned = octree.pruned()
    with open_svo(tmp_path / "a.svo.h5") as stored:
        assert not isinstance(stored.nodes, np.ndarray)
        assert stored.digest() == digest_of(head, octree.offsets, octree.nodes, octree.bricks)
        arrays = pruned.offsets, pruned.nodes, pruned.bricks
        assert stored.set_digest() == digest_of(octree.grid.exact, *arrays)
        assert stored.summary() == octree.summary()
        assert stored.count == np.count_nonzero(octree.to_dense())
        assert sum(stored.count_by_level().values()) == stored.count
        spans = list(stored.walk())
    for level in octree.levels():
        own = [span for span in spans if span.number == level.number]
        sizes = [len(span.nodes) for span in own]
        assert [span.start for span in own] == (np.cumsum(sizes) - sizes).tolist()
        assert max(sizes) <= content.BLOCK
        np.testing.assert_array_equal(np.concatenate([s.nodes for s in own]), level.nodes)
        np.testing.assert_array_equal(np.concatenate([s.codes for s in own]), level.codes)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize(
    ("dataset", "place", "column", "bits", "message"),
    [
        ("nodes", -30, 0, 8, r"octree parent link .*: level 0, node {} is wrong"),
        ("nodes", -30, 1, 8, r"octree brick link .*: level 0, node {} is wrong"),
        ("nodes", 0, 1, 8, "octree child link"),
        ("nodes", 0, 1, 1 << 31, "inside flag of a refined node"),
        ("nodes", 0, 1, 1 << 30, "octree children: 0 refined nodes on level 4"),
        ("bricks", -1, None, 1 << 63, r"octree padding: level 0, node {} has voxels set beyond"),
    ],
)
def test_a_broken_invariant_is_found(
    dataset: str, place: int, column: int | None, bits: int, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.svo.h5"
    octree = octree_of(1)
    write_svo(octree, path)
    with h5py.File(path, "r+") as file:
        values = file[dataset]
        assert isinstance(values, h5py.Dataset)
        at = place if column is None else (place, column)
        values[at] = np.bitwise_xor(values[at], np.array(bits, values.dtype))
    with pytest.raises(FileError, match=message.format(len(octree.bricks) + place)) as found:
        open_svo(path).__enter__()
    with pytest.raises(FileError, match=message.format(len(octree.bricks) + place)) as same:
        read_svo(path)
    assert str(found.value) == str(same.value)


def test_little_memory_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is taken at once is some blocks; the set digest takes some bytes a
    node above the bricks."""
    random = np.random.default_rng(0)
    grid = Grid((512, 512, 512), (0, 0, 0), (1, 1, 1))
    octree = Octree.from_voxels(random.integers(0, 512, (10_000, 3)), grid)
    path = tmp_path / "a.svo.h5"
    write_svo(octree, path)
    for module in content, links:
        monkeypatch.setattr(module, "BLOCK", 256)
    read_svo(path)  # imports modules
    digests = octree.digest(), octree.set_digest()
    tracemalloc.start()
    try:
        with open_svo(path) as stored:
            found = [stored.digest()]
            assert stored.count == octree.count
            blocks = tracemalloc.get_traced_memory()[1]
            found.append(stored.set_digest())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert tuple(found) == digests
    assert blocks < octree.nbytes / 16
    assert peak - blocks < 4 * int(octree.offsets[-2])
