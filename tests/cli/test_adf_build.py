"""voxtool adf-build: options as the library's, what it tells, files and pipes, failures."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers import meshes
from helpers.cli import fail, process, run, write_obj

from voxtool import read_adf
from voxtool.adf.construction.build import build_adf, plan_adf
from voxtool.adf.construction.plan import BLOCK_BYTES
from voxtool.adf.construction.survey import cube_of
from voxtool.files.meshes.mesh import load_mesh

COARSE = "--tolerance 0.01 --max-level 3"
SHAPES = {
    "box": meshes.box(0, (4, 3, 2)),
    "open": meshes.open_box(0, (4, 3, 2)),
    "crossing": meshes.join(meshes.box(0, 4), meshes.box((2, 1, 1), 6)),
    "ball": meshes.icosphere(2),
    "triangle": (np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)]), np.array([(0, 1, 2)])),
    "needle": (np.array([(0, 0, 0), (1, 0, 0), (1e-12, 1e-12, 0)]), np.array([(0, 1, 2)])),
    "quad": (np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]), [(0, 1, 2), (0, 2, 3)]),
    "segment": (np.array([(0, 0, 0), (1, 0, 0), (0.5, 0, 0)]), np.array([(0, 1, 2)])),
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch) -> Path:
    """A folder with small meshes."""
    monkeypatch.chdir(tmp_path)
    for name, mesh in SHAPES.items():
        write_obj(tmp_path / f"{name}.obj", *mesh)
    return tmp_path


def told(command: str) -> dict:
    return json.loads(run(f"adf-build {command} --json").stdout)


# ---- options


@pytest.mark.parametrize(
    ("options", "request_"),
    [
        ("", {}),
        ("--band 0.05", {"band": 0.05}),
        ("--band 0", {"band": 0.0}),
        ("--cracks", {"continuous": False}),
        ("--continuous", {"continuous": True}),
        ("--no-bounds", {"bounds": False}),
        ("--fill none", {"sign": "none"}),
        ("--fill winding", {"sign": "winding"}),
        ("--max-bytes 3k", {"max_bytes": 3072}),
    ],
)
def test_options_are_those_of_the_library(options: str, request_: dict, here: Path) -> None:
    found = told(f"ball.obj {COARSE} {options}")
    expected = build_adf(load_mesh("ball.obj"), tolerance=0.01, max_level=3, **request_)
    field = read_adf("ball.adf.h5")
    assert field.digest() == expected.digest() == found["digest"]
    assert field.reached == expected.reached == {name: found[name] for name in expected.reached}
    for name in ("tolerance", "max_level", "band", "continuous", "sign", "origin", "side"):
        assert getattr(field, name) == getattr(expected, name)
    assert (field.bounds is None) == (not request_.get("bounds", True))
    assert found["textures"] == field.sizes()
    assert found["blocks"] == len(field.voxels)
    assert found["leaves_by_level"] == field.leaves_by_level()
    assert found["stages"]
    assert field.source_sha256 == load_mesh("ball.obj").source_sha256


def test_defaults(here: Path) -> None:
    field = read_adf(told("ball.obj --max-bytes 2k")["output"])
    assert (field.tolerance, field.max_level, field.band) == (1e-3, 9, math.inf)
    assert field.continuous
    assert field.bounds is not None


def test_tolerance_in_the_units_of_the_mesh(here: Path) -> None:
    side = cube_of(load_mesh("ball.obj"))[1]
    assert side == pytest.approx(8 / 7 * np.ptp(SHAPES["ball"][0], axis=0).max())
    found = told(f"ball.obj --tolerance-world {0.01 * side!r} --max-level 3")
    assert found["tolerance"] == pytest.approx(0.01, rel=1e-15)
    assert found["missed"] == told(f"ball.obj {COARSE}")["missed"]


@pytest.mark.parametrize("most", [5_000, 20_000, 60_000])
def test_size_is_what_was_asked_for(most: int, here: Path) -> None:
    """Within a tenth; and of a level that does not fit, the largest errors were refined."""
    found = told(f"box.obj --tolerance 1e-3 --max-level 6 --max-bytes {most}")
    assert 0.9 * most <= sum(found["textures"].values()) <= 1.1 * most
    assert found["blocks"] == most // BLOCK_BYTES
    assert found["missed"] > 0
    more = told(f"box.obj --tolerance 1e-3 --max-level 6 --max-bytes {2 * most}")
    assert more["worst"]["error"] <= found["worst"]["error"]


# ---- the report


def test_the_report(here: Path) -> None:
    result = run(f"adf-build box.obj {COARSE} -v")
    field = read_adf("box.adf.h5")
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert all(line.startswith("voxtool: ") for line in lines)
    first = "voxtool: box.obj -> box.adf.h5: tolerance 0.01, sign pseudonormal; "
    assert lines[0].startswith(f"{first}{field.reached['leaves']:,} leaves in ")
    near = field.reached["errors"]["near the surface"]
    assert (
        f"; error near the surface rms {near['rms']:.2g} sides at {near['points']:,} points; "
        in (lines[0])
    )
    worst = field.reached["worst"]
    assert (
        f" points; {field.reached['missed']:,} leaves over the tolerance by up to "
        f"{worst['error'] - 0.01:.2g} sides: a higher --max-level helps, "
    ) in lines[0]
    assert run(f"adf-build box.obj {COARSE}").stderr.count("\n") == 1
    assert ": more --max-bytes helps" in run("adf-build box.obj --max-bytes 5k").stderr
    for line, where in zip(lines[1:3], ("in the cube", "near the surface"), strict=True):
        errors = field.reached["errors"][where]
        assert line == (
            f"voxtool:   error {where}: 99 % within {errors['p99']:.3g}, rms {errors['rms']:.3g}, "
            f"max {errors['max']:.3g} sides; {100 * errors['within']:.2f} % of "
            f"{errors['points']:,} points within the tolerance"
        )
    run(f"adf-build box.obj {COARSE} --no-errors -o unmeasured.adf.h5")
    unmeasured = read_adf("unmeasured.adf.h5")
    assert "errors" not in unmeasured.reached
    assert unmeasured.digest() == field.digest()
    place = ", ".join(f"{x:.6g}" for x in worst["where"])
    assert lines[3] == (
        f"voxtool:   missed    {field.reached['missed']:,} leaves that could have met the "
        f"tolerance, the worst at level {worst['level']} near ({place})"
    )
    words = [line.split()[1] for line in lines[4:]]
    assert [word for word in words[:4] if word != "medial"][:3] == ["cells", "leaves", "textures"]
    assert ("medial" in words) == ("medial" in field.reached)
    assert "jumps" not in result.stderr
    assert "warning" not in result.stderr


def test_strict_tells_and_writes(here: Path) -> None:
    exact = run("adf-build box.obj --tolerance 0.2 --max-level 3 --strict")
    assert exact.stderr.count("\n") == 1
    for options in ("", "--json"):
        result = process(f"adf-build box.obj {COARSE} --strict -q {options}", cwd=here)
        missed = read_adf("box.adf.h5").reached["missed"]
        assert result.returncode == 1
        assert result.stderr.decode() == (
            f"voxtool: error: box.adf.h5: {missed:,} leaves miss the tolerance (--strict): choose "
            "a higher --max-level, a larger --tolerance or more --max-bytes\n"
        )
        Path("box.adf.h5").unlink()
        assert (json.loads(result.stdout)["missed"] if options else missed) == missed


@pytest.mark.parametrize(
    ("mesh", "fault"),
    [
        ("open", "is not closed: 4 boundary edges"),
    ],
)
@pytest.mark.parametrize(
    ("sign", "says"),
    [
        ("", "inside is where its winding number is over 1/2"),
        ("--fill none", ""),
    ],
)
def test_meshes_without_certain_signs(
    mesh: str, fault: str, sign: str, says: str, here: Path
) -> None:
    lines = run(f"adf-build {mesh}.obj {COARSE} {sign} -v").stderr.splitlines()
    field = read_adf(f"{mesh}.adf.h5")
    warnings = [line for line in lines if "warning" in line]
    assert warnings == lines[: says != ""]
    for line in warnings:
        assert line.startswith(f"voxtool: warning: {mesh}.obj {fault}")
        assert says in line
        assert field.sign == ("pseudonormal" if "pseudo" in sign else "winding")
        jumps = [line for line in lines if line.startswith("voxtool:   jumps ")]
        assert len(jumps) == (field.reached["jumps"] > 0)


def test_meshes_that_pass_through_themselves_have_winding_numbers(here: Path) -> None:
    run(f"adf-build crossing.obj {COARSE}")
    field = read_adf("crossing.adf.h5")
    assert field.sign == "winding"
    assert not field.plan["closed"]
    assert field.plan["crossed_triangles"] == 12
    centre = np.array([(3.0, 3.0, 3.0), (1, 2, 2), (5, 5, 5), (5, 0.5, 0.5)])
    assert (np.sign(field.distance(centre)) == [-1, -1, -1, 1]).all()


# ---- plans


def test_plan(here: Path) -> None:
    options = "--tolerance 1e-3 --max-level 4"
    plan = plan_adf(load_mesh("open.obj"), tolerance=1e-3, max_level=4).plan
    found = json.loads(run(f"adf-build open.obj {options} --plan --json").stdout)
    assert found == json.loads(json.dumps(plan.as_dict()))
    text = run(f"adf-build open.obj {options} --plan").stdout
    assert "tolerance 0.001 sides, levels to 4, sign winding\n" in text
    assert f"at most about {plan.blocks:,}, " in text
    for what, why in plan.left_out.items():
        assert f"left out   {what}: {why}\n" in text
    for stage in plan.stages:
        assert stage in text
    assert not list(here.glob("*.adf.h5"))
    field = build_adf(load_mesh("open.obj"), tolerance=1e-3, max_level=4)
    assert sum(plan.refined) == len(field.voxels) == plan.blocks  # few levels: all are counted
    assert field.plan == plan.decisions()


def test_plan_foretells_what_is_built(here: Path) -> None:
    """The prediction is within a factor of 3 where more levels are refined than are counted."""
    options = "ball.obj --tolerance 1e-4 --max-level 7 --band 0.01"
    plan = json.loads(run(f"adf-build {options} --plan --json").stdout)
    assert len(plan["refined_cells"]) < 7
    assert 1 / 3 < told(options)["blocks"] / plan["predicted_blocks"] < 3


# ---- pipes


def test_pipes(here: Path) -> None:
    mesh = Path("ball.obj").read_bytes()
    run(f"adf-build ball.obj {COARSE} -q")
    digest = read_adf("ball.adf.h5").digest()
    built = process(f"adf-build - {COARSE}", input=mesh)
    assert built.returncode == 0, built.stderr
    assert built.stderr.startswith(b"voxtool: stdin -> stdout: tolerance 0.01, sign pseudonormal; ")
    info = process("adf-info - --digest", input=built.stdout)
    assert info.stdout.decode().strip() == digest
    points = io.BytesIO()
    np.save(points, np.array([(0.0, 0, 0), (0, 0, 1.05)]))
    Path("points.npy").write_bytes(points.getvalue())
    answers = process("adf-query - points.npy -o answers.csv -q", input=built.stdout, cwd=here)
    assert answers.returncode == 0, answers.stderr
    found = np.loadtxt("answers.csv", delimiter=",", skiprows=1, usecols=0)
    assert np.array_equal(found, read_adf("ball.adf.h5").distance([(0.0, 0, 0), (0, 0, 1.05)]))


# ---- meshes of every sort


@pytest.mark.parametrize("name", ["triangle", "needle", "quad", "segment"])
def test_meshes_without_inside(name: str, here: Path) -> None:
    for options in ("", "--fill none"):
        run(f"adf-build {name}.obj {COARSE} {options}")
        field = read_adf(f"{name}.adf.h5")
        field.validate()
        on_it = field.query([(0.0, 0, 0), (0.5, 0, 0)], bounds=True)
        assert on_it.bound is not None
        assert (np.abs(on_it.distance) <= on_it.bound).all()
        if options:
            assert (field.voxels >= 0).all()


@pytest.mark.parametrize("exponent", [-140, 140])
def test_coordinates_far_from_one(exponent: int, here: Path) -> None:
    vertices, faces = SHAPES["box"]
    write_obj(here / "scaled.obj", vertices * 10.0**exponent, faces)
    run(f"adf-build scaled.obj {COARSE}")
    run(f"adf-build box.obj {COARSE}")
    one, other = read_adf("scaled.adf.h5"), read_adf("box.adf.h5")
    assert np.allclose(one.voxels, other.voxels, rtol=0, atol=1e-7)
    assert one.side == pytest.approx(other.side * 10.0**exponent)


@pytest.mark.parametrize("scale", ["1e300", "1e-300"])
def test_coordinates_that_are_beyond(scale: str, here: Path) -> None:
    Path("far.obj").write_text(f"v 0 0 0\nv {scale} 0 0\nv 0 {scale} 0\nf 1 2 3\n")
    assert fail(f"adf-build far.obj {COARSE}") == (
        f"far.obj: its extent of {float(scale):g} is beyond the range of 2^±500: scale the mesh"
    )


# ---- failures


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        ("--tolerance -1", 3, "tolerance -1: give 0 to 1024 sides"),
        ("--tolerance nan", 3, "tolerance nan: give 0 to 1024 sides"),
        ("--tolerance inf", 3, "tolerance inf: give 0 to 1024 sides"),
        ("--tolerance 1e300", 3, "tolerance 1e+300: give 0 to 1024 sides"),
        ("--band 1e300", 3, "band 1e+300: give 0 to 1024 sides"),
        ("--tolerance x", 2, "'x' is not a valid float"),
        ("--tolerance-world -1", 2, "--tolerance-world -1: give a length from 0 on"),
        ("--tolerance-world nan", 2, "--tolerance-world nan: give a length from 0 on"),
        ("--tolerance-world inf", 2, "--tolerance-world inf: give a length from 0 on"),
        ("--tolerance 1 --tolerance-world 1", 2, "drop one of them"),
        ("--max-level 0", 2, "0 is not in the range 1<=x<=21"),
        ("--max-level 22", 2, "22 is not in the range 1<=x<=21"),
        ("--max-level 2.5", 2, "'2.5' is not a valid integer"),
        ("--band -1", 3, "band -1: give 0 to 1024 sides"),
        ("--band nan", 3, "band nan: give 0 to 1024 sides"),
        ("--max-bytes 1", 3, f"max bytes 1: one block takes {BLOCK_BYTES}"),
        ("--max-bytes many", 2, "'many' is no number of bytes"),
        ("--fill inside", 2, "'inside' is not one of 'auto', 'parity', 'nonzero', 'winding'"),
        ("--tolerance 1e-4 --max-memory 100k", 4, "--max-level 3 fits, or ask for a larger"),
    ],
)
def test_failures_are_one_line(options: str, code: int, says: str, here: Path) -> None:
    assert says in fail(f"adf-build box.obj {options}", code)


def test_meshes_that_are_none(here: Path) -> None:
    Path("empty.obj").write_text("")
    Path("point.obj").write_text("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\n")
    Path("nan.obj").write_text("v 1 2 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert fail("adf-build none.obj").startswith("none.obj: ")
    assert fail("adf-build empty.obj").startswith("empty.obj: ")
    assert fail("adf-build nan.obj").startswith("nan.obj, line 1: ")
    assert fail("adf-build point.obj").endswith("the mesh has no size")
    assert fail("adf-build -").startswith("standard input: the file is empty")
