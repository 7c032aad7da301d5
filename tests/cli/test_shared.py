"""Behaviour that commands share: outputs, reports, plans, refusals, devices."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
from pathlib import Path

import pytest
from conftest import usable_devices
from helpers.cli import ENVIRONMENT, MODULE, fail, run, told

# Commands that run one job, and the names of their outputs by default.
JOBS = {
    "voxelize bunny.obj --dim 16": "bunny.svo.h5",
    "voxelize open.obj --dim 16 --mode surface6": "open.svo.h5",
    "combine bunny.svo.h5 box.svo.h5": "bunny.union.svo.h5",
    "extract bunny.svo.h5 --style marching-cubes --level 1": "bunny.marching-cubes.obj",
    "extract bunny.svo.h5": "bunny.surface-nets.obj",
    "extract bunny.svo.h5 --style voxel-faces --merge": "bunny.voxel-faces.obj",
    "svo-query bunny.svo.h5 points.csv --level 1": "points.voxels.npy",
    "distance bunny.obj points.csv": "points.distance.npy",
    "distance bunny.obj --dim 16": "bunny.sdf.npy",
    "adf-build bunny.obj --max-level 3": "bunny.adf.h5",
    "tet-build volume.vtu --scalar density": "volume.tet.h5",
    "render bunny.svo.h5 --size 20x30": "bunny.png",
    "render bunny.adf.h5 --size 20": "bunny.png",
    "render volume.tet.h5 --size 20": "volume.png",
    "render volume.tet.h5 --size 20 --method projection --integrator preintegrated": "volume.png",
    "view bunny.svo.h5 --no-open": "bunny.html",
    "view bunny.adf.h5 --no-open": "bunny.html",
    "view volume.tet.h5 --no-open": "volume.html",
}
QUERIES = {
    "adf-query bunny.adf.h5 points.csv": "points.distance.npy",
    "adf-query bunny.adf.h5 --slice z=0 --size 200": "bunny.slice.png",
}
INPUTS = {
    "voxelize": "bunny.obj", "combine": "bunny.svo.h5 box.svo.h5", "extract": "bunny.svo.h5",
    "distance": "bunny.obj points.csv", "adf-build": "bunny.obj",
    "adf-query": "bunny.adf.h5 points.csv", "svo-query": "bunny.svo.h5 points.csv",
    "tet-build": "volume.vtu --scalar density", "render": "bunny.svo.h5",
    "view": "bunny.svo.h5",
}  # fmt: skip
jobs = pytest.mark.parametrize("command", JOBS)
each = pytest.mark.parametrize("command", JOBS | QUERIES)


@each
def test_the_output_by_default_is_replaced_or_kept(command: str, here: Path) -> None:
    name = (JOBS | QUERIES)[command]
    Path(name).write_text("old")
    assert fail(f"{command} --no-clobber").startswith(f"{name} exists")
    before = set(os.listdir())
    assert run(f"{command} -q").output == ""  # quiet is silent
    assert set(os.listdir()) == before
    assert Path(name).read_bytes() != b"old"
    result = run(command)
    assert result.stdout == ""
    assert f" -> {name}: " in result.stderr


@jobs
def test_the_plan_is_printed_and_nothing_is_written(command: str, here: Path) -> None:
    before = {file: file.read_bytes() for file in here.iterdir()}
    text, plan = run(f"{command} --plan"), run(f"{command} --plan --json")
    assert {file: file.read_bytes() for file in here.iterdir()} == before
    said = json.loads(plan.stdout)
    assert f"stages     {', '.join(said['stages'])}\n" in text.stdout
    assert text.stdout.splitlines()[-1].startswith("predicted  ")
    for what, why in said["left_out"].items():
        assert f"left out   {what}: {why}\n" in text.stdout


@jobs
def test_a_plan_that_will_be_refused_says_so(command: str, here: Path) -> None:
    if not command.startswith("adf-build"):  # whose plan needs memory itself
        refused = run(f"{command} --plan --json --max-memory 100").stderr.splitlines()[-1]
        assert refused.startswith("voxtool: warning: this will be refused: ")
    output = here / f"new.{JOBS[command].partition('.')[2]}"
    assert fail(f"{command} --max-memory 100 -o {output}")


@jobs
def test_verbose_names_the_device_and_the_stages_of_the_plan(command: str, here: Path) -> None:
    planned = told(f"{command} --plan --json")["stages"]
    lines = run(f"{command} -v").stderr.splitlines()
    timed = [m[1] for x in lines if (m := re.fullmatch(r"voxtool:   (.*?) +\d+\.\d\d ms", x))]
    assert timed[0].startswith("read ")
    assert (timed[1], timed[-1]) == ("plan", "other")
    untimed = {"upload", "distance", "pseudo-normals"}  # arrays that are put, not written
    assert set(planned) - set(timed) <= untimed
    if not command.startswith("adf-build"):  # whose stages run once a level
        assert [s for s in timed if s in planned] == [s for s in planned if s in timed]
    named = [line for line in lines if re.fullmatch(r"voxtool: \S.* \(.*\)", line)]
    assert len(named) == (not command.startswith("view"))  # which needs no device


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "voxelize bunny.obj --dim 32 --mode surface26 -o a.svo.h5",
        "combine bunny.svo.h5 box.svo.h5 --op xor -o a.svo.h5",
        "extract bunny.svo.h5 --normals -o a.ply",
        "extract bunny.svo.h5 --style surface-nets -o a.ply",
        "extract bunny.svo.h5 --style voxel-faces --merge -o a.ply",
        "extract bunny.svo.h5 --level 1 --isovalue 0.3 -o a.ply",
        "render bunny.svo.h5 --size 70x50 -o a.png",
        "render bunny.adf.h5 --size 70x50 -o a.png",
        "render volume.tet.h5 --size 70x50 -o a.png",
        "adf-query bunny.adf.h5 --slice y=1 --size 300 -o a.png",
        "distance bunny.obj points.csv --gradient -o a.csv",
    ],
)
def test_files_are_the_same_on_every_device(command: str, here: Path) -> None:
    name = command.split()[-1]
    indices = [index for index, _ in usable_devices()]
    contents, digests = set(), set()
    for index in [*indices, indices[0]]:
        digests.add(told(f"{command} --device {index} --json").get("digest"))
        contents.add(Path(name).read_bytes() if not name.endswith(".h5") else b"")
    assert len(contents) == len(digests) == 1


@pytest.mark.parametrize(
    "command", [c for c in INPUTS if c not in ("distance", "adf-query", "svo-query")]
)
def test_no_binary_file_is_sent_to_a_terminal(command: str, here: Path) -> None:
    master, slave = pty.openpty()
    binary = " --format ply" if command == "extract" else ""
    words = [*MODULE, *f"{command} {INPUTS[command]} -o -{binary}".split()]
    done = subprocess.run(words, env=ENVIRONMENT, stdout=slave, stderr=subprocess.PIPE)
    os.close(slave)
    os.close(master)
    assert done.returncode == 2
    assert done.stderr.startswith(b"voxtool: error: stdout is a terminal: redirect it")


@pytest.mark.parametrize("command", [c for c in INPUTS if c != "tet-build"])
def test_nothing_on_stdin(command: str, here: Path) -> None:
    words = ["-", *INPUTS[command].split()[1:]]
    assert "empty" in fail(" ".join([command, *words]), 3)


@pytest.mark.parametrize("command", INPUTS)
@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        ("--dimm 64", 2, "No such option '--dimm'"),
        ("--device nothing-like-it", 4, "no OpenCL device matches"),
        ("-o a.foo", 3, "a.foo: the name says no format: end it in one of ."),
        ("-o none/a{}", 3, "there is no folder"),
    ],
)
def test_failures_are_one_line(
    command: str, more: str, code: int, message: str, here: Path
) -> None:
    if command in ("tet-build", "view") and "--device" in more:
        return  # they run on the host
    ends = [
        Path(name).name for words, name in (JOBS | QUERIES).items() if words.startswith(command)
    ]
    end = ends[0].partition(".")[2].removeprefix("distance.").removeprefix("marching-cubes.")
    end = end.removeprefix("voxels.")
    assert message in fail(f"{command} {INPUTS[command]} {more.format('.' + end)}", code)


@pytest.mark.parametrize("command", INPUTS)
def test_a_missing_input_is_named(command: str, here: Path) -> None:
    words = INPUTS[command].split()
    missing = f"none{''.join(Path(words[0]).suffixes)}"
    assert re.match(
        rf"{missing}: (there is )?no such file", fail(f"{command} {missing} {' '.join(words[1:])}")
    )
    assert "Missing argument" in fail(command, code=2)
