"""voxtool morph, as a command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.cli import ROOT, fail, run, told

import voxtool
from voxtool.files import read_svo


@pytest.fixture
def crumbs(here: Path) -> np.ndarray:
    """Two components, of 27 voxels and one, in crumbs.svo.h5."""
    dense = np.zeros((12, 10, 8), bool)
    dense[1:4, 2:5, 3:6] = dense[10, 9, 0] = True
    octree = voxtool.Octree.from_dense(dense, (1, 2, 3), 0.5, units="mm")
    voxtool.write_svo(octree, "crumbs.svo.h5")
    return dense


def test_components_are_reported(crumbs: np.ndarray) -> None:
    done = run("morph crumbs.svo.h5 --components")
    assert done.stderr == ""
    head, first, second = done.stdout.splitlines()
    assert head.split() == ["components", "2,", "by", "6", "neighbours"]
    assert first.split(maxsplit=1) == [
        "1",
        "27 voxels, volume 3.375 mm^3, centre (2.25 3.75 5.25), from (1.5 3 4.5) to (3 4.5 6)",
    ]
    assert second.startswith("2            1 voxels, volume 0.125 mm^3")
    found = told("morph crumbs.svo.h5 --components --neighbours 26 --json")
    assert (found["output"], found["count"], found["neighbours"]) == (None, 2, 26)
    assert found["components"][1]["box"] == [[10, 9, 0], [11, 10, 1]]
    assert found["components"][1]["bounds"] == [[6, 6.5, 3], [6.5, 7, 3.5]]


def test_labels_are_written(crumbs: np.ndarray) -> None:
    run("morph crumbs.svo.h5 --components -o labels.npy")
    labels = np.load("labels.npy")
    assert (labels.dtype, labels[2, 3, 4], labels[10, 9, 0]) == (np.uint8, 1, 2)
    assert np.array_equal(labels > 0, crumbs)
    message = fail("morph crumbs.svo.h5 --components -o labels.svo.h5")
    assert "the name says no format: end it in one of .npy, .npz, .vti" in message


def test_many_components_are_cut_short(here: Path) -> None:
    voxels = voxtool.Octree.from_dense(np.indices((8, 8, 8)).sum(axis=0) % 2 == 0)
    voxtool.write_svo(voxels, "board.svo.h5")
    lines = run("morph board.svo.h5 --components").stdout.splitlines()
    assert len(lines) == 22
    assert lines[-1] == "and 236 smaller ones: --json lists all"
    assert len(told("morph board.svo.h5 --components --json")["components"]) == 256


def test_an_export_can_be_the_output(crumbs: np.ndarray) -> None:
    run("morph crumbs.svo.h5 --keep largest -o kept.npy")
    assert np.array_equal(np.load("kept.npy"), voxtool.keep_components("crumbs.svo.h5", 1))
    done = told("morph crumbs.svo.h5 --dilate 1 --json")
    assert done["output"] == "crumbs.morph.svo.h5"
    assert read_svo(done["output"]).count == done["voxels"] > crumbs.sum()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "what is to be done? Give one of --dilate, --erode"),
        ("--components --keep 1", "one operation a call: drop --keep or --components"),
        ("--dilate 1 --keep largest", "one operation a call: drop --dilate or --keep"),
        ("--thin --open 1 --erode 0", "one operation a call: drop --erode, --open or --thin"),
        ("--components --shape cube", "--shape go with a radius"),
        ("--fill-cavities --neighbours 6", "--neighbours goes with"),
    ],
)
def test_what_does_not_go_together(words: str, message: str, crumbs: np.ndarray) -> None:
    assert message in fail(f"morph crumbs.svo.h5 {words}", 2)


def test_the_wall_of_the_guide(here: Path) -> None:
    help, guide = run("morph -h").stdout, (ROOT / "docs/morph.md").read_text()
    words = "morph bunny.svo.h5 --shell 0.02 --world -o hollow.svo.h5"
    assert f"voxtool {words}\n" in help
    assert f"voxtool {words}\n" in guide
    run("voxelize bunny.obj --dim 256 -q")  # coarser than that of the guide
    found = told(f"{words} --json")
    assert 0 < found["voxels"] < found["voxels_before"]
    message = fail("morph bunny.svo.h5 --shell 0.002 --world -o less.svo.h5")
    assert "radius 0.002 is less than one voxel, of 0.00" in message


def test_a_refusal_says_what_helps(here: Path) -> None:
    small = "or allow more (see --max-memory)"
    for words in ("--components", "--keep 1", "--fill-cavities", "--close 3"):
        message = fail(f"morph bunny.svo.h5 {words} --max-memory 1K")
        assert "would need" in message
        assert "make it coarser by --resample" in message
        assert message.endswith(small)


def test_resampling(crumbs: np.ndarray) -> None:
    found = told("morph crumbs.svo.h5 --resample --pitch 0.25 -o fine.npy --json")
    assert (found["operation"], found["shape"], found["exact"]) == ("resample", [24, 20, 16], True)
    fine = crumbs.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    assert np.array_equal(np.load("fine.npy"), fine)
    run("morph crumbs.svo.h5 --resample --like bunny.svo.h5 -o like.svo.h5 -q")
    assert read_svo("like.svo.h5").grid == read_svo("bunny.svo.h5").grid
    for words, message in (
        ("--resample", "resample to what? Give --dim"),
        ("--resample --dim 9 --pitch 1", "--dim and --pitch both set"),
        ("--resample --like bunny.svo.h5 --dim 9", "--like sets the grid: drop --dim"),
        ("--close 1 --threshold 0.3", "--threshold goes with --resample"),
    ):
        assert message in fail(f"morph crumbs.svo.h5 {words}", 2)
