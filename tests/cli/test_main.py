"""The command line: in this process through click's runner, and as the user runs it in a shell."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import meshes
from helpers.cli import (
    ENVIRONMENT,
    MODULE,
    fail,
    invoke,
    on_terminal,
    process,
    run,
    screen,
    told,
    write_obj,
)

from voxtool.cli import main, options
from voxtool.cli.options import output_of
from voxtool.files import read_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.grid import Grid
from voxtool.svo.voxelization.voxelize import voxelize

MODES = ("surface26", "surface6", "solid")


# ---- help


def all_commands(command: click.Command = main.cli, path: tuple[str, ...] = ()):
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child
            yield from all_commands(child, (*path, name))


COMMANDS = dict(all_commands())


def examples(command: click.Command) -> list[str]:
    text = (command.help or "").partition("Examples:\n")[2]
    return [line.strip() for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help(path, flag) -> None:
    result = run(" ".join([*path, flag]))
    assert result.stderr == ""
    text = COMMANDS[path].help or ""
    sentence = text.partition("\n\n")[0]
    assert re.fullmatch(r"[A-Z][^.]*(\.[a-z0-9]+[^.]*)*\.", " ".join(sentence.split())), sentence
    if path != ("completion",):
        assert re.search(r"\b(units|ms|s|GB|voxels|diagonals)\b", text.partition("Examples:")[0])
    assert len(examples(COMMANDS[path])) >= 2
    for line in examples(COMMANDS[path]):
        assert line.startswith("voxtool ")
        assert line in result.stdout  # click has not folded it
    for parameter in COMMANDS[path].params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{parameter.name} is not explained"


@pytest.mark.parametrize(
    "line",
    # test_docs.py parses all; benches and the self-test run in tests of their own
    sorted(
        {x for c in COMMANDS.values() for x in examples(c) if not re.search("bench|selftest", x)}
    ),
)
def test_every_example_runs(line: str, here: Path, shell) -> None:
    line = line.replace("--dim 512", "--dim 64").replace("--tolerance 1e-4", "--tolerance 1e-2")
    line = line.replace("--dim 200", "--dim 140")  # where a drain has the least radius
    if re.match("voxtool (hollow|repair)", line) and "--dim" not in line:
        line += " --dim 140"  # the default takes seconds
    if re.search("[|<>$]", line):
        done = subprocess.run(["sh", "-c", line], env=shell, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    else:
        done = run(line.removeprefix("voxtool "))
    assert "error:" not in done.stderr


def test_no_command_shows_the_help_and_is_a_usage_error(here: Path) -> None:
    for command in ("", "bench"):
        result = invoke(command)
        assert (result.exit_code, result.stdout) == (2, "")
        assert "Examples:" in result.stderr


def test_version() -> None:
    from voxtool import __version__

    assert run("--version").stdout == f"voxtool {__version__}\n"
    assert process("--version").stdout.decode().strip() == f"voxtool {__version__}"


@pytest.mark.parametrize("arguments", [["--version"], ["-h"], ["voxelize", "-h"], ["voxelize"]])
def test_start_up_imports_nothing_heavy(arguments) -> None:
    code = (
        "import sys; from voxtool.__main__ import main\n"
        f"sys.argv[1:] = {arguments!r}\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'trimesh', 'pyopencl', 'h5py', 'lxml', 'PIL', 'tempfile'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True, capture_output=True)


def test_a_plain_solid_imports_what_it_needs(tmp_path) -> None:
    """A mesh with a hole, for which --fill auto compares no rules, needs no modules of attributes,
    floods, workers and other formats."""
    vertices, faces = meshes.icosphere(2, (0.0, 0.0, 0.0), 1.0)
    write_obj(tmp_path / "open.obj", vertices, faces[1:])
    code = (
        "import os, sys; from voxtool.__main__ import main\n"
        "sys.argv[1:] = ['voxelize', 'open.obj', '--dim', '16', '--mode', 'solid']\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code\n"
        "absent = {'numpy.ma', 'voxtool.cli.workers'}\n"
        "absent |= {'voxtool.svo.attribution.colours', 'voxtool.svo.attribution.fraction'}\n"
        "absent |= {'voxtool.svo.attribution.labels', 'voxtool.svo.voxelization.fill_choice'}\n"
        "absent |= {'voxtool.svo.sets.thin', 'voxtool.svo.queries.query'}\n"
        "absent |= {'voxtool.svo.voxelization.fill.flood', 'voxtool.files.meshes.gltf'}\n"
        "absent |= {'voxtool.files.meshes.threemf'}\n"
        "found = absent & set(sys.modules)\n"
        "assert not found, found\n"
        "assert os.environ['OPENBLAS_NUM_THREADS'] == '1'"
    )
    environment = {k: v for k, v in ENVIRONMENT.items() if k != "OPENBLAS_NUM_THREADS"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, cwd=tmp_path)


# What a command on a cube of 12 faces may import: packages, and their modules.
EVERY = {
    "": "__main__ arrays choices claims cli errors files job limits memory mesh morton opencl svo"
    " vector version watch",
    "cli": "failures inputs main options placing runner",
    "files": "formats storage",
    "files.storage": "atomic streams",
    "mesh": "appearance collinear mesh once topology",
    "opencl": "builder cache device discovery driver headers launch primitives program",
}
READ = {"files": "meshes", "files.meshes": "companions mesh obj placement",
        "files.storage": "numbers unpacked", "mesh": "watertight"}  # fmt: skip
STORED = {"": "grid", "files": "octrees", "files.octrees": "svo_hdf5",
          "files.storage": "hdf5 schema", "svo": "octree",
          "svo.octree": "attributes content layout links octree validate"}  # fmt: skip
IMPORTED = {
    "voxelize cube.obj --dim 64": [EVERY, READ, STORED, {
        "cli": "in_windows many voxelize", "files": "lattices", "mesh": "lengths", "": "units",
        "svo": "attribution voxelization", "svo.octree": "build", "svo.attribution": "request",
        "svo.voxelization": "connected fill lattice plan scan_conversion voxelize",
        "svo.voxelization.connected": "about", "svo.voxelization.fill": "rows",
    }],
    "extract cube.svo.h5": [EVERY, STORED, {
        "": "spatial", "cli": "extract", "files": "meshes", "files.meshes": "mesh_writers",
        "mesh": "srgb", "opencl": "histopyramid", "spatial": "bvh", "svo": "surface",
        "svo.octree": "exact_sums",
        "svo.surface": "case_tables cut_cells dual extract isosurface plan samples words",
    }],
    "distance cube.obj points.txt": [EVERY, READ, {
        "": "distances spatial", "cli": "distance many", "files": "tables",
        "files.meshes": "ply", "files.tables": "answers points", "mesh": "counts srgb",
        "svo": "voxelization", "svo.voxelization": "inside",
        "spatial": "boundary bvh crossings distance fans fill_rule insides pseudonormals"
        " self_intersections signed_distance winding_number",
    }],
}  # fmt: skip


def test_a_cube_imports_these_modules_alone(tmp_path) -> None:
    """Nothing of what a simple scene does not need, and no library beside numpy, pyopencl and
    h5py."""
    write_obj(tmp_path / "cube.obj", *meshes.box(0.0, 1.0))
    (tmp_path / "points.txt").write_text("0.1 0.2 0.3\n", encoding="utf-8")
    code = (
        "import sys; from voxtool.__main__ import main\n"
        "try: main()\n"
        "except SystemExit as end: assert not end.code\n"
        "names = {'scipy', 'networkx', 'trimesh', 'PIL', 'lxml', 'meshio'} & set(sys.modules)\n"
        "names |= {m.partition('.')[2] for m in sys.modules if m.startswith('voxtool.')}\n"
        "print('imported', *sorted(names), file=sys.stderr)"
    )
    for command, groups in IMPORTED.items():
        allowed = {
            f"{package}.{name}".lstrip(".")
            for group in groups
            for package, names in group.items()
            for name in names.split()
        }
        run = [sys.executable, "-c", code, *command.split()]
        done = subprocess.run(run, env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True)
        assert "imported" in done.stderr, done.stderr
        found = set(done.stderr.split("imported", 1)[1].split())
        assert found <= allowed, (command, sorted(found - allowed))
        assert found >= allowed, (command, sorted(allowed - found))


# ---- usage


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("nope", "No such command 'nope' (see voxtool -h)"),
        ("voxelize", "Missing argument 'MESH...' (see voxtool voxelize -h)"),
        ("voxelize bunny.obj --dim 7", "7 is not in the range 8<=x<=65536"),
        ("voxelize bunny.obj --dim 65537", "65537 is not in the range 8<=x<=65536"),
        ("voxelize bunny.obj --dim x", "'x' is not a valid integer"),
        ("voxelize bunny.obj --mode shell", "'surface26', 'surface6', 'solid'"),
        ("voxelize bunny.obj --bbox 0 0 0", "'0,0,0' is no box: write 0,0,0,1,1,1"),
        ("voxelize bunny.obj --margin -1", "-1 is not in the range x>=0"),
        ("voxelize bunny.obj --max-memory lots", "'lots' is no number of bytes: write 800M or 8G"),
        ("voxelize bunny.obj --max-memory 0", "'0' is no number of bytes"),
        ("voxelize bunny.obj --format obj", "'svo.h5', 'svo.xml', 'svo.xml.gz'"),
        ("voxelize bunny.obj --dim 64 --pitch 1", "--dim and --pitch both set the voxel size"),
        ("voxelize bunny.obj --like bunny.svo.h5 --dim 64", "--like sets the grid: drop --dim"),
        (
            "voxelize bunny.obj --like bunny.svo.h5 --pitch 1 --margin 0",
            "--like sets the grid: drop --pitch and --margin",
        ),
        ("voxelize bunny.obj --like bunny.svo.h5 --fit stretch", "drop --fit"),
        ("voxelize bunny.obj --shape 8,8,8", "--origin, --shape and --spacing go together"),
        (
            "voxelize bunny.obj --shape 8,8,8 --origin 0,0,0 --spacing 1 --dim 8",
            "--origin, --shape and --spacing set the grid: drop --dim",
        ),
        ("voxelize bunny.obj --shape 8,8", "'8,8' is no shape: write 256, or 256,256,128"),
        ("import mask.npy --label 1 --threshold 1", "--threshold and --label both say what is set"),
        ("voxelize bunny.obj --fit stretch --margin 2", "--fit stretch goes with --dim alone"),
        ("voxelize bunny.obj --mode surface6 --with-surface", "surface6 is a surface"),
        ("export bunny.svo.h5", "where to? Give -o OUT, ending in one of .npy"),
        ("export bunny.svo.h5 -o a.png --slice q=1", "'q=1' is no plane of voxels: write z=128"),
        ("export bunny.svo.h5 -o a.npy --slice z=1", "--slice goes with .png"),
        ("bench voxelize bunny.obj --dims 64,x", "'x' is not a valid integer"),
        ("bench voxelize bunny.obj --dims 64,4", "4 is not in the range 8<=x<=65536"),
        ("bench voxelize bunny.obj --modes solid,shell", "'shell' is not one of"),
        ("bench voxelize", "Missing argument 'MODELS...'"),
    ],
)
def test_usage_errors(command: str, message: str, here: Path) -> None:
    assert message in fail(command, code=2)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("voxelize bunny.svo.h5", "not a mesh"),
        ("voxelize bunny.obj --like none.svo.h5", "none.svo.h5: there is no such file"),
        ("voxelize bunny.obj --pitch 0", "pitch 0.0 is not a positive size"),
        ("voxelize bunny.obj --pitch nan", "pitch nan is not a positive size"),
        ("voxelize bunny.obj --pitch 1e-9", "choose at least"),
        ("voxelize bunny.obj --pitch 1e-320", "choose at least"),
        ("voxelize bunny.obj --dim 8 --margin 4", "choose at most 3"),
        ("voxelize bunny.obj --bbox 1 1 1 0 0 0", "is empty or not finite"),
        ("voxelize bunny.obj --bbox 1e9 0 0 1.1e9 1 1 --pitch 1", "choose"),
        ("voxelize bunny.obj --device 99", "choose one of 0: "),
        ("svo-info bunny.obj", "is a mesh: voxelize it first (voxtool voxelize bunny.obj)"),
        ("svo-info .", "is a folder"),
        ("voxelize bunny.obj --shape 0,8,8 --origin 0,0,0 --spacing 1", "grid of 0 x 8 x 8 voxels"),
        ("import bunny.obj", "bunny.obj is a mesh: voxelize it: voxtool voxelize bunny.obj"),
        ("import none.npy", "none.npy: there is no such file"),
        ("export bunny.obj -o a.npy", "bunny.obj is a mesh: make an octree or a field of it first"),
        ("export bunny.svo.h5 -o a.foo", "end it in one of .npy, "),
        ("export bunny.svo.h5 -o -", "give --format, one of .npy"),
        ("export bunny.svo.h5 -o a.png --slice z=128", "lies outside the grid: choose 0 to 127"),
        ("bench voxelize none.obj --dims 16", "none.obj: there is no such file"),
    ],
)
def test_failures_are_one_line(command: str, message: str, here: Path) -> None:
    assert message in fail(command)


def test_stray_errors_of_the_system_are_one_line_too(here: Path) -> None:
    @click.command
    @click.argument("kind")
    def stray(kind: str) -> None:
        raise {"memory": MemoryError(), "disk": OSError(28, "No space left", "a.h5")}[kind]

    group = main.Voxtool("voxtool", commands=[stray])
    for kind, code, message in (
        (
            "memory",
            4,
            "this machine has not enough memory: choose a smaller dim, picture or number of points",
        ),
        ("disk", 3, "a.h5: No space left"),
    ):
        result = CliRunner().invoke(group, ["stray", kind])
        assert (result.exit_code, result.stderr) == (code, f"voxtool: error: {message}\n")


# ---- voxelize


def test_the_report_of_voxelize(here: Path) -> None:
    result = run("voxelize bunny.obj --dim 64")
    assert result.stdout == ""
    octree = read_svo("bunny.svo.h5")
    assert re.fullmatch(
        r"voxtool: bunny\.obj -> bunny\.svo\.h5: solid by parity, dim 64, pitch [\d.]+; "
        rf"{octree.count:,} voxels in [\d.]+ kB, \d+\.\d\d s\n",
        result.stderr,
    )


@pytest.mark.parametrize("mode", MODES)
def test_voxelize_is_the_library(mode: str, here: Path) -> None:
    run(f"voxelize bunny.obj --dim 40 --mode {mode} -o a.svo.h5")
    mesh = load_mesh("bunny.obj")
    octree = read_svo("a.svo.h5")
    assert octree.digest() == voxelize(mesh, Grid.fit(mesh, 40), mode).digest()
    assert octree.source_sha256 == hashlib.sha256((here / "bunny.obj").read_bytes()).hexdigest()


def test_defaults_and_with_surface(here: Path) -> None:
    run("voxelize bunny.obj -o a.svo.h5")
    octree = read_svo("a.svo.h5")
    assert (octree.grid.dim, octree.mode, octree.fill) == (256, "solid", "parity")
    run("voxelize bunny.obj --dim 32 --with-surface -o a.svo.h5")
    assert read_svo("a.svo.h5").mode == "solid+surface26"


def test_default_name_is_in_the_current_folder(here: Path) -> None:
    (here / "models").mkdir()
    packed = here / "models" / "Rabbit.OBJ.GZ"
    packed.write_bytes(gzip.compress((here / "bunny.obj").read_bytes()))
    run("voxelize models/Rabbit.OBJ.GZ --dim 16")
    assert read_svo("Rabbit.svo.h5").count > 0
    assert os.listdir("models") == ["Rabbit.OBJ.GZ"]


def test_default_output() -> None:
    for stem, sources in {
        "bunny": "bunny.obj a/b/bunny.obj.gz bunny a/b/bunny.svo.xml.gz bunny.h5",
        "bunny.v2": "bunny.v2.stl bunny.v2.svo.h5 bunny.v2.tet.h5",
        ".obj": ".obj",
    }.items():
        for source in sources.split():
            assert output_of(source, "svo.h5") == f"{stem}.svo.h5"
    assert output_of("-", "svo.h5") == "-"


@pytest.mark.parametrize("name", ["a.svo.h5", "a.svo.xml", "a.svo.xml.gz"])
def test_formats_have_one_digest(name: str, here: Path) -> None:
    run(f"voxelize bunny.obj --dim 24 -o {name}")
    run("voxelize bunny.obj --dim 24 --format svo.xml -o plain")
    digest = run(f"svo-info {name} --digest").stdout
    assert re.fullmatch(r"[0-9a-f]{64}\n", digest)
    assert digest == run("svo-info plain --digest").stdout


def test_stdin_and_stdout(here: Path) -> None:
    mesh = (here / "bunny.obj").read_bytes()
    run("voxelize bunny.obj --dim 32 -o a.svo.h5")
    digest = run("svo-info a.svo.h5 --digest").stdout
    for command in ("voxelize - --dim 32", "voxelize - --dim 32 -o -"):
        result = run(command, mesh)
        assert result.stdout_bytes.startswith(b"\x89HDF")
        assert result.stderr.startswith("voxtool: stdin -> stdout: solid")
        assert run("svo-info - --digest", result.stdout_bytes).stdout == digest
    result = run("voxelize - --dim 32 --format svo.xml -o - --json", mesh)
    assert result.stdout_bytes.startswith(b"<?xml")
    assert json.loads(result.stderr)["output"] == "-"
    assert run("svo-info - --digest", result.stdout_bytes).stdout == digest
    run("voxelize - --dim 32 -o b.svo.h5", gzip.compress(mesh, mtime=0))
    assert run("svo-info b.svo.h5 --digest").stdout == digest


@pytest.mark.parametrize(
    ("options", "shape", "origin", "pitch"),
    [
        ("--pitch 0.125 --margin 2", (36, 28, 20), -0.25, 0.125),
        ("--bbox -1 -1 -1 7 5 3 --dim 32", (32, 24, 16), -1.0, 0.25),
        ("--bbox 0 0 0 4 3 2 --pitch 0.25 --margin 1", (18, 14, 10), -0.25, 0.25),
    ],
)
def test_the_grid_by_hand(options: str, shape, origin: float, pitch: float, here: Path) -> None:
    run(f"voxelize open.obj --mode surface26 -q -o a.svo.h5 {options}")
    assert read_svo("a.svo.h5").grid == Grid(shape, origin, pitch)


def test_grids_like_another_and_stretched(here: Path) -> None:
    run("voxelize open.obj --like bunny.svo.h5 --mode surface26 -o a.svo.h5")
    assert read_svo("a.svo.h5").grid == read_svo("bunny.svo.h5").grid
    run("voxelize open.obj --mode surface26 --dim 20 --fit stretch -o a.svo.h5")
    assert read_svo("a.svo.h5").grid == Grid.fit(load_mesh("open.obj"), 20, fit="stretch")


@pytest.mark.parametrize(
    ("fill", "says"),
    [
        ("", "; 1 hole, filled where its winding number is 1/2 or more"),
        ("--fill parity", "; filled by parity, rows of voxels along x leak where they pass a gap"),
        ("--fill nonzero", "; filled where crossings do not cancel, rows of voxels along x leak"),
        ("--fill winding", None),
        ("--fill flood --gap 2", None),
    ],
)
def test_open_meshes_are_reported_and_filled(fill: str, says: str | None, here: Path) -> None:
    lines = run(f"voxelize open.obj --dim 16 {fill} -o a.svo.h5").stderr.splitlines()
    rule = (fill or "--fill winding").removeprefix("--fill ").replace(" --gap ", "+gap")
    assert (read_svo("a.svo.h5").mode, read_svo("a.svo.h5").fill) == ("solid", rule)
    assert f"solid by {rule}, dim 16" in lines[-1 if fill else 0]
    assert len(lines) == 1 + (says is not None)
    if says is not None:
        line = lines[0 if fill else 1]
        assert line.startswith("voxtool: " + "warning: " * bool(fill))
        assert "open.obj is not closed: 4 boundary edges, 0 non-manifold edges" in line
        assert says in line


def test_a_mesh_that_is_inside_out(here: Path) -> None:
    text = (here / "open.obj").read_text().splitlines()
    turned = ["f " + " ".join(line.split()[:0:-1]) if line[0] == "f" else line for line in text]
    (here / "turned.obj").write_text("\n".join(turned) + "\n")
    said = run("voxelize turned.obj --dim 16 -o a.svo.h5").stderr
    assert "faces turned outward; winding numbers keep 100.0 % of its outer surface" in said
    assert read_svo("a.svo.h5").count > 0
    said = run("voxelize turned.obj --dim 16 --fill winding -o a.svo.h5").stderr
    assert "turned.obj sets no voxel: it is inside out" in said
    assert "choose fill auto, which turns its faces outward, parity or nonzero" in said
    assert read_svo("a.svo.h5").count == 0


def test_rules_and_gaps_that_do_not_go_together(here: Path) -> None:
    assert "--gap goes with --mode solid --fill flood" in fail("voxelize open.obj --gap 2", code=2)
    assert "'luck' is not one of" in fail("voxelize open.obj --fill luck", code=2)
    assert "choose from 0 to 16 voxels" in fail("voxelize open.obj --dim 16 --fill flood --gap 17")


def test_the_plan_names_the_rule(here: Path) -> None:
    text = run("voxelize open.obj --dim 16 --plan").stdout
    assert "winding; 1 hole, 2 cap triangles" in text
    assert re.search(r"scene +10 triangles", text)
    plan = told("voxelize open.obj --dim 16 --plan --json")
    assert (plan["fill"], plan["holes"], plan["cap_triangles"]) == ("winding", 1, 2)
    assert plan["triangles"] == 10
    assert {"holes", "near holes"} <= set(plan["stages"])
    text = run("voxelize bunny.obj --dim 16 --plan --fill winding").stdout
    assert re.search(r"left out +winding numbers near holes: no edge bounds a hole", text)
    text = run("voxelize open.obj --dim 16 --plan --fill flood --gap 3").stdout
    assert "flood+gap3" in text
    assert "left out   crossings, rows and fill: the outside is flooded" in text


def test_no_warning_without_reason(here: Path) -> None:
    assert "warning" not in run("voxelize open.obj --dim 16 --mode surface6").stderr
    assert "warning" not in run("voxelize bunny.obj --dim 16").stderr


def test_json_of_voxelize(here: Path) -> None:
    result = run("voxelize bunny.obj --dim 32 --json")
    assert result.stderr == ""
    found = json.loads(result.stdout)
    octree = read_svo("bunny.svo.h5")
    assert Grid(**{k: tuple(v) for k, v in found.pop("grid").items()}) == octree.grid
    expected = {
        "output": "bunny.svo.h5", "dim": 32, "mode": "solid", "voxels": octree.count,
        "nodes": len(octree.nodes), "bricks": len(octree.bricks), "memory_bytes": octree.nbytes,
        "bytes": os.path.getsize("bunny.svo.h5"),
        "warnings": [], "digest": octree.digest(),
    }  # fmt: skip
    assert {name: found[name] for name in expected} == expected


@pytest.mark.parametrize("mode", MODES)
def test_the_stored_plan_is_the_one_that_is_printed(mode: str, here: Path) -> None:
    text = run(f"voxelize bunny.obj --dim 64 --mode {mode} --plan").stdout
    for word in ("bricks", "work"):
        assert word in text
    plan = told(f"voxelize bunny.obj --dim 64 --mode {mode} --plan --json")
    assert plan["shape"] == [64, 64, 64]
    run(f"voxelize bunny.obj --dim 64 --mode {mode} -o a.svo.h5")
    stored = told("svo-info a.svo.h5 --json")["plan"]
    assert {name: plan[name] for name in stored} == stored


# ---- memory


def test_more_than_max_memory_is_refused_with_the_dim_that_fits(here: Path) -> None:
    for mode in MODES:
        command = f"voxelize bunny.obj --mode {mode} -o a.svo.h5 --windows never --max-memory 400K"
        message = fail(f"{command} --dim 1024")
        assert "dim 1024 would need" in message
        found = re.search(r"dim (\d+) is the largest that fits", message)
        assert found, message
        run(f"{command} --dim {found[1]}")
        assert read_svo("a.svo.h5").grid.dim == int(found[1])
        os.remove("a.svo.h5")
        fail(f"{command} --dim {round(1.1 * int(found[1]))}")
    assert "no dim fits" in fail("voxelize bunny.obj --max-memory 1K")


def test_bytes() -> None:
    for text, number in {
        "800": 800, "8k": 8 << 10, "800M": 800 << 20, "1.5GiB": 3 << 29, "8gb": 8 << 30,
        "1T": 1 << 40,
    }.items():  # fmt: skip
        assert options.BYTES.convert(text, None, None) == number


@pytest.mark.parametrize("text", ["", "M", "-1", "0.5", "nan", "inf", "1e30", "8X", "8 lots"])
def test_no_bytes(text: str) -> None:
    with pytest.raises(click.BadParameter, match="write 800M or 8G"):
        options.BYTES.convert(text, None, None)


# ---- svo-info


def test_svo_info(here: Path) -> None:
    octree = read_svo("bunny.svo.h5")
    result = run("svo-info bunny.svo.h5 --check")
    assert result.stderr == ""
    for word in (f"{octree.count:,}", "128 x 128 x 128", "solid, filled by parity", "check: ok"):
        assert word in result.stdout
    found = told("svo-info bunny.svo.h5 --json --check --digest")
    assert found["check"] == "ok"
    assert found["digest"] == octree.digest()
    assert found["file_bytes"] == os.path.getsize("bunny.svo.h5")
    assert found["voxels"] == octree.count == sum(level["voxels"] for level in found["levels"])
    assert found["volume"] == pytest.approx(octree.count * octree.grid.voxel_volume)
    assert [level["nodes"] for level in found["levels"]] == np.diff(octree.offsets).tolist()


@pytest.mark.parametrize(
    ("dataset", "place", "bits", "invariant"),
    [
        ("offsets", -1, 1, "offsets"),
        ("nodes", (3, 0), 1, "parent"),
        ("nodes", (0, 1), 8, "child"),
        ("nodes", (0, 1), 1 << 31, "both coarse-inside and refined"),
        ("bricks", 0, 1, None),
    ],
)
@pytest.mark.parametrize("flag", ["", "--check", "--digest", "--json"])
def test_altered_octree_is_refused_by_its_invariant(
    dataset, place, bits, invariant, flag, here: Path
) -> None:
    with h5py.File("bunny.svo.h5", "r+") as file:
        values = file[dataset]
        assert isinstance(values, h5py.Dataset)
        values[place] = np.bitwise_xor(values[place], bits)
    if invariant is None:  # one voxel more or less is an octree, too
        run(f"svo-info bunny.svo.h5 {flag}")
    else:
        assert invariant in fail(f"svo-info bunny.svo.h5 {flag}")


# ---- export


def test_export(here: Path) -> None:
    dense = read_svo("bunny.svo.h5").to_dense()
    for name in ("a.npy", "a.npz", "a.vti", "a.png", "z.png"):
        more = "--slice z=32" if name == "z.png" else ""
        result = run(f"export bunny.svo.h5 -o {name} {more}")
        assert re.fullmatch(
            r"voxtool: bunny.svo.h5 -> .*: \.\w+, .* cells, .*B, .* s\n", result.output
        )
    assert np.array_equal(np.load("a.npy"), dense)
    with np.load("a.npz") as arrays:
        assert np.array_equal(arrays["voxels"], np.argwhere(dense))
    assert (here / "a.vti").read_bytes().startswith(b"<?xml")
    assert (here / "a.png").read_bytes().startswith(b"\x89PNG")
    assert (here / "a.png").read_bytes() != (here / "z.png").read_bytes()
    svo = (here / "bunny.svo.h5").read_bytes()
    assert run("export - -o - --format npy", svo).stdout_bytes == (here / "a.npy").read_bytes()


def test_import(here: Path) -> None:
    """An export comes back by import with the same digest, which --json has, too."""
    told = json.loads(run("export bunny.svo.h5 -o a.npz --json").stdout)
    assert told["digest"] == run("svo-info bunny.svo.h5 --digest").stdout.strip()
    assert told["bytes"] == (here / "a.npz").stat().st_size
    back = json.loads(run("import a.npz -o b.svo.h5 --json").stdout)
    assert np.array_equal(read_svo("b.svo.h5").to_dense(), read_svo("bunny.svo.h5").to_dense())
    assert back["digest"] == run("svo-info b.svo.h5 --digest").stdout.strip()
    run("import mask.npy -o c.svo.h5 --origin 1,2,3 --spacing 0.5,0.25,1")
    assert read_svo("c.svo.h5").grid == Grid((128,) * 3, (1, 2, 3), (0.5, 0.25, 1))
    mask = (here / "mask.npy").read_bytes()
    assert run("import - --from npy -o - --format svo.xml", mask).stdout.startswith("<?xml")


def test_plan_of_an_export(here: Path) -> None:
    plan = json.loads(run("export bunny.svo.h5 -o a.npy --level 1 --plan --json").stdout)
    assert plan["shape"] == [64, 64, 64]
    assert plan["bytes"] >= 64**3 * 4
    assert not (here / "a.npy").exists()
    assert (
        "this will be refused: a.npy would take"
        in run("export bunny.svo.h5 -o a.npy --plan --max-bytes 1M").stderr
    )
    assert "1 MB allowed" in fail("export bunny.svo.h5 -o a.npy --max-bytes 1000000")


def test_voxelize_on_the_grid_of_a_file_or_of_numbers(here: Path) -> None:
    """In one step to an export, on a grid that is no cube."""
    lattice = "--origin -1.5,-0.25,-1 --shape 40,30,20 --spacing 0.0625,0.0625,0.125"
    run(f"voxelize bunny.obj {lattice} -o a.npz")
    run("voxelize bunny.obj --like a.npz -o b.svo.h5")
    octree = read_svo("b.svo.h5")
    assert octree.grid == Grid((40, 30, 20), (-1.5, -0.25, -1), (0.0625, 0.0625, 0.125))
    run("import a.npz -o c.svo.h5")
    assert octree.count
    assert np.array_equal(read_svo("c.svo.h5").to_dense(), octree.to_dense())
    run("distance bunny.obj --like a.npz -o d.npy")
    assert np.load("d.npy").shape == (40, 30, 20)


# ---- as the user runs it


def test_pipe(here: Path, shell) -> None:
    line = "voxtool voxelize bunny.obj --dim 32 -q -o - | voxtool svo-info - --json | head -1"
    done = subprocess.run(["sh", "-c", line], env=shell, cwd=here, capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"{\n", b"")


@pytest.mark.parametrize(
    "command",
    [
        "-h",
        "svo-info bunny.svo.h5 --json",
        "devices",
        "voxelize bunny.obj --dim 16 -q -o -",
        "extract bunny.svo.h5 -q -o -",
    ],
)
def test_a_reader_that_has_gone_is_a_quiet_success(command: str, here: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    words = [*MODULE, *shlex.split(command)]
    done = subprocess.run(words, env=ENVIRONMENT, cwd=here, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_exit_codes_of_processes(here: Path) -> None:
    assert process("svo-info bunny.svo.h5 --check").returncode == 0
    done = process("svo-info bunny.obj")
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (3, b"", 1)
    done = process("svo-info")
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (2, b"", 1)


@pytest.mark.parametrize("shell_name", ["bash", "zsh", "fish"])
def test_completion(shell_name: str) -> None:
    assert "_VOXTOOL_COMPLETE" in run(f"completion {shell_name}").stdout
    words = {"COMP_WORDS": "voxtool voxelize --mode sol", "COMP_CWORD": "3"}
    words["_VOXTOOL_COMPLETE"] = f"{shell_name}_complete"
    if shell_name == "fish":
        words["COMP_CWORD"] = "sol"
    done = subprocess.run(MODULE, env={**ENVIRONMENT, **words}, capture_output=True, text=True)
    assert "solid" in done.stdout


@pytest.mark.parametrize(
    ("command", "kind", "code"),
    [
        ("voxelize none.obj --json", "mesh", 3),
        ("voxelize bunny.obj --json --dimm 64", "usage", 2),
        ("nope --json", "usage", 2),
        ("svo-info none.svo.h5 --json", "file", 3),
        ("voxelize bunny.obj --json --pitch 0", "grid", 3),
        ("voxelize bunny.obj --json --device none-such", "device", 4),
        ("voxelize bunny.obj --json --dim 1024 --windows never --max-memory 100K", "memory", 4),
    ],
)
def test_errors_as_json(command: str, kind: str, code: int, here: Path) -> None:
    fail(command, code)
    assert json.loads(invoke(command).stdout)["error"]["kind"] == kind


def test_an_error_does_not_follow_the_result_on_stdout(here: Path) -> None:
    result = invoke("voxelize bunny.obj -o - --json --max-memory 1K")
    assert (result.exit_code, result.stdout) == (4, "")
    assert '"kind": "memory"' in result.stderr


def test_strict(here: Path) -> None:
    assert invoke("voxelize bunny.obj --dim 16 --strict -o a.svo.h5").exit_code == 0
    result = invoke("voxelize open.obj --dim 16 --fill parity --strict --json -o b.svo.h5")
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1].endswith("(--strict)")
    warnings = json.loads(result.stdout)["warnings"]
    assert len(warnings) == 1
    assert result.stderr.count(f"voxtool: warning: {warnings[0]}\n") == 1
    assert read_svo("b.svo.h5").count > 0


# ---- the bar


def test_the_bar_is_shown_and_erased(here: Path) -> None:
    code, out, sent = on_terminal("voxelize bunny.obj --dim 64 -o a.svo.h5", 0, here)
    assert (code, out) == (0, "")
    shown = re.findall(r"\[(#*)(\.*)\] ([a-z0-9 ]*[a-z0-9])", sent)
    assert shown
    assert len({len(done + left) for done, left, _ in shown}) == 1
    assert [stage for _, _, stage in shown][-1] == "write file"
    assert [len(done) for done, _, _ in shown] == sorted(len(done) for done, _, _ in shown)
    assert "read mesh" in sent
    message, end = screen(sent)
    assert message.startswith("voxtool: bunny.obj -> a.svo.h5")
    assert end == ""


def test_warnings_and_errors_stand_alone(here: Path) -> None:
    code, _, sent = on_terminal("voxelize open.obj --dim 16 --fill parity -o a.svo.h5", 0, here)
    assert code == 0
    warning, message, end = screen(sent)
    assert warning.startswith("voxtool: warning: ")
    assert message.startswith("voxtool: open.obj -> a.svo.h5")
    assert end == ""
    code, _, sent = on_terminal(
        "voxelize bunny.obj --dim 1024 --windows never --max-memory 400K", 0, here
    )
    assert code == 4
    assert "survey" in sent
    error, end = screen(sent)
    assert error.startswith("voxtool: error: dim 1024 would need")
    assert end == ""


def test_no_bar_for_short_work_when_quiet_or_in_the_plan(here: Path) -> None:
    _, _, sent = on_terminal("voxelize bunny.obj --dim 16 -o a.svo.h5", 3600, here)
    assert screen(sent)[0].startswith("voxtool: bunny.obj -> a.svo.h5")
    assert "[" not in sent
    assert on_terminal("voxelize bunny.obj --dim 16 -q -o a.svo.h5", 0, here)[2] == ""
    _, out, sent = on_terminal("voxelize bunny.obj --dim 16 --plan", 0, here)
    assert out.startswith("grid")
    assert screen(sent) == [""]
