"""Many meshes in one call: outputs, the manifest, what is up to date, workers that die."""

from __future__ import annotations

import json
import os
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.cli import ENVIRONMENT, MODULE, fail, invoke, run, told

from voxtool.claims import machine
from voxtool.errors import FileError
from voxtool.files import read_svo
from voxtool.files.meshes.mesh import load_mesh
from voxtool.files.storage.manifest import Manifest
from voxtool.grid import Grid
from voxtool.svo.voxelization.voxelize import voxelize

# Kills the process that opens crash.obj.
CRASH = """
import os, signal, sys
def hook(event, arguments):
    if event == "open" and str(arguments[0]).endswith("crash.obj"):
        os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
"""


@pytest.fixture
def balls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The current folder has three balls, in two folders."""
    monkeypatch.chdir(tmp_path)
    names = ["a/one.obj", "a/two.obj", "b/three.obj"]
    for n, name in enumerate(names):
        Path(name).parent.mkdir(exist_ok=True)
        trimesh.creation.icosphere(subdivisions=1, radius=1 + n).export(name)
    return names


def lines(folder: str = "out", name: str = "manifest.jsonl") -> list[dict]:
    return [json.loads(line) for line in Path(folder, name).read_text().splitlines()]


def test_each_mesh_becomes_what_it_becomes_alone(balls) -> None:
    Path("b/bad.obj").write_text("v 0 0 0\n")
    result = invoke(f"voxelize {balls[0]} b/bad.obj {balls[2]} -o out --dim 20")
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == (
        "voxtool: error: 1 of 3 meshes failed: see out/manifest.jsonl"
    )
    one, bad, three = lines()
    for line, name in ((one, balls[0]), (three, balls[2])):
        mesh = load_mesh(name)
        alone = voxelize(mesh, Grid.fit(mesh, 20))
        assert line["mesh"] == name
        assert line["digest"] == alone.digest() == read_svo(line["output"]).digest()
        assert line["options"]["dim"] == 20
        assert line["size"] == os.path.getsize(line["output"])
    assert bad["error"]["kind"] == "mesh"
    assert bad["error"]["exit_code"] == 3
    assert not Path(bad["output"]).exists()


def test_what_is_up_to_date_is_left(balls) -> None:
    command = f"voxelize {' '.join(balls)} -o out --dim 16 --json"

    def counts(command: str) -> tuple[int, int]:
        found = told(command)
        return found["made"], found["up_to_date"]

    assert counts(command) == (3, 0)
    assert counts(command) == (0, 3)
    assert counts(f"{command} -q --workers 2") == (0, 3)  # how it is done is no matter
    assert counts(command.replace("16", "17")) == (3, 0)
    assert counts(command.replace("16", "17")) == (0, 3)
    os.utime(balls[1])
    Path("out/one.svo.h5").write_bytes(b"")
    Path("out/three.svo.h5").unlink()
    assert counts(command.replace("16", "17")) == (3, 0)
    assert [line["mesh"] for line in lines()] == balls


def test_shards_are_all_meshes_and_each_once(balls) -> None:
    for part in (1, 2):
        run(f"voxelize {' '.join(balls)} -o out --dim 8 --shard {part}/2")
    parts = [[x["mesh"] for x in lines(name=f"manifest.{part}-of-2.jsonl")] for part in (1, 2)]
    assert parts == [balls[::2], balls[1::2]]
    whole = told(f"voxelize {' '.join(balls)} -o out --dim 8 --json")
    assert (whole["made"], whole["up_to_date"]) == (0, 3)
    assert told(f"voxelize {balls[0]} -o out --dim 8 --json --shard 2/2")["made"] == 0
    for wrong in ("0/2", "3/2", "half", "1/0"):
        assert "is no shard" in fail(f"voxelize {balls[0]} --shard {wrong}", 2)


def test_names_that_meet(balls) -> None:
    for folder in "ab":
        trimesh.creation.box().export(f"{folder}/model.off")
    both = "a/model.off b/model.off"
    message = fail(f"voxelize {both} -o out", 2)
    assert "would both become out/model.svo.h5: rename one, or give --keep-folders" in message
    run(f"adf-build {both} -o out --keep-folders --max-level 2 --format adf.h5")
    assert Path("out/a/model.adf.h5").is_file()
    assert Path("out/b/model.adf.h5").is_file()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("voxelize - M -o out", "stdin is one mesh"),
        ("voxelize M -o -", "no place on stdout"),
        ("voxelize M -o out --gap 3", "--gap goes with"),
        ("distance M", "many meshes go with a grid"),
        ("diagnose M --obj loops.obj", "--obj is of one mesh"),
    ],
)
def test_refusals(command: str, message: str, balls) -> None:
    assert message in fail(command.replace("M", " ".join(balls)), 2)


def test_a_device_that_is_not_there_leaves_nothing(balls) -> None:
    message = fail(f"voxelize {' '.join(balls)} -o out --device nonsense", 4)
    assert "no OpenCL device matches 'nonsense'" in message
    assert not Path("out").exists()
    run(f"voxelize {balls[0]} -o out/ --dim 8")
    fail(f"voxelize {balls[0]} {balls[1]} -o out --dim 9 --device nonsense", 4)
    assert [line["mesh"] for line in lines()] == [balls[0]]


def test_a_folder_that_is_a_file(balls) -> None:
    Path("out").write_text("")
    assert "it is a file, not a folder" in fail(f"voxelize {' '.join(balls)} -o out")


def test_other_commands(balls) -> None:
    meshes = " ".join(balls)
    run(f"distance {meshes} -o out --dim 8 --float32")
    assert np.load("out/two.sdf.npy").shape == (8, 8, 8)
    run(f"repair {balls[0]} {balls[1]} -o out/ --dim 16 --format ply")
    run(f"hollow {balls[0]} -o hollowed/ --wall 0.4 --dim 16")
    assert Path("out/one.repaired.ply").is_file()
    assert Path("hollowed/one.hollow.obj").is_file()
    texts = run(f"diagnose {meshes} --dim 8").stdout
    boxes = [texts.index(f"{size} x {size}") for size in (2, 4, 6)]  # in the order of the meshes
    assert boxes == sorted(boxes)
    reports: Any = told(f"diagnose {meshes} --dim 8 --json")
    assert [report["mesh"] for report in reports] == balls
    assert all(report["report"]["diagnosis"]["closed"] for report in reports)


def test_plans_write_nothing(balls) -> None:
    text = run(f"voxelize {' '.join(balls)} -o out --dim 16 --plan").stdout
    assert [line.split(" -> ")[0] for line in text.splitlines()] == balls
    plans: Any = told(f"voxelize {' '.join(balls)} -o out --dim 16 --plan --json")
    assert plans[1]["plan"]["stages"]
    assert plans[1]["cost"]["device"] > 0
    assert not Path("out").exists()


def test_a_crash_costs_one_mesh(balls) -> None:
    Path("sitecustomize.py").write_text(CRASH)
    Path("crash.obj").write_text("v 0 0 0\n")
    folders = os.pathsep.join([os.getcwd(), ENVIRONMENT["PYTHONPATH"]])
    words = [*MODULE, "voxelize", balls[0], "crash.obj", *balls[1:], "-o", "out", "--dim", "8"]
    done = subprocess.run(
        words, env={**ENVIRONMENT, "PYTHONPATH": folders}, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "1 of 4 meshes failed" in done.stderr
    found = {line["mesh"]: line.get("error", {}).get("kind") for line in lines()}
    assert found == {balls[0]: None, "crash.obj": "crash", balls[1]: None, balls[2]: None}
    assert "crash.obj: its process ended with signal SIGKILL" in done.stderr


def test_a_manifest_that_was_cut_off(tmp_path: Path) -> None:
    with Manifest(str(tmp_path), None) as manifest:
        manifest.add({"output": "one", "n": 1})
        manifest.add({"output": "two", "n": 2})
    path = tmp_path / "manifest.jsonl"
    path.write_text(path.read_text()[:-6])  # killed in the middle of a line
    with Manifest(str(tmp_path), None) as again:
        assert again.line_of("one") == {"output": "one", "n": 1}
        assert again.line_of("two") == {}
        again.add({"output": "two", "n": 3})
        again.add({"output": "two", "n": 4})
        again.finish(["two", "one"])
    assert os.listdir(tmp_path) == ["manifest.jsonl"]
    assert [json.loads(line)["n"] for line in path.read_text().splitlines()] == [4, 1]


@pytest.mark.parametrize(
    ("one", "other", "refused"),
    [
        (None, None, True),
        ((1, 2), (1, 2), True),
        ((1, 2), (2, 2), False),
        (None, (2, 2), True),
        ((1, 2), None, True),
        ((1, 2), (1, 3), True),
    ],
)
def test_a_folder_has_one_run_for_each_mesh(one, other, refused: bool, tmp_path: Path) -> None:
    with Manifest(str(tmp_path), one) as manifest:
        manifest.add({"output": "one"})
        if refused:
            with pytest.raises(FileError, match=r"another run .* wait until it ends"):
                Manifest(str(tmp_path), other)
        else:
            Manifest(str(tmp_path), other).discard()
        assert manifest.line_of("one") == {"output": "one"}
    assert os.listdir(tmp_path) == [manifest.path.name]
    with Manifest(str(tmp_path), other):
        assert len(os.listdir(tmp_path)) == 2


# ---- one tar


def members(path: str) -> dict[str, bytes]:
    with tarfile.open(path) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}


def test_a_tar_has_each_output_and_its_line(balls) -> None:
    command = f"distance {' '.join(balls)} --dim 8 --normalize unit --keep-folders --float32"
    run(f"{command} -o folder")
    made = told(f"{command} -o all.tar --json")
    assert (made["output"], made["manifest"], made["made"]) == ("all.tar", None, 3)
    found = members("all.tar")
    assert list(found) == [
        f"{name.removesuffix('.obj')}.{ending}" for name in balls for ending in ("sdf.npy", "json")
    ]
    for name in balls:
        stem = name.removesuffix(".obj")
        assert found[f"{stem}.sdf.npy"] == Path("folder", f"{stem}.sdf.npy").read_bytes()
        line = json.loads(found[f"{stem}.json"])
        assert (line["mesh"], len(line["transform"])) == (name, 4)
    assert sorted(os.listdir()) == ["a", "all.tar", "b", "folder"]
    whole = Path("all.tar").read_bytes()
    assert told(f"{command} -o all.tar --json")["up_to_date"] == 3
    later = os.stat("all.tar").st_mtime_ns + 10**9
    os.utime(balls[0], ns=(later, later))
    assert told(f"{command} -o all.tar --json")["made"] == 3
    assert Path("all.tar").read_bytes() == whole
    Path("all.tar").write_bytes(b"not a tar")
    assert "all.tar: is no tar of samples" in fail(f"{command} -o all.tar", 3)


def test_a_tar_without_the_meshes_that_failed(balls) -> None:
    Path("b/bad.obj").write_text("v 0 0 0\n")
    command = f"voxelize {balls[0]} b/bad.obj --dim 8 --format npy -o some.tar"
    result = invoke(command)
    assert result.exit_code == 1
    assert "1 of 2 meshes failed: see some.tar.parts/manifest.jsonl" in result.stderr
    assert list(members("some.tar")) == ["one.npy", "one.json"]
    Path("b/bad.obj").write_bytes(Path("b/three.obj").read_bytes())
    again = told(f"{command} --json")
    assert (again["made"], again["up_to_date"]) == (1, 1)
    assert list(members("some.tar")) == ["one.npy", "one.json", "bad.npy", "bad.json"]
    assert not Path("some.tar.parts").exists()


def test_a_tar_that_a_killed_run_had_packed(balls) -> None:
    """The outputs are removed, and what was begun for them."""
    command = f"voxelize {' '.join(balls)} --dim 8"
    run(f"{command} -o some.tar")
    run(f"{command} -o some.tar.parts/")
    begun = [f".one.svo.h5.{machine()}-{process}-0.tmp" for process in (os.getpid(), 1)]
    for name in begun:
        Path("some.tar.parts", name).touch()
    assert told(f"{command} -o some.tar --json")["up_to_date"] == 3
    assert not Path("some.tar.parts").exists()
    run(f"{command} -o some.tar.parts/")
    Path("some.tar").unlink()
    for name in begun:
        Path("some.tar.parts", name).touch()
    assert told(f"{command} -o some.tar --json")["up_to_date"] == 3
    assert Path("some.tar").exists()
    assert not Path("some.tar.parts").exists()


def test_what_a_killed_run_left_is_removed(balls) -> None:
    """Beside outputs that are up to date, too, and beside the manifest."""
    command = f"voxelize {' '.join(balls)} --dim 8 -o out/"
    run(command)
    with subprocess.Popen(["true"]) as dead:
        pass
    for name in ("manifest.jsonl", "one.svo.h5", "other.png"):
        Path("out", f".{name}.{machine()}-{dead.pid}-0.tmp").touch()
    alive = Path("out", f".two.svo.h5.{machine()}-{os.getpid()}-0.tmp")
    alive.touch()
    assert told(f"{command} --json")["up_to_date"] == 3
    assert [path.name for path in Path("out").glob(".*")] == [alive.name]


def test_webdataset_reads_a_tar(balls) -> None:
    import webdataset

    run(f"distance {' '.join(balls)} --dim 8 --float32 -o all.tar")
    read = list(webdataset.WebDataset("all.tar", shardshuffle=False).decode())
    assert [sample["__key__"] for sample in read] == ["one", "two", "three"]
    for sample, name in zip(read, balls, strict=True):
        run(f"distance {name} --dim 8 --float32 -o alone.npy")
        np.testing.assert_array_equal(sample["sdf.npy"], np.load("alone.npy"))
        assert sample["json"]["mesh"] == name


def test_a_tar_for_each_shard(balls) -> None:
    for part in (1, 2):
        run(f"voxelize {' '.join(balls)} -o some.tar --dim 8 --shard {part}/2")
    assert list(members("some.1-of-2.tar"))[::2] == ["one.svo.h5", "three.svo.h5"]
    assert list(members("some.2-of-2.tar"))[::2] == ["two.svo.h5"]


@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        ("--format ome.zarr", 2, "a tar holds files, and ome.zarr is a folder"),
        ("b/t.wo.obj b/t_wo.obj", 2, "would have several samples t_wo: rename a mesh"),
        ("-o none/x.tar", 3, "there is no folder"),
    ],
)
def test_refused_tars(more: str, code: int, message: str, balls) -> None:
    for name in ("b/t.wo.obj", "b/t_wo.obj"):
        Path(name).write_bytes(Path(balls[0]).read_bytes())
    assert message in fail(f"voxelize {balls[0]} -o x.tar --dim 8 {more}", code)
    assert not list(Path().glob("x.tar*"))


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("repair bunny.obj --dim 16 --workers 2", "one.stl"),
        ("repair bunny.obj --dim 16 --dask local", "one.stl"),
        ("distance bunny.obj --dim 16 --workers 2", "one.npy"),
        ("voxelize bunny.obj --dim 16 --workers 2", "one.svo.h5"),
    ],
)
def test_one_mesh_is_the_file_that_is_named(command: str, output: str, here: Path) -> None:
    before = set(os.listdir())
    run(f"{command} -o {output} -q")
    assert set(os.listdir()) - before == {output}
    assert Path(output).is_file()


def test_one_mesh_in_a_folder(here: Path) -> None:
    run("voxelize bunny.obj --dim 16 --workers 1 -o folder -q")  # which names no format
    assert set(os.listdir("folder")) == {"bunny.svo.h5", "manifest.jsonl"}
