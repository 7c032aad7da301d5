"""Pictures of merged octrees are those of the octrees that they stand for, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.merged import OCTREES
from helpers.octree import ball, octree_from_dense

from voxtool.errors import MemoryLimitError
from voxtool.opencl import Device
from voxtool.pictures.rendering import camera_for, plan_render
from voxtool.svo.cells import ray_links
from voxtool.svo.cells.ray_links import box_of, cover_of, drawn_bytes, linked_nodes
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.pictures.raycast import OctreeScene


def solid_ball(radius: float = 0.42) -> Octree:
    return octree_from_dense(ball((64, 64, 64), radius))


@pytest.mark.parametrize("name", OCTREES)
def test_a_merged_octree_covers_the_same_space(name: str) -> None:
    octree = OCTREES[name]()
    merged = MergedOctree.of(octree)
    if octree.count:
        for one, other in zip(box_of(merged), box_of(octree), strict=True):
            np.testing.assert_array_equal(one, other)
    for number in range(octree.depth):
        found, expected = (list(cover_of(each, number)) for each in (merged, octree))
        assert [side for _, side in found] == [side for _, side in expected]
        for (cells, _), (others, _) in zip(found, expected, strict=True):
            np.testing.assert_array_equal(cells, others)
    np.testing.assert_array_equal(OctreeScene(merged).points(), OctreeScene(octree).points())


@pytest.mark.filterwarnings("ignore:the picture is empty")
@pytest.mark.parametrize(
    "name", ["random 0", "random 3", "surface 1", "full", "one voxel", "empty"]
)
def test_a_merged_octree_looks_the_same(name: str, device: Device) -> None:
    octree = OCTREES[name]()
    merged = MergedOctree.of(octree)
    for level in "voxel", 1:
        pictures = [
            plan_render(each, size=(48, 40), samples=1, level=level, device=device).run()
            for each in (octree, merged)
        ]
        np.testing.assert_array_equal(*pictures)


def test_two_octrees_are_compared_merged_or_not(device: Device) -> None:
    one, other = solid_ball(), solid_ball(0.4)
    camera = camera_for(one)
    pictures = [
        plan_render(first, camera, size=(40, 40), samples=1, other=second, device=device).run()
        for first, second in ((one, other), (MergedOctree.of(one), MergedOctree.of(other)))
    ]
    np.testing.assert_array_equal(*pictures)
    assert len(np.unique(pictures[0].reshape(-1, 4), axis=0)) > 10


def test_only_distinct_subtrees_are_on_the_device() -> None:
    merged = MergedOctree.of(solid_ball())
    linked = linked_nodes(merged)
    distinct = sum(merged.sizes[:-1])
    assert len(linked.children) - 1 + len(linked.bricks) == 8 * distinct
    assert drawn_bytes(merged) == linked.children.nbytes - 4 + linked.bricks.nbytes
    assert 2 * drawn_bytes(merged) < merged.nbytes


def test_links_end_at_30_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_links, "MAX_LINK", 64)
    with pytest.raises(MemoryLimitError, match="distinct subtrees of a level exceed links"):
        linked_nodes(MergedOctree.of(solid_ball()))
