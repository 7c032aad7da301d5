"""voxtool extract: files, formats, checks, distances, refusals, lost voxels."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.attributes import attributed
from helpers.cli import fail, invoke, run, told, write_obj
from helpers.octree import ball, octree_from_dense

from voxtool.files import MESH_FORMATS, NORMAL_FORMATS, read_svo, write_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import extract, plan_extract
from voxtool.svo.surface.isosurface import Isosurface

STYLES = ("marching-cubes", "voxel-faces", "surface-nets")
LEVELS = [(style, level) for style in STYLES for level in (None, "voxel", 0, 2)]
SAID = re.compile(
    r"voxtool: (\S+) -> (\S+): (marching-cubes|voxel-faces|surface-nets), "
    r"level (voxel|\d+), isovalue ([\d.]+); "
    r"([\d,]+) vertices, ([\d,]+) triangles; volume (\S+), of the voxels (\S+) "
    r"\(([+-]\d+\.\d\d) %\), ([\d.]+) (bytes|kB|MB), \d+\.\d\d s\n"
)
LOST = re.compile(
    r"voxtool: +([\d,]+) set voxels \(([\d.e-]+) %\) lie in samples below the isovalue, "
    r"(?:all of them at the surface|([\d,]+) of them away from the surface: (.*))\n"
)


def number(text: str) -> int:
    return int(text.replace(",", ""))


def said(stderr: str) -> re.Match[str]:
    """Return the line of the report, which is the first."""
    found = SAID.match(stderr)
    assert found, stderr
    return found


def plate() -> Octree:
    """Return 16 x 16 x 16 voxels with a plate one voxel thick in a quarter of the bricks."""
    dense = np.zeros((16, 16, 16), bool)
    dense[3:12, 3:12, 9] = True
    return octree_from_dense(dense)


# ---- files


@pytest.mark.parametrize(("style", "level"), LEVELS)
def test_the_file_holds_what_was_said(style: str, level, here: Path) -> None:
    asked = "" if level is None else f"--level {level}"
    result = run(f"extract bunny.svo.h5 --style {style} {asked} -o a.obj")
    assert result.stdout == ""
    line = said(result.stderr[result.stderr.index("voxtool: bunny.svo.h5 ->") :])
    shown = "voxel" if level is None else str(level)
    assert line.groups()[:5] == ("bunny.svo.h5", "a.obj", style, shown, "0.5")
    surface = extract(read_svo("bunny.svo.h5"), style=style, level=level)
    mesh = load_mesh("a.obj")
    assert (number(line[6]), number(line[7])) == (len(mesh.vertices), len(mesh.faces))
    assert np.array_equal(mesh.faces, surface.faces)
    np.testing.assert_allclose(mesh.vertices, surface.vertices, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", MESH_FORMATS)
def test_formats(name: str, here: Path) -> None:
    run(f"extract bunny.svo.h5 --level 1 -o a.{name}")
    run(f"extract bunny.svo.h5 --level 1 --format {name} -o a.dat")
    assert Path("a.dat").read_bytes() == Path(f"a.{name}").read_bytes()
    mesh, surface = load_mesh(f"a.{name}"), extract(read_svo("bunny.svo.h5"), level=1)
    assert mesh.vertices[mesh.faces] == pytest.approx(surface.vertices[surface.faces], abs=1e-6)


def test_the_name_by_default_is_never_the_mesh_it_was_made_from(here: Path) -> None:
    before = Path("bunny.obj").read_bytes()
    (here / "folder").mkdir()
    os.rename("bunny.svo.h5", "folder/bunny.svo.h5")
    for style in STYLES:
        run(f"extract folder/bunny.svo.h5 --style {style}")
        assert len(load_mesh(f"bunny.{style}.obj").faces) > 0
    assert Path("bunny.obj").read_bytes() == before
    assert os.listdir("folder") == ["bunny.svo.h5"]


def test_octrees_of_every_format_have_one_surface(here: Path) -> None:
    digests = {told("extract bunny.svo.h5 -o a.obj --json")["digest"]}
    for name in ("b.svo.xml", "b.svo.xml.gz"):
        write_svo(read_svo("bunny.svo.h5"), name)
        digests.add(told(f"extract {name} -o a.obj --json")["digest"])
    assert len(digests) == 1


def test_world_coordinates(here: Path) -> None:
    """A box of whole voxels comes back as it was, wherever it lies."""
    write_obj(here / "box.obj", *meshes.box((10, -20, 5), (14, -17, 7)))
    run("voxelize box.obj --pitch 0.25 -q -o box.svo.h5")
    found = told(
        "extract box.svo.h5 --style voxel-faces --merge -o a.obj --check --against box.obj"
    )
    assert load_mesh("a.obj").bounds == pytest.approx(load_mesh("box.obj").bounds, abs=1e-12)
    assert found["triangles"] == 12
    assert found["check"]["volume"] == pytest.approx(24, rel=1e-12)
    assert found["against"]["hausdorff"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", NORMAL_FORMATS)
def test_normals(name: str, here: Path) -> None:
    run(f"extract bunny.svo.h5 --level 1 --normals -o a.{name}")
    run(f"extract bunny.svo.h5 --level 1 -o plain.{name}")
    mesh, plain = load_mesh(f"a.{name}"), load_mesh(f"plain.{name}")
    assert np.array_equal(mesh.vertices, plain.vertices)
    assert np.array_equal(mesh.faces, plain.faces)
    assert os.path.getsize(f"a.{name}") > os.path.getsize(f"plain.{name}")
    if name == "obj":
        lines = Path("a.obj").read_text().splitlines()
        normals = np.array([line.split()[1:] for line in lines if line.startswith("vn ")], float)
        surface = extract(read_svo("bunny.svo.h5"), level=1)
        assert normals == pytest.approx(surface.normals, abs=1e-8)
        assert any("//" in line for line in lines if line.startswith("f "))


@pytest.mark.parametrize("name", [name for name in MESH_FORMATS if name not in NORMAL_FORMATS])
def test_normals_that_a_format_does_not_hold(name: str, here: Path) -> None:
    message = f"--normals: .{name} holds none: write one of .obj, .ply, .glb"
    assert message in fail(f"extract bunny.svo.h5 --normals -o a.{name}", code=2)
    assert message in fail(f"extract bunny.svo.h5 --normals --format {name} -o a.obj", code=2)


# ---- streams


def test_colours(here: Path) -> None:
    """They are written where the format holds them; otherwise the report says why not."""
    write_svo(attributed(), "a.svo.h5")
    result = run("extract a.svo.h5 --style voxel-faces --json -o a.glb")
    assert json.loads(result.stdout)["coloured"]
    look = load_mesh("a.glb", keep=("appearance",))
    assert len(look.vertices) > json.loads(result.stdout)["vertices"]
    assert look.colours is not None
    plan = json.loads(run("extract a.svo.h5 --style voxel-faces --plan --json -o a.ply").stdout)
    assert plan["stages"][-1] == "colours"
    plain = run("extract a.svo.h5 --style voxel-faces -o a.stl").stderr
    assert "voxtool: colours are left out: .stl holds none: write .obj, .ply, .glb\n" in plain
    merged = run("extract a.svo.h5 --style voxel-faces --merge -o b.glb").stderr
    assert "voxtool: colours are left out: squares of several colours are merged" in merged
    assert load_mesh("b.glb", keep=("appearance",)).colours is None


def test_stdin_and_stdout(here: Path) -> None:
    octree = Path("bunny.svo.h5").read_bytes()
    for more, name in (("", "a.obj"), ("--format stl", "a.stl")):
        run(f"extract bunny.svo.h5 --level 1 -o {name}")
        expected = Path(name).read_bytes()
        for command in (f"extract - --level 1 {more}", f"extract - --level 1 {more} -o -"):
            result = run(command, octree)
            assert result.stdout_bytes == expected
            assert said(result.stderr).groups()[:2] == ("stdin", "stdout")
    run("extract - --level 1 -o b.stl", octree)
    assert Path("b.stl").read_bytes() == expected
    assert run("extract - --level 1 -q --format stl", octree).stderr == ""


# ---- JSON, checks and measures


def test_json(here: Path) -> None:
    result = run("extract bunny.svo.h5 --json --isovalue 0.4 --style marching-cubes --level 0")
    found = json.loads(result.stdout)
    octree = read_svo("bunny.svo.h5")
    surface = extract(octree, isovalue=0.4, style="marching-cubes", level=0)
    assert found.pop("seconds") > 0
    planned = plan_extract(octree, style="marching-cubes", level=0)
    assert set(planned.stages) <= set(found.pop("stages"))
    assert len(found.pop("notes")) == 1
    assert found == {
        "output": "bunny.marching-cubes.obj",
        "bytes": os.path.getsize("bunny.marching-cubes.obj"),
        "dim": 128,
        "style": "marching-cubes",
        "level": 0,
        "isovalue": 0.4,
        "vertices": len(surface.points),
        "triangles": len(surface.faces),
        "cubes_cut": surface.cubes,
        "voxels": octree.count,
        "voxels_below_isovalue": surface.lost.below,
        "voxels_vanished": surface.lost.vanished,
        "volume": surface.volume,
        "octree_volume": octree.volume,
        "volume_ratio": surface.volume / octree.volume,
        "coloured": False,
        "digest": surface.digest(),
        "warnings": [],
    }


def test_the_default_is_the_surface_of_the_voxels(here: Path) -> None:
    """Surface nets of voxels; a coarser one is asked for."""
    found = told("extract bunny.svo.h5 --json")
    assert (found["style"], found["level"]) == ("surface-nets", "voxel")
    assert found["output"] == "bunny.surface-nets.obj"
    assert found["digest"] == extract(read_svo("bunny.svo.h5")).digest()
    assert found == {**told("extract bunny.svo.h5 --json --style surface-nets --level voxel"),
                     "seconds": found["seconds"], "stages": found["stages"]}  # fmt: skip
    cubes = told("extract bunny.svo.h5 --json --style marching-cubes")
    assert cubes["level"] == "voxel"
    assert cubes["volume_ratio"] == pytest.approx(1, abs=0.005)


def test_the_report_says_what_volume_is_lost(here: Path) -> None:
    line = said(run("extract bunny.svo.h5 -o a.obj").stderr)
    found = told("extract bunny.svo.h5 -o a.obj --json")
    assert line[8] == f"{found['volume']:.6g}"
    assert line[9] == f"{found['octree_volume']:.6g}"
    assert float(line[10]) == pytest.approx(100 * (found["volume_ratio"] - 1), abs=0.006)
    write_svo(octree_from_dense(ball((16, 16, 16), 0.25)), "small.svo.h5")
    shrunk = run("extract small.svo.h5 -o a.obj").stderr
    assert "--style marching-cubes keeps its volume" in shrunk
    assert run("extract small.svo.h5 -o a.obj --style marching-cubes").stderr.count("\n") == 1
    assert "--level voxel keeps its volume" in run("extract small.svo.h5 -o a.obj --level 0").stderr
    exact = said(run("extract small.svo.h5 -o a.obj --style voxel-faces").stderr)
    assert (exact[8], exact[10]) == (exact[9], "+0.00")


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("level", ["voxel", 0])
def test_check(style: str, level, here: Path) -> None:
    found = told(f"extract bunny.svo.h5 --style {style} --level {level} --check")
    check = found["check"]
    assert check["closed"] is check["watertight"] is check["manifold"] is True
    assert (check["faces"], check["vertices"]) == (found["triangles"], found["vertices"])
    assert check["euler"] == 2 * check["shells"] - 2 * check["genus"]
    if level == "voxel":
        assert (check["shells"], check["genus"]) == (1, 0)
    octree = read_svo("bunny.svo.h5")
    assert check["octree_volume"] == pytest.approx(octree.count * octree.grid.voxel_volume)
    assert check["volume"] == pytest.approx(check["volume_ratio"] * check["octree_volume"])
    if (style, level) == ("voxel-faces", "voxel"):
        assert check["volume_ratio"] == pytest.approx(1, rel=0, abs=1e-12)
    else:  # nets of large samples shrink
        assert check["volume_ratio"] == pytest.approx(1, abs=0.02 if level == "voxel" else 0.15)


def test_check_counts_shells_and_handles(here: Path) -> None:
    parts = meshes.torus((0, 0, 0), 2, 0.8), meshes.icosphere(2, (6, 0, 0), 1.5)
    write_obj(here / "two.obj", *meshes.join(*parts))
    run("voxelize two.obj --dim 96 -q")
    for style in STYLES:
        check = told(f"extract two.svo.h5 --style {style} --check")["check"]
        assert (check["shells"], check["genus"], check["closed"]) == (2, 1, True)


def test_check_of_merged_blocks(here: Path) -> None:
    """T-junctions are no holes: the surface is closed as a chain."""
    result = run("extract bunny.svo.h5 --style voxel-faces --merge --check")
    found = json.loads(result.stdout)
    assert found["check"]["closed"] is True
    assert found["check"]["volume_ratio"] == pytest.approx(1, rel=0, abs=1e-12)
    assert found["triangles"] < told("extract bunny.svo.h5 --style voxel-faces --json")["triangles"]


def test_check_at_the_border_of_the_grid(here: Path) -> None:
    for name, dense in (("full", np.ones((8, 8, 8), bool)), ("flat", ball((24, 10, 9), 0.6))):
        write_svo(octree_from_dense(dense), f"{name}.svo.h5")
        for style in STYLES:
            check = told(f"extract {name}.svo.h5 --style {style} --check")["check"]
            assert check["closed"]
            assert check["manifold"]


def test_a_check_that_fails_is_exit_code_1_and_says_why(here: Path, monkeypatch) -> None:
    octree = read_svo("bunny.svo.h5")
    for more in ({}, {"style": "surface-nets"}, {"style": "voxel-faces", "merge": True}):
        surface = extract(octree, **more)
        torn = replace(surface, faces=surface.faces[1:])
        assert torn.check()["closed"] is False
    monkeypatch.setattr(Isosurface, "check", lambda _: {"closed": False, "volume": 1.0})
    result = invoke("extract bunny.svo.h5 --check -o a.obj")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["check"]["closed"] is False
    message = result.stderr.splitlines()[-1]
    assert message.startswith("voxtool: error: a.obj: the surface is not closed")


def test_against(here: Path) -> None:
    octree = read_svo("bunny.svo.h5")
    pitch = max(octree.grid.pitch)
    far = {}
    for style in STYLES:
        result = run(f"extract bunny.svo.h5 --style {style} --against bunny.obj --samples 4000")
        found = json.loads(result.stdout)["against"]
        said(result.stderr)
        assert found["samples"] == 4000
        ways = [
            found[f"{a}_to_{b}"] for a, b in (("surface", "reference"), ("reference", "surface"))
        ]
        for way in ways:
            assert 0 < way["mean"] <= way["rms"] <= way["max"]
        assert found["hausdorff"] == max(way["max"] for way in ways)
        voxels = found["voxels"]
        assert found["pitch"] == pitch
        assert voxels["hausdorff"] == pytest.approx(found["hausdorff"] / pitch)
        far[style] = voxels["surface_to_reference"]["rms"]
    assert far["surface-nets"] < far["voxel-faces"] < 1
    assert far["marching-cubes"] < 4  # a sample has four voxels along its side


def test_against_meshes_that_cannot_be_measured(here: Path) -> None:
    """They are refused before anything is written."""
    write_obj(Path("flat.obj"), [(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 2)])
    for mesh, message in (
        ("none.obj", "none.obj: there is no such file"),
        ("bunny.svo.h5", "not a mesh"),
        ("flat.obj", "flat.obj: no area"),
    ):
        assert message in fail(f"extract bunny.svo.h5 --against {mesh} -o a.obj")
        assert message in fail(f"extract bunny.svo.h5 --against {mesh} -o -")


def test_against_the_file_that_is_replaced(here: Path) -> None:
    """The mesh is the one that was there before."""
    run("extract bunny.svo.h5 --level 2 -o a.obj")
    command = "extract bunny.svo.h5 --level 1 --samples 1000 --json"
    os.link("a.obj", "before.obj")
    expected = told(f"{command} --against before.obj -o b.obj")["against"]
    assert told(f"{command} --against a.obj -o a.obj --overwrite")["against"] == expected


# ---- the plan, and memory


def test_plan_foresees_the_surface(here: Path) -> None:
    for style in STYLES:
        plan = told(f"extract bunny.svo.h5 --style {style} --plan --json")
        cubes = told(f"extract bunny.svo.h5 --style {style} --json")["cubes_cut"]
        assert 0.5 < plan["predicted_cut_cubes"] / cubes < 2


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("limit", ["1M", "200K", "60K"])
def test_a_refusal_names_a_level_that_works(style: str, limit: str, here: Path) -> None:
    command = f"extract bunny.svo.h5 --style {style} --max-memory {limit} -o a.obj"
    finest = f"{command} --level voxel"
    message = fail(finest)
    assert "would need" in message
    found = re.search(r"choose level (\d+)", message)
    assert found, message
    run(f"{command} --level {found[1]}")


def test_a_refusal_names_no_level_that_the_octree_has_not(here: Path) -> None:
    message = fail("extract bunny.svo.h5 --max-memory 100 -o a.obj")
    assert message.endswith("allowed: no level fits; or allow more (see --max-memory)")


# ---- usage and failures


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            "extract bunny.svo.h5 --merge",
            "--merge goes with --style voxel-faces: surface-nets has no",
        ),
        (
            "extract bunny.svo.h5 --merge --style marching-cubes",
            "--style voxel-faces: marching-cubes has no",
        ),
        ("extract bunny.svo.h5 --style cubes", "'marching-cubes', 'voxel-faces', 'surface-nets'"),
        ("extract bunny.svo.h5 --level x", "'x': choose voxel, or a level"),
        ("extract bunny.svo.h5 --level 0.5", "'0.5': choose voxel, or a level"),
        ("extract bunny.svo.h5 --isovalue half", "'half' is not a valid float"),
        ("extract bunny.svo.h5 --format svo.h5", "'obj', 'ply', 'stl', 'glb', 'off'"),
    ],
)
def test_usage_errors(command: str, message: str, here: Path) -> None:
    assert message in fail(command, code=2)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        *((f"extract bunny.svo.h5 --isovalue {bad}", "choose a share of set voxels between 0 and 1")
          for bad in ("0", "1", "-0.5", "1.5", "nan", "inf")),
        ("extract bunny.svo.h5 --level 6", "level 6: choose 'voxel' or a level from 0 to 5"),
        ("extract bunny.svo.h5 --level -1", "level -1: choose 'voxel' or a level from 0 to 5"),
        ("extract bunny.svo.h5 -o a", "end it in one of .obj, .ply, .stl, .glb, .off"),
        ("extract .", "is a folder"),
        ("extract bunny.obj", "bunny.obj is a mesh: voxelize it first (voxtool voxelize"),
        ("extract notes.txt", "notes.txt is no octree: expected HDF5"),
        ("extract half.svo.h5", "half.svo.h5: "),
    ],
)  # fmt: skip
def test_failures_are_one_line(command: str, message: str, here: Path) -> None:
    (here / "notes.txt").write_text("a text\n")
    octree = (here / "bunny.svo.h5").read_bytes()
    (here / "half.svo.h5").write_bytes(octree[: len(octree) // 2])
    assert message in fail(command)


def test_naive_extraction_is_the_same_file(here: Path) -> None:
    run("extract bunny.svo.h5 -o few.ply")
    run("extract bunny.svo.h5 --naive -o all.ply")
    assert (here / "all.ply").read_bytes() == (here / "few.ply").read_bytes()
    plans = [told(f"extract bunny.svo.h5 --plan --json {more}") for more in ("", "--naive")]
    assert plans[0]["predicted_tiles"] < plans[1]["predicted_tiles"]
    message = fail("extract bunny.svo.h5 --naive --max-memory 100 -o a.obj")
    assert "no level fits, or leave out naive" in message


@pytest.mark.parametrize("mode", ["surface26", "surface6"])
def test_a_surface_has_no_inside(mode: str, here: Path) -> None:
    run(f"voxelize bunny.obj --dim 32 --mode {mode} -q -o shell.svo.h5")
    for more in ("", "--level voxel", "--style surface-nets", "--style voxel-faces --level 0"):
        message = fail(f"extract shell.svo.h5 {more}")
        assert f"an octree of mode {mode} has no inside" in message
        assert "voxelize with --mode solid" in message
        assert "--style voxel-faces --level voxel" in message
        assert message == fail(f"extract shell.svo.h5 {more} --plan")
    for more in ("", "--level voxel", "--merge"):
        check = told(f"extract shell.svo.h5 --style voxel-faces {more} --check")["check"]
        assert check["closed"]
        assert check["volume_ratio"] == pytest.approx(1, rel=0, abs=1e-12)


def test_solid_with_surface_has_an_inside(here: Path) -> None:
    run("voxelize bunny.obj --dim 32 --with-surface -q -o both.svo.h5")
    assert told("extract both.svo.h5 --style surface-nets --check")["check"]["closed"]


def test_an_empty_result_is_an_error_that_says_what_to_do(here: Path) -> None:
    write_svo(plate(), "plate.svo.h5")
    message = fail("extract plate.svo.h5 --level 0 --isovalue 0.99 -o a.obj")
    assert message.startswith("plate.svo.h5: none of the 81 set voxels lies in a sample")
    assert "isovalue 0.99" in message
    assert "--style surface-nets" in message
    assert "--dim 64" in message
    assert "lower isovalue" in message
    assert "none of the 81" in fail(
        "extract plate.svo.h5 --level 0 --check --against bunny.obj -o a.obj"
    )
    run("extract plate.svo.h5 --level 0 --isovalue 0.2 -o a.obj")
    run("extract plate.svo.h5 -o a.obj")


def test_no_voxel_is_set(here: Path) -> None:
    write_svo(octree_from_dense(np.zeros((16, 16, 16), bool)), "void.svo.h5")
    for style in STYLES:
        message = fail(f"extract void.svo.h5 --style {style}")
        assert message.startswith("void.svo.h5: no voxel is set")


# ---- lost voxels


def test_lost_voxels(here: Path) -> None:
    dense = ball((64, 64, 64), 0.3)
    near = np.count_nonzero(dense)
    dense[4:60, 2, 2] = True  # a hair that no sample holds
    write_svo(octree_from_dense(dense), "hair.svo.h5")
    result = run("extract hair.svo.h5 --level 0")
    assert said(result.stderr)
    lost = LOST.search(result.stderr)
    assert lost, result.stderr
    assert number(lost[3]) == 56
    assert "--style surface-nets" in lost[4]
    assert "--dim 256" in lost[4]
    share = 100 * number(lost[1]) / (near + 56)
    assert float(lost[2]) == pytest.approx(share, rel=0.06)
    found = told("extract hair.svo.h5 --level 0 --json")
    assert (found["voxels_below_isovalue"], found["voxels_vanished"]) == (number(lost[1]), 56)
    for more in ("", "--style voxel-faces", "--style marching-cubes"):
        assert "lie in samples" not in run(f"extract hair.svo.h5 {more}").stderr
    assert "lie in samples" not in run("extract hair.svo.h5 --level 0 --isovalue 0.001").stderr


def test_voxels_below_the_isovalue_that_the_surface_is_near(here: Path) -> None:
    write_svo(octree_from_dense(ball((64, 64, 64))), "ball.svo.h5")
    coarse = "extract ball.svo.h5 --style marching-cubes --level 0"
    assert run(coarse).stderr.count("\n") == 1  # nobody need act on them
    lost = LOST.search(run(f"{coarse} -v").stderr)
    assert lost
    assert lost[3] is None
    found = told(f"{coarse} --json")
    assert number(lost[1]) == found["voxels_below_isovalue"]
    assert len(found["notes"]) == 1


# ---- quiet, verbose, and the bar


def test_the_mesh_is_written_relative_to_an_origin(here: Path) -> None:
    command = "extract bunny.svo.h5 --style marching-cubes --json"
    plain = told(f"{command} -o plain.obj")
    moved = told(f"{command} -o moved.obj --origin 100,-20,3.5")
    assert moved["origin"] == [100, -20, 3.5]
    assert moved["digest"] == plain["digest"]
    own, other = (load_mesh(f"{name}.obj").vertices for name in ("plain", "moved"))
    np.testing.assert_allclose(other, own - (100, -20, 3.5), atol=1e-13)
