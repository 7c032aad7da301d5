"""Pages of merged octrees are those of the octrees that they stand for."""

from __future__ import annotations

import pytest
from helpers_merged import OCTREES

from voxtool.errors import MemoryLimitError
from voxtool.svo import drawn
from voxtool.svo.merged import MergedOctree
from voxtool.viewer.octrees import octree_content


@pytest.mark.parametrize("name", OCTREES)
@pytest.mark.parametrize("level", ["voxel", 0, 1])
def test_a_page_of_a_merged_octree_is_that_of_the_octree(
    name: str, level: int | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    octree = OCTREES[name]()
    if not octree.count or level == octree.depth - 1:
        pytest.skip("nothing to show, or no such level")
    monkeypatch.setattr(drawn, "BLOCK", 3)
    monkeypatch.setattr(MergedOctree, "expanded", None)
    page, merged = (octree_content(o, level) for o in (octree, MergedOctree.of(octree)))
    assert merged.facts == page.facts
    assert merged.digest() == page.digest()


def test_a_page_that_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    merged = MergedOctree.of(OCTREES["random 0"]())
    monkeypatch.setattr("voxtool.memory.available_memory", lambda: 1000)
    with pytest.raises(MemoryLimitError, match=r"bricks of its voxels .*: show nodes of a level"):
        octree_content(merged)
