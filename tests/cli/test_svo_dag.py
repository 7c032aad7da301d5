"""voxtool svo-dag and voxelize --dag."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli import fail, run, told


@pytest.fixture
def small(here: Path) -> str:
    run("svo-dag bunny.svo.h5 -o small.svo.h5")
    return "small.svo.h5"


def test_voxelize_merges_as_svo_dag_does(small: str, here: Path) -> None:
    plain = told("svo-info bunny.svo.h5 --json --digest")
    asked = f"--dim {plain['dim']} --mode {plain['mode']} --fill {plain['fill']}"
    made = told(f"voxelize bunny.obj {asked} --dag -o made.svo.h5 --json")
    assert made["digest"] == plain["digest"]
    assert (here / "made.svo.h5").read_bytes() == (here / small).read_bytes()


def test_what_svo_info_says(small: str, here: Path) -> None:
    plain = told("svo-info bunny.svo.h5 --json --digest --set-digest")
    merged = told(f"svo-info {small} --json --check --digest --set-digest")
    same = ("digest", "set_digest", "nodes", "bricks", "memory_bytes", "voxels", "dim", "plan")
    assert {name: merged[name] for name in same} == {name: plain[name] for name in same}
    assert merged["subtrees"] == sum(row["subtrees"] for row in merged["levels"])
    assert merged["merged_bytes"] < merged["file_bytes"] < plain["file_bytes"]
    text = run(f"svo-info {small}").stdout
    assert f"\nmerged       {merged['subtrees']:,} distinct subtrees in" in text
    assert "     subtrees\n" in run(f"svo-info {small} -v").stdout
    assert "subtrees" not in run("svo-info bunny.svo.h5 -v").stdout


def test_back_to_all_nodes(small: str, here: Path) -> None:
    run(f"svo-dag {small} --expand -o back.svo.h5")
    assert (here / "back.svo.h5").read_bytes() == (here / "bunny.svo.h5").read_bytes()
    again = told(f"svo-dag {small} -o again.svo.h5 --json")
    assert (here / "again.svo.h5").read_bytes() == (here / small).read_bytes()
    assert again["digest"] == told("svo-info bunny.svo.h5 --json --digest")["digest"]


@pytest.mark.parametrize(
    "line",
    [
        "extract FILE -o {}.obj",
        "export FILE -o {}.npy",
        "morph FILE --dilate 1 -o {}.svo.h5",
        "combine FILE FILE --op union -o {}.svo.h5",
        "render FILE --size 16 -o {}.png",
    ],
)
def test_other_commands_read_it(line: str, small: str, here: Path) -> None:
    outputs = []
    for name, file in (("plain", "bunny.svo.h5"), ("merged", small)):
        run(line.replace("FILE", file).format(name))
        outputs.append(next(here.glob(f"{name}.*")).read_bytes())
    assert outputs[0] == outputs[1]


def test_refusals(small: str) -> None:
    message = "--dag writes .svo.h5"
    assert message in fail("voxelize bunny.obj --dim 16 --dag -o a.svo.xml", 2)
    assert message in fail("voxelize bunny.obj --dim 16 --dag -o a.npy", 2)
    assert "end it in one of .svo.h5" in fail(f"svo-dag {small} -o a.svo.xml")
    assert "is a mesh: voxelize it first" in fail("svo-dag bunny.obj")
