"""Merged subtrees: the same octree, held against hash-consing in Python; files of them."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.files import DATA, changed_h5, edited, stored
from helpers.merged import EXTREMES, OCTREES, random_octree
from helpers.octree import WORLD, ball, golden_octree, octree_from_dense

from voxtool.errors import FileError, MemoryLimitError
from voxtool.files import open_svo, read_svo, write_svo
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.svo.dag import merged as merging
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree import content, links
from voxtool.svo.octree.layout import INSIDE, LINK, VALID
from voxtool.svo.octree.octree import Octree


def consed(octree: Octree) -> tuple[object, list[int]]:
    """An octree as nested tuples, and the number of distinct refined nodes of each level, root
    first, and of distinct bricks that are neither empty nor full."""
    distinct: list[set[object]] = [set() for _ in range(octree.depth)]

    def subtree(d: int, index: int) -> object:
        word = int(octree.nodes["child"][int(octree.offsets[d]) + index])
        if d == octree.depth - 1:
            brick = int(octree.bricks[word & LINK])
            if brick in (0, (1 << 64) - 1):
                return "full" if brick else "empty"
            found: object = brick
        elif word & VALID:
            found = tuple(subtree(d + 1, (word & int(LINK)) + c) for c in range(8))
        else:
            return "full" if word & INSIDE else "empty"
        distinct[d].add(found)
        return found

    return subtree(0, 0), [len(found) for found in distinct]


@pytest.mark.parametrize("name", OCTREES)
def test_equal_subtrees_are_stored_once(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    octree = OCTREES[name]()
    for module in content, links, merging:
        monkeypatch.setattr(module, "BLOCK", 64)
    merged = MergedOctree.of(octree)
    merged.validate()
    assert merged.sizes == consed(octree)[1]
    summary, plain = merged.summary(), octree.summary()
    assert [row.pop("subtrees") for row in summary["levels"]] == merged.sizes
    assert summary.pop("subtrees") == sum(merged.sizes)
    size = summary.pop("merged_bytes")
    assert summary == plain
    assert (merged.digest(), merged.set_digest()) == (octree.digest(), octree.set_digest())
    back = merged.expanded()
    back.validate()
    assert back.digest() == octree.digest()
    write_svo(merged, tmp_path / "a.svo.h5")
    with h5py.File(tmp_path / "a.svo.h5") as h5:
        assert h5.attrs["format_version"] == b"2.0"
        tables = [h5[table] for table in ("starts", "masks", "links", "leaves")]
        assert sum(table[()].nbytes for table in tables) == size  # pyright: ignore
    with open_svo(tmp_path / "a.svo.h5") as found:
        assert isinstance(found, MergedOctree)
        assert found == merged
    read = read_svo(tmp_path / "a.svo.h5")
    assert read.digest() == octree.digest()
    assert (read.plan, read.units, read.source_sha256) == (octree.plan, octree.units, "")


def test_sizes_of_known_shapes() -> None:
    """A checkerboard is one subtree a level, and a full cube is none."""
    sizes = {name: MergedOctree.of(octree_from_dense(dense)).sizes
             for name, dense in EXTREMES.items()}  # fmt: skip
    assert sizes["checkerboard"] == [1, 1, 1, 1]
    assert sizes["full"] == sizes["empty"] == [0, 0, 0]
    assert sizes["one voxel"] == [1, 1, 1, 1, 1]


def test_a_merged_octree_of_2_to_the_42_bricks() -> None:
    """Counts need no octree; the octree that it stands for is refused."""
    grid = Grid((65536, 65536, 65536), (0, 0, 0), (1, 1, 1))
    masks, links_of = np.full(14, 255, np.uint16), np.zeros(14 * 8, np.uint32)
    merged = MergedOctree(
        grid, "solid", "none", 2, np.arange(15, dtype=np.uint32), masks, links_of,
        np.array([0x6996966996696996], np.uint64),
    )  # fmt: skip
    merged.validate()
    assert merged.count == 65536**3 // 2
    assert merged.summary()["bricks"] == 2**42
    assert merged.merged_bytes < 300
    with pytest.raises(MemoryLimitError, match="which exceed links of 30 bits"):
        merged.expanded()


def test_golden_file() -> None:
    """tests/data/v2.0.svo.h5 was written once, by write_svo."""
    octree = golden_octree()
    with open_svo(DATA / "v2.0.svo.h5") as merged:
        assert isinstance(merged, MergedOctree)
        assert merged.digest() == octree.digest()
        assert merged == MergedOctree.of(octree)
        assert (merged.plan, merged.units) == (octree.plan, octree.units)


def test_digests_need_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in content, links, merging:
        monkeypatch.setattr(module, "BLOCK", 256)
    random = np.random.default_rng(0)
    grid = Grid((512, 512, 512), (0, 0, 0), (1, 1, 1))
    octree = Octree.from_voxels(random.integers(0, 512, (20_000, 3)), grid)
    merged = MergedOctree.of(octree)
    tracemalloc.start()
    try:
        assert merged.digest() == octree.digest()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < octree.nbytes / 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edited("links", slice(None), 255), r"level \d has a link beyond the \d+ subtrees"),
        (edited("links", slice(0, 2), 1), "subtrees: one occurs nowhere"),
        (edited("masks", 0, 0xFFFF), "has a link and is full|which are not those"),
        (edited("masks", 0, 1), "which are not those of its subtrees"),
        (edited("masks", slice(None), 0), "which are not those of its subtrees"),
        (edited("leaves", 0, 0), "they ascend, and none is empty or full"),
        (edited("leaves", slice(0, 2), 7), "they ascend, and none is empty or full"),
        (lambda h5: h5.attrs.modify("shape", (19, 16, 10)), "voxels are set beyond the grid"),
        (edited("starts", 1, 0), "refined if the first level has one subtree"),
        (edited("starts", 0, 1), "which are not those of its subtrees"),
        (edited("starts", -1, 1 << 31), "which are not those|they end at|link beyond"),
        (stored("starts", lambda a: a[:-1]), "dataset starts has shape"),
        (stored("links", lambda a: a[:-1]), "which are not those of its subtrees"),
        (stored("links", lambda a: np.append(a, a[:1])), "which are not those of its subtrees"),
        (stored("masks", lambda a: a.astype(np.uint32)), "masks is not of type uint16"),
        (stored("leaves", lambda a: np.append(a, a[-1:] + 1)), "occurs nowhere|beyond the grid"),
        (lambda h5: h5.attrs.modify("root", 1), "refined if the first level has one subtree"),
        (lambda h5: h5.attrs.modify("root", 3), "attribute root"),
        (lambda h5: h5.attrs.modify("depth", 5), "attribute depth"),
    ],
)  # fmt: skip
def test_hostile_files_are_refused(change: Callable, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.svo.h5"
    write_svo(MergedOctree.of(octree_from_dense(ball((19, 16, 11)))), path)
    changed_h5(path, change)
    with pytest.raises(FileError, match=message) as found:
        open_svo(path).__enter__()
    with pytest.raises(FileError, match=message) as same:
        read_svo(path)
    assert str(found.value) == str(same.value)
    assert str(path) in str(found.value)


def test_inside_flags_of_a_surface_are_refused() -> None:
    merged = MergedOctree.of(octree_from_dense(np.pad(np.ones((8, 8, 8), bool), 4)))
    surface = MergedOctree(
        merged.grid, "surface6", "none", 2, merged.starts, merged.masks, merged.links,
        merged.leaves,
    )  # fmt: skip
    surface.validate()  # full bricks may be in a surface
    cube = MergedOctree.of(octree_from_dense(np.pad(np.ones((8, 8, 8), bool), ((0, 8),) * 3)))
    wrong = MergedOctree(
        cube.grid, "surface6", "none", 2, cube.starts, cube.masks, cube.links, cube.leaves
    )
    with pytest.raises(FileError, match="inside flag of a surface"):
        wrong.validate()


def test_extents_agree_with_the_occupied_voxels() -> None:
    """Padding is found by the extent of the set voxels: a grid of one voxel less is refused."""
    for seed in range(6):
        octree = random_octree(seed)
        merged, end = MergedOctree.of(octree), octree.occupied().max(axis=0) + 1
        for a in range(3):
            for shape, sound in ((end, True), (end - np.eye(3, dtype=int)[a], False)):
                own = np.maximum(shape, 1)
                own[(a + 1) % 3] = max(own[(a + 1) % 3], octree.grid.dim)
                grid = Grid(tuple(own.tolist()), **WORLD)
                if grid.side != octree.grid.side or (own < shape).any():
                    continue
                tables = merged.starts, merged.masks, merged.links, merged.leaves
                found = MergedOctree(grid, "solid", "none", merged.root, *tables)
                if sound:
                    found.validate()
                else:
                    with pytest.raises(FileError, match="beyond the grid's shape"):
                        found.validate()


def test_codes_of_children_are_morton_codes() -> None:
    """Child c lies at the place of Morton code c: what the extents of subtrees are made of."""
    for c, corner in enumerate(morton_decode(np.arange(8))):
        dense = np.zeros((16, 16, 16), bool)
        dense[tuple(8 * corner)] = True
        merged = MergedOctree.of(octree_from_dense(dense))
        assert merged.level(0)[0].tolist() == [1 << c]


def test_links_beyond_30_bits_leave_flags_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if links had six bits: the nodes are the same, but for the higher bits of their links."""
    octree = random_octree(2)
    states = links.level_states(octree.offsets, octree.nodes)[::-1]
    monkeypatch.setattr(links, "LINK", np.uint32(63))
    found = np.concatenate(list(links.nodes_of(states)))
    assert len(found) > 128
    for name in "parent", "child":
        np.testing.assert_array_equal(found[name], octree.nodes[name] & ~(LINK - np.uint32(63)))
