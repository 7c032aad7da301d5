"""Commands on octrees whose attributes are larger than the memory that they may take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.cli import fail, run

import voxtool


@pytest.fixture
def stored(here: Path) -> voxtool.Octree:
    """A surface and its attributes in a file, of which the nodes and bricks alone fit in 300 kB."""
    octree = voxtool.voxelize("bunny.obj", dim=128, mode="surface26", attributes=("normal", "area"))
    voxtool.write_svo(octree, "a.svo.h5")
    assert octree.nbytes < 300_000 < octree.attribute("normal").nbytes
    return octree


@pytest.mark.parametrize("name", ["npz", "ply"])
def test_export_reads_windows(name: str, stored) -> None:
    run(f"export a.svo.h5 -o whole.{name}")
    told = run(f"export a.svo.h5 -o parts.{name} --max-memory 600k --verbose").stderr
    assert "in windows with normal, area" in told
    assert Path(f"whole.{name}").read_bytes() == Path(f"parts.{name}").read_bytes()


@pytest.mark.parametrize("name", ["vdb", "vtkhdf"])
def test_trees_are_refused_with_a_hint(name: str, stored) -> None:
    message = fail(f"export a.svo.h5 -o a.{name} --max-memory 600k", 4)
    assert f"a .{name} is written from memory, and would need" in message
    assert "--attribute none" in message
    assert not Path(f"a.{name}").exists()


def test_combine_and_morph_load_what_they_keep(stored) -> None:
    alone = stored.only(())
    for command, made in (
        ("combine a.svo.h5 a.svo.h5", voxtool.combine([alone, alone])),
        ("morph a.svo.h5 --dilate 1", voxtool.morph(alone, "dilate", 1)),
    ):
        told = run(f"{command} --max-memory 650k -o b.svo.h5").stderr
        assert "not kept: the attributes normal, area" in told
        assert "more --max-memory would keep normal" in told
        assert voxtool.read_svo("b.svo.h5").digest() == made.digest()
        message = fail(f"{command} --max-memory 650k --windows never -o c.svo.h5", 4)
        assert "the attributes that are kept, normal, need" in message
    run("morph a.svo.h5 --resample --dim 64 --max-memory 20M -o b.svo.h5")


def test_queries_and_pictures_load_what_they_show(stored) -> None:
    np.save("p.npy", np.array(stored.grid.origin) + stored.occupied()[:5] * stored.grid.pitch)
    run("svo-query a.svo.h5 p.npy --max-memory 4M -o b.csv")
    message = fail("svo-query a.svo.h5 p.npy --attributes normal --max-memory 400k -o c.csv", 4)
    assert "with its attribute normal need" in message
    options = "--size 32x32 --max-memory 400k"
    run(f"render a.svo.h5 {options} -o a.png")
    message = fail(f"render a.svo.h5 {options} --colour-by normal -o b.png", 4)
    assert "with its attribute normal need" in message
    run("view a.svo.h5 --no-open -o a.html")


def test_surfaces_need_no_normals(stored) -> None:
    command = "extract a.svo.h5 --style voxel-faces --level voxel"
    run(f"{command} -o whole.ply")
    run(f"{command} --max-memory 4M -o parts.ply")
    assert Path("whole.ply").read_bytes() == Path("parts.ply").read_bytes()
