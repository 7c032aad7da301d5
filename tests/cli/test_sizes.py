"""The bytes in reports are those that were written, and a command that succeeds prints one line."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from helpers.cli import run

from voxtool.errors import count_of, human

COMMANDS = {
    "voxelize bunny.obj --dim 32": "svo.h5",
    "voxelize bunny.obj --dim 64 --dag": "svo.h5",
    "voxelize bunny.obj --dim 32 --mode fraction": "svo.h5",
    "voxelize parts.glb --dim 32 --mode surface26 --attributes colour,normal": "svo.h5",
    "voxelize bunny.obj --dim 32 ": "vox",
    "voxelize bunny.obj --dim 100 --max-memory 300k": "svo.h5",  # in windows
    "combine bunny.svo.h5 box.svo.h5": "svo.h5",
    "morph bunny.svo.h5 --dilate 1": "svo.h5",
    "morph bunny.svo.h5 --keep largest": "svo.h5",
    "svo-dag bunny.svo.h5": "svo.h5",
    "extract bunny.svo.h5 ": "obj",
    "extract bunny.svo.h5 --style marching-cubes": "ply",
    "extract bunny.svo.h5 --style voxel-faces": "stl",
    "extract bunny.adf.h5": "glb",
    "repair bunny.obj --dim 32": "stl",
    "hollow bunny.obj --dim 48 --wall 0.2": "obj",
    "distance bunny.obj points.csv": "csv",
    "distance bunny.obj --dim 16": "npy",
    "svo-query bunny.svo.h5 points.csv": "csv",
    "adf-query bunny.adf.h5 points.csv": "npy",
    "adf-build bunny.obj --max-level 4": "adf.h5",
    "import mask.npy": "svo.h5",
    "tet-build volume.vtu --scalar density": "tet.h5",
    "render bunny.svo.h5 --size 32": "png",
    "view bunny.svo.h5 --no-open": "html",
    "export bunny.svo.h5": "vti",
    "export bunny.svo.h5 --level 2": "npy",
}
WARNING = "voxtool: warning: "
FOLDERS = {"export bunny.svo.h5": "a.ome.zarr", "export bunny.svo.h5 ": "layers/%04d.png"}


@pytest.mark.parametrize("command", COMMANDS)
def test_bytes_are_those_of_the_file(command: str, here: Path) -> None:
    name = f"out.{COMMANDS[command]}"
    result = run(f"{command} -o {name}")
    size = os.path.getsize(name)
    assert f" {human(size)}" in result.stderr, result.stderr
    lines = result.stderr.splitlines()
    assert sum(WARNING not in line for line in lines) == 1, lines
    assert json.loads(run(f"{command} -o {name} --json").stdout)["bytes"] == size
    if "max-memory" not in command:  # windows wait beside a file
        form = (
            ""
            if command.startswith(("svo-dag", "view", "render"))
            else f"--format {COMMANDS[command]}"
        )
        piped = run(f"{command} -o - {form} --json")
        report = "".join(line for line in piped.stderr.splitlines() if WARNING not in line)
        assert json.loads(report)["bytes"] == len(piped.stdout_bytes) > 0


@pytest.mark.parametrize("command", FOLDERS)
def test_bytes_of_a_folder_are_those_of_its_files(command: str, here: Path) -> None:
    name = FOLDERS[command]
    folder = here / name.split("/")[0]
    for size in (None, None):  # it is replaced
        found = json.loads(run(f"{command} -o {name} --json").stdout)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        assert found["bytes"] == size > 0
        assert f" {human(size)}, " in run(f"{command} -o {name}").stderr


def test_bytes_of_numbered_pictures_and_devices(here: Path) -> None:
    turn = "render bunny.svo.h5 --size 16 --turntable 3"
    found = json.loads(run(f"{turn} -o t%d.png --json").stdout)
    assert found["bytes"] == sum(path.stat().st_size for path in here.glob("t?.png"))
    written = json.loads(run("voxelize bunny.obj --dim 32 -o a.svo.h5 --json").stdout)["bytes"]
    null = "voxelize bunny.obj --dim 32 -o /dev/null --format svo.h5 --json"
    assert json.loads(run(null).stdout)["bytes"] == written


def test_bytes_of_many_meshes(here: Path) -> None:
    run("voxelize bunny.obj open.obj --dim 32 -o out/ -q")
    lines = [json.loads(line) for line in Path("out/manifest.jsonl").read_text().splitlines()]
    for line in lines:
        assert line["bytes"] == line["size"] == os.path.getsize(line["output"])
    assert len(lines) == 2


def test_details_wait_for_v(here: Path) -> None:
    for command, words in {
        "svo-info bunny.svo.h5": ("x-pointers", "left out", "coverage"),
        "adf-info bunny.adf.h5": ("bits a key", "left out", "level "),
    }.items():
        plain, all_ = run(command).stdout, run(f"{command} -v").stdout
        for word in words:
            assert word not in plain
            assert word in all_
        assert f"{os.path.getsize(command.split()[1]):,}" in plain


def test_counts_have_separators() -> None:
    assert count_of(1, "leaf") == "1 leaf"
    assert count_of(1234567, "leaf") == "1,234,567 leaves"
