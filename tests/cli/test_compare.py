"""voxtool compare and combine, as commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from helpers.cli import fail, invoke, run, told

from voxtool.files import read_svo


def test_equal_octrees(here: Path) -> None:
    run("combine bunny.svo.h5 -o pruned.svo.xml -q")
    done = run("compare bunny.svo.h5 pruned.svo.xml")
    assert done.stderr == ""
    first, second, both, jaccard = done.stdout.splitlines()
    assert first.split() == ["only", "first", "0", "voxels"]
    assert second.split() == ["only", "second", "0", "voxels"]
    assert f" {read_svo('bunny.svo.h5').count:,} voxels, volume " in both
    assert jaccard.split() == ["jaccard", "1"]
    digests = [run(f"svo-info {x} --set-digest").stdout for x in ("bunny.svo.h5", "pruned.svo.xml")]
    assert digests[0] == digests[1]
    assert run("svo-info bunny.svo.h5 --digest").stdout != digests[0]
    both = told("svo-info bunny.svo.h5 --digest --set-digest --json")
    assert both["set_digest"] == digests[0].strip() != both["digest"]


def test_octrees_that_differ(here: Path) -> None:
    done = invoke("compare bunny.svo.h5 box.svo.h5 --json -o diff.npy")
    assert done.exit_code == 1
    assert "bunny.svo.h5 and box.svo.h5 differ in " in done.stderr
    found = json.loads(done.stdout)
    a, b = (read_svo(f"{name}.svo.h5").to_dense() for name in ("bunny", "box"))
    counts = {"only_first": a & ~b, "only_second": b & ~a, "both": a & b}
    assert {name: found[name]["voxels"] for name in counts} == {
        name: np.count_nonzero(part) for name, part in counts.items()
    }
    assert not found["equal"]
    assert np.array_equal(np.load("diff.npy"), a ^ b)


def test_what_the_commands_refuse(here: Path) -> None:
    assert "cannot both be stdin" in fail("compare - -", 2)
    assert "only one of OCTREES can be stdin" in fail("combine - bunny.svo.h5 -", 2)
    run("voxelize open.obj --dim 20 -o small.svo.h5 -q")
    assert "octrees 1 and 2 have voxels of" in fail("compare bunny.svo.h5 small.svo.h5")
    assert "compare of 2 octrees would need" in fail(
        "compare bunny.svo.h5 box.svo.h5 --max-memory 1K"
    )
    plan = told("compare bunny.svo.h5 box.svo.h5 --plan --json")
    assert (plan["operation"], plan["operands"], plan["moved"]) == ("compare", 2, 0)
