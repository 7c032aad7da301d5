"""voxtool repair and voxtool hollow: the file is what was said of it."""

from __future__ import annotations

import pytest
import wrecks
from helpers import meshes
from helpers.cli import fail, run, told, write_obj

import voxtool


@pytest.mark.parametrize("name", ["out.obj", "out.ply", "out.stl", "out.off", "out.glb"])
def test_the_file_holds_what_was_said(tmp_path, monkeypatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "a.obj", *wrecks.wreck("apart", "torus"))
    found = told(f"repair a.obj --dim 20 --check -o {name}")
    assert found["check"]["closed"]
    assert (found["check"]["shells"], found["check"]["genus"]) == (1, 1)
    written = voxtool.diagnose(name, dim=16).diagnosis
    assert (written.watertight, written.manifold, written.genus) == (True, True, 1)


def test_the_mesh_is_that_of_the_library(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "a.obj", *wrecks.wreck("apart", "torus"))
    found = told("repair a.obj --dim 20 --json")
    assert found["digest"] == voxtool.repair("a.obj", dim=20).digest()
    assert "closed and manifold, 1 shell, genus 1" in run("repair a.obj --dim 20").stderr


def test_hollow(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "ball.obj", *meshes.icosphere(3))
    words = "hollow ball.obj --wall 0.3 --drain 0,0,1,0.2 --drain 0,0,-1,0.2 --dim 40 --json"
    found = told(f"{words} --normals")
    assert (found["check"]["genus"], found["wall"]["closed"]) == (1, 0)
    assert (tmp_path / "ball.hollow.obj").read_text().count("\nvn ") == found["vertices"]
    planned = told(f"{words} --plan")
    assert planned["drains"] == [[0, 0, 1, 0.2], [0, 0, -1, 0.2]]
    assert 0.5 < planned["predicted_triangles"] / found["triangles"] < 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("repair a.obj --dim 32 --tolerance 1", "both set the voxel size"),
        ("repair a.obj --gap 2", "--gap goes with --fill flood"),
        ("repair a.obj --shell 1 --offset 1", "exclude each other"),
        ("repair a.obj --thicken 1 --fill flood", "drop --fill and --gap"),
        ("hollow a.obj --wall 1 --drain 1,2,3", "is no drain"),
        ("repair a.obj --normals -o b.stl", ".stl holds none"),
    ],
)
def test_usage(tmp_path, monkeypatch, words: str, message: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in fail(words, 2)
