"""Octrees of upper nodes alone: counts, coverages, pictures and pages are those of the whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.attributes import attributed
from helpers.cli import fail, run, told
from helpers.merged import OCTREES

import voxtool
from voxtool.files import open_svo, write_svo
from voxtool.pictures.rendering import camera_for, plan_render
from voxtool.svo.cells.counts import Counts, NodeCounts
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.content import StoredOctree
from voxtool.svo.pictures.coarsen import coarsened, fitting_octree
from voxtool.viewer.octrees import octree_content

SIZE = (64, 48)


def test_attributes_that_do_not_fit_are_left_out(tmp_path: Path) -> None:
    octree = attributed().only(("label", "colour"))
    write_svo(octree, tmp_path / "a.svo.h5")
    size = sum(one.nbytes for one in octree.attributes)
    with open_svo(tmp_path / "a.svo.h5") as stored:
        assert isinstance(stored, StoredOctree)
        found, level = fitting_octree(stored, "voxel", octree.nbytes + size)
        assert (found, level) == (octree, "voxel")
        found, level = fitting_octree(stored, "voxel", octree.nbytes + size - 1)
        assert (found, level) == (octree.only(()), "voxel")
        found, level = fitting_octree(stored, "voxel", octree.nbytes - 1)
        assert isinstance(found, MergedOctree)


@pytest.mark.parametrize("name", OCTREES)
def test_upper_nodes_have_the_same_coverage(name: str, device) -> None:
    octree = OCTREES[name]()
    for number in range(1, octree.depth - 1):
        coarse = coarsened(octree, number)
        assert coarse.count == octree.count
        for level in range(number, octree.depth):
            whole, upper = Counts(octree, level + 2), NodeCounts(coarse, level + 2)
            found = [
                {int(code): int(n) for code, n in zip(c.levels[level].codes, c.of_nodes[level],
                                                       strict=True) if n}
                for c in (whole, upper)
            ]  # fmt: skip
            assert found[0] == found[1]
            if not octree.count:
                continue
            cameras = [camera_for(o, size=SIZE, level=level) for o in (octree, coarse)]
            assert cameras[0] == cameras[1]
            pictures = [
                plan_render(o, cameras[0], size=SIZE, level=level, device=device).run()
                for o in (octree, coarse)
            ]
            np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("name", OCTREES)
def test_pages_of_merged_octrees(name: str) -> None:
    octree = OCTREES[name]()
    merged = MergedOctree.of(octree)
    for level in ("voxel", *range(octree.depth)):
        whole, found = octree_content(octree, level), octree_content(merged, level)
        assert whole.arrays.keys() == found.arrays.keys()
        for key, array in whole.arrays.items():
            np.testing.assert_array_equal(array, found.arrays[key])
        if level != "voxel" and level > 0 and level < octree.depth - 1:
            upper = octree_content(coarsened(octree, level), level)
            for key, array in whole.arrays.items():
                np.testing.assert_array_equal(array, upper.arrays[key])


def test_commands_draw_what_fits(here: Path) -> None:
    octree = voxtool.voxelize("bunny.obj", dim=256, mode="surface26")
    write_svo(octree, "a.svo.h5")
    small = "render a.svo.h5 --size 32 --json"
    wanted = [told(f"{small} --level {level} -o whole.png")["digest"] for level in range(4)]
    limit = f"--max-memory {octree.nbytes - 1}"
    result = run(f"{small} {limit} -o parts.png")
    level = int(result.stderr.split("nodes of level ")[1].split()[0])
    assert f"nodes of level {level} are drawn instead of voxels" in result.stderr
    assert told(f"{small} {limit} --level {level} -o parts.png")["digest"] == (wanted[level])
    assert told(f"{small} {limit} -o parts.png")["digest"] == wanted[level]
    assert "of level" in run(f"view a.svo.h5 {limit} --no-open -o parts.html").stderr
    assert "the octree alone is too large" in fail("render a.svo.h5 --max-memory 500 -o x.png")
