"""Pages of octrees with attributes, held against `voxtool render` of the same camera."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.attributes import attributed, scattered
from helpers.browser import LARGE, Viewer, check_same, opened, written
from helpers.cli import run

import voxtool
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.octree import Octree
from voxtool.viewer.job import plan_view

SIZE = (96, 80)
EVIL = "</script><script>document.title = 'evil'</script><b>"
pytestmark = pytest.mark.slow


def blocks() -> Octree:
    """A box that is made of leaves of several sizes, and of bricks at its sides, in three slabs."""
    dense = np.zeros((128, 128, 128), bool)
    dense[3:97, 5:70, 2:66] = True
    octree = Octree.from_dense(dense, pitch=(1.0, 1.0, 0.5))
    levels = octree.levels()
    voxels = [4 * level.cells // 4 for level in levels[-1:]]
    corners = np.concatenate([*voxels])
    bits = (octree.bricks[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)) != 0
    of_bricks = np.broadcast_to(corners[:, :1], bits.shape)[bits]
    of_leaves = np.concatenate([level.cells[level.inside] for level in levels[:-1]])[:, 0]
    values = [(place * 3 // 128).astype(np.uint8) for place in (of_bricks, of_leaves)]
    label = Attribute("label", *values, names=("left", "middle", EVIL))
    return replace(octree, attributes=(label,))


@pytest.fixture(scope="module", params=["scattered", "blocks"])
def octree(request: Any) -> Octree:
    return attributed() if request.param == "scattered" else blocks()


@pytest.fixture(scope="module")
def viewer(browser, octree: Octree, tmp_path_factory) -> Iterator[Viewer]:
    with opened(browser, written(octree, tmp_path_factory.mktemp("pages"))) as viewer:
        yield viewer


@pytest.mark.parametrize("level", ["voxel", 0, 1, 2, 3])
def test_colours_are_those_of_pictures(octree: Octree, viewer: Viewer, level: int | str) -> None:
    for view in ("iso", "left") if level == "voxel" else ("iso",):
        camera = voxtool.camera_for(octree, view)
        for name in ("colour", "label"):
            if name in [one.name for one in octree.attributes]:
                viewer.set(camera, level=level, paint=name)
                wanted = voxtool.render(octree, camera.rays(*SIZE), level=level, colour_by=name)
                check_same(viewer.picture(*SIZE)[0], wanted)
        viewer.set(camera, level=level, paint="light")
        wanted = voxtool.render(octree, camera.rays(*SIZE), level=level, colour_by="none")
        check_same(viewer.picture(*SIZE)[0], wanted)


def test_labels_are_switched_off(octree: Octree, viewer: Viewer) -> None:
    camera = voxtool.camera_for(octree, "iso")
    names = octree.attribute("label").names
    for hidden in ((0,), (1, 2), (2,)):
        viewer.set(camera, paint="label", hidden=",".join(map(str, hidden)))
        only = [name for number, name in enumerate(names) if number not in hidden]
        wanted = voxtool.render(octree, camera.rays(*SIZE), colour_by="label", only=only)
        check_same(viewer.picture(*SIZE)[0], wanted)
    viewer.set(camera, hidden="0,1,2")
    assert not viewer.picture(*SIZE)[0].any()
    assert viewer.errors == []


def test_boxes_switch_labels(octree: Octree, viewer: Viewer) -> None:
    viewer.set(voxtool.camera_for(octree))
    viewer.tab.set_viewport_size({"width": 480, "height": 640})
    viewer.tab.evaluate("document.getElementById('panel').open = true")
    boxes = viewer.tab.locator(".labels input")
    assert boxes.count() == len(octree.attribute("label").names)
    texts = viewer.tab.locator(".labels label").all_text_contents()
    assert tuple(texts) == octree.attribute("label").names
    boxes.nth(1).click()
    assert viewer.tab.evaluate("voxtool.state().settings.hidden") == "1"
    viewer.tab.get_by_role("button", name="None").click()
    assert viewer.tab.evaluate("voxtool.state().settings.hidden") == "0,1,2"
    assert not boxes.nth(2).is_checked()
    boxes.nth(0).click()
    assert viewer.tab.evaluate("voxtool.state().settings.hidden") == "1,2"
    viewer.tab.get_by_role("button", name="All").click()
    assert viewer.tab.evaluate("voxtool.state().settings.hidden") == ""
    assert viewer.tab.title() == "octree bunny.svo.h5"  # not that of a name


def test_the_copied_command_draws_labels(browser, tmp_path: Path, monkeypatch) -> None:
    octree = attributed()
    voxtool.write_svo(octree, tmp_path / "bunny.svo.h5")
    monkeypatch.chdir(tmp_path)
    viewer = Viewer(browser, written(octree, tmp_path), size=LARGE)
    viewer.set(voxtool.camera_for(octree, "left"), paint="label", hidden="0")
    words = shlex.split(viewer.tab.evaluate("voxtool.command()"))
    assert words[-4:] == ["--colour-by", "label", "--only", "größe,a b"]
    run(f"{shlex.join(words[1:])} -q --float -o drawn.npy".replace("--background none", ""))
    check_same(viewer.picture(*LARGE)[0], np.load("drawn.npy"))
    viewer.set(voxtool.camera_for(octree, "left"), paint="light")
    assert viewer.tab.evaluate("voxtool.command()").endswith(" --colour-by none")
    viewer.set(voxtool.camera_for(octree, "left"))
    assert "--colour-by" not in viewer.tab.evaluate("voxtool.command()")
    viewer.close()


@pytest.mark.parametrize("level", [0, 1])
def test_pages_that_end_at_a_level(browser, tmp_path: Path, level: int) -> None:
    octree = attributed()
    page = plan_view(octree, "bunny.svo.h5", level=level).run()
    (tmp_path / "page.html").write_text(page.html, encoding="utf-8")
    with opened(browser, tmp_path / "page.html") as viewer:
        camera = voxtool.camera_for(octree)
        for shown in (level, level + 1):
            viewer.set(camera, level=shown, paint="label")
            wanted = voxtool.render(octree, camera.rays(*SIZE), level=shown, colour_by="label")
            check_same(viewer.picture(*SIZE)[0], wanted)


def test_octrees_without_colours_and_labels_have_the_page_of_before() -> None:
    octree = attributed()
    less = replace(octree, attributes=octree.attributes[2:])
    pages = [plan_view(one, "a.svo.h5").plan.content for one in (less, scattered())]
    assert pages[0].digest() == pages[1].digest()
