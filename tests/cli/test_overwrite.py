"""No command replaces one of its inputs, by whatever name, without --overwrite."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from helpers.cli import fail, invoke, process, run
from PIL import Image

from voxtool.cli import main

# Every command that writes a file, with an output that is each of its inputs.
CASES = {
    "voxelize": [
        "bunny.obj --dim 16 --format svo.h5 -o bunny.obj",
        "bunny.obj --like bunny.svo.h5",  # by its default name
        "bunny.obj --like mask.npy -o mask.npy",
        "bunny.obj open.obj --labels shell --format svo.h5 -o open.obj",
        "parts.obj --attributes colour --mode surface26 --dim 8 -o check.png",
    ],
    "diagnose": ["bunny.obj --obj bunny.obj --dim 16"],
    "repair": ["bunny.obj --dim 16 -o bunny.obj"],
    "hollow": ["bunny.obj --dim 16 --wall 0.5 -o bunny.obj"],
    "svo-query": ["bunny.svo.h5 points.csv -o points.csv"],
    "svo-dag": ["bunny.svo.h5 -o bunny.svo.h5", "bunny.svo.h5 --expand -o bunny.svo.h5"],
    "combine": [
        "bunny.svo.h5 box.svo.h5 -o bunny.svo.h5",
        "bunny.svo.h5 box.svo.h5 -o box.svo.h5",
    ],
    "compare": ["bunny.svo.h5 box.svo.h5 -o box.svo.h5"],
    "morph": [
        "bunny.svo.h5 --dilate 1 -o bunny.svo.h5",
        "bunny.svo.h5 --resample --like mask.npy -o mask.npy",
        "bunny.svo.h5 --components --format npy -o bunny.svo.h5",
    ],
    "extract": [
        "bunny.svo.h5 --format obj -o bunny.svo.h5",
        "bunny.svo.h5 --style sharp --source bunny.obj -o bunny.obj",
        "bunny.svo.h5 --against bunny.obj -o bunny.obj",
        "labels.svo.h5 --by label --format obj -o labels.svo.h5",
    ],
    "distance": [
        "bunny.obj points.csv -o points.csv",
        "bunny.obj --like mask.npy -o mask.npy",
    ],
    "adf-build": ["bunny.obj --max-level 3 --format adf.h5 -o bunny.obj"],
    "adf-query": [
        "bunny.adf.h5 points.csv -o points.csv",
        "bunny.adf.h5 --slice z=0 -o bunny.adf.h5",
    ],
    "tet-build": ["volume.vtu --scalar density --format tet.h5 -o volume.vtu"],
    "render": [  # pages are octrees
        "page.png",
        "bunny.svo.h5 --difference page.png -o page.png",
        "page.gif --turntable 2",
        "volume.tet.h5 --transfer page.png -o page.png",
    ],
    "view": ["page.html --no-open"],
    "export": [
        "bunny.svo.h5 --format npy -o bunny.svo.h5",
        "bunny.adf.h5 --like mask.npy -o mask.npy",
        "bunny.svo.h5 --links D3Q19 --source bunny.obj --format npz -o bunny.obj",
        "layers/bunny.svo.h5 -o layers/%04d.png",  # the folder that holds the input
    ],
    "import": [
        "mask.npy --format svo.h5 -o mask.npy",
        "distances.nii.gz --as-field --format adf.h5 -o distances.nii.gz",
        "bunny.voccel.xml --like bunny.svo.h5 -o bunny.svo.h5",
    ],
}
WRITES_NO_FILE = {"svo-info", "adf-info", "devices", "selftest", "completion"}
BY_NAME = {"bench"}  # writes files of fixed names into a folder, and reads none of them


def test_every_command_is_here() -> None:
    assert set(CASES) | WRITES_NO_FILE | BY_NAME == set(main.COMMANDS)


def tree(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def made(models: Path, tmp_path_factory) -> Path:
    """The models, and what some cases read besides."""
    folder = shutil.copytree(models, tmp_path_factory.mktemp("inputs") / "all")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run("svo-dag bunny.svo.h5 --expand -o bunny.voccel.xml -q")
        run("voxelize bunny.obj open.obj --labels file --dim 16 -o labels.svo.h5 -q")
        run("export bunny.svo.h5 -o layers/%04d.png --level 3 -q")
        for name in ("layers/bunny.svo.h5", "page.html", "page.png", "page.gif"):
            shutil.copy("bunny.svo.h5", name)
        Image.new("RGB", (2, 2)).save("check.png")
        Path("parts.mtl").write_text("newmtl a\nmap_Kd check.png\n")
        text = "mtllib parts.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
        Path("parts.obj").write_text(f"{text}usemtl a\nf 1/1 2/2 3/3\n")
    return folder


@pytest.fixture
def inputs(made: Path, tmp_path: Path, monkeypatch) -> Path:
    """The current folder, with copies of all models."""
    folder = shutil.copytree(made, tmp_path / "inputs")
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("command", [f"{name} {words}" for name in CASES for words in CASES[name]])
def test_an_input_is_kept(command: str, inputs: Path) -> None:
    before = tree(inputs)
    assert "name another output, or give --overwrite" in fail(f"{command} --json", 2)
    assert tree(inputs) == before
    invoke(f"{command} --plan")
    assert tree(inputs) == before


@pytest.mark.parametrize(
    ("make", "output"),
    [
        (os.link, "other.obj"),
        (os.symlink, "other.obj"),
        (lambda one, other: os.symlink(".", "folder"), "folder/bunny.obj"),
        (lambda one, other: os.mkdir("folder"), "folder/../bunny.obj"),
    ],
)
def test_other_names_of_an_input(make, output: str, inputs: Path) -> None:
    make("bunny.obj", "other.obj")
    before = tree(inputs)
    message = fail(f"repair bunny.obj --dim 16 -o {output}", 2)
    assert message.startswith(f"{output} is the input bunny.obj: ")
    assert tree(inputs) == before


def test_stdin_is_an_input(inputs: Path) -> None:
    with open("bunny.obj", "rb") as stdin:
        done = process("repair - --dim 16 -o bunny.obj", cwd=inputs, stdin=stdin)
    assert done.returncode == 2
    assert b"bunny.obj is stdin: name another output" in done.stderr


def test_many_meshes_keep_each_other(inputs: Path) -> None:
    Path("bunny.repaired.obj").write_bytes(Path("open.obj").read_bytes())
    before = tree(inputs)
    for words in ("", " --workers 2", " -o ."):
        message = fail(f"repair bunny.obj bunny.repaired.obj --dim 16{words}", 2)
        assert message.startswith("bunny.repaired.obj is the input bunny.repaired.obj: ")
    assert tree(inputs) == before
    run("repair bunny.obj open.obj --dim 16 -o new -q")  # others are made


def test_overwrite_replaces_the_input_whole(inputs: Path) -> None:
    run("repair bunny.obj --dim 16 -o other.obj -q")
    run("repair bunny.obj --dim 16 -o bunny.obj --overwrite -q")
    assert Path("bunny.obj").read_bytes() == Path("other.obj").read_bytes()
    run("morph bunny.svo.h5 --erode 1 -o other.svo.h5 -q")
    run("morph bunny.svo.h5 --erode 1 -o bunny.svo.h5 --overwrite -q")
    run("compare bunny.svo.h5 other.svo.h5 -q")
    run("svo-query bunny.svo.h5 points.csv -o points.csv --overwrite -q")
    assert Path("points.csv").read_text().startswith("contains")
