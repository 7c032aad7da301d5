"""The long tests: random meshes, mutated files, killed writers, many calls, all models.

`make soak SECONDS=600 SEED=7` gives each test its share of the time. The seed is printed, so that a
failure can be repeated.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import MODELS, SOAKED, opened, usable_devices
from fuzz.driver import Session
from helpers import meshes, oracles
from helpers.cli import ENVIRONMENT, MODULE
from helpers.parts import check_scene, random_scene

import voxtool

pytestmark = pytest.mark.soak
SHAPE = (24, 20, 22)


def test_random_meshes_agree_with_oracles_on_every_driver(rounds) -> None:
    """Every mode, voxel by voxel."""
    devices = [opened(index) for index, _ in usable_devices()]
    grid = voxtool.Grid(SHAPE, (0, 0, 0), (1, 1, 1))
    for rng in rounds:
        generator = np.random.default_rng(rng.randrange(1 << 32))
        vertices, faces = meshes.random_triangles(generator, rng.randint(1, 8), SHAPE, margin=6)
        vertices = np.asarray(vertices, float) / rng.choice([1, 2, 256])
        mesh = voxtool.mesh_from_arrays(vertices, faces)
        triangles = meshes.fixed(mesh.vertices)[mesh.faces]
        for mode in ("surface26", "surface6", "solid"):
            expected = getattr(oracles, mode)(triangles, SHAPE)
            for device in devices:
                octree = voxtool.voxelize(mesh, grid, mode, fill="parity", device=device)
                octree.validate()
                assert {tuple(v) for v in octree.occupied().tolist()} == expected


@pytest.mark.parametrize("kind", ["files", "lies"])
def test_damaged_and_lying_files_are_used_or_refused_in_one_line(
    kind: str, request: pytest.FixtureRequest, seed: int, tmp_path: Path
) -> None:
    """The fuzzer makes and judges them, on the driver that the seed chooses."""
    drivers = usable_devices()
    session = Session(tmp_path, seed, str(drivers[seed % len(drivers)][0]), effort=0)
    seconds = max(request.config.getoption("soak") / SOAKED / 2, 1)
    print(f"soak: {request.node.name}: {session.run(kind, 0, seconds):,} rounds")
    assert not [found.finding for found in session.found.values()]


def test_killed_writers_leave_a_whole_file_or_none(rounds, models: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.svo.h5"
    drivers = [name for _, name in usable_devices()]
    for rng in rounds:
        before = target.read_bytes() if target.exists() else None
        words = [*MODULE, *f"voxelize {models}/bunny.obj --dim 256 -q -o {target}".split()]
        environment = {**ENVIRONMENT, "VOXTOOL_DEVICE": rng.choice(drivers)}
        child = subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.1, 1.0))
        number = rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
        child.send_signal(number)
        child.wait()
        if target.exists() and target.read_bytes() != before:
            voxtool.read_svo(target).validate()
        elif before is not None:
            assert target.read_bytes() == before
        time.sleep(0.1 if number == signal.SIGKILL else 0)  # for the second process
        assert {path.name for path in tmp_path.iterdir()} <= {target.name}, signal.Signals(number)


def test_killed_windows_go_on_to_the_same_octree(rounds, models: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.svo.h5"
    mesh = voxtool.load_mesh(models / "bunny.obj")
    digests = {
        options: voxtool.voxelize(mesh, voxtool.Grid.fit(mesh, 1000), fill=fill).digest()
        for options, fill in {
            "--max-memory 1M": "auto",
            "--max-memory 3M --dag": "auto",
            "--max-memory 12M --fill flood": "flood",
        }.items()
    }
    for rng in rounds:
        options = rng.choice(list(digests))
        whole = digests[options]
        command = f"voxelize {models}/bunny.obj --dim 1000 -q -o {target} --resume {options}"
        target.unlink(missing_ok=True)
        for _ in range(rng.randint(1, 4)):
            child = subprocess.Popen([*MODULE, *command.split()], env=ENVIRONMENT)
            time.sleep(rng.uniform(0.5, 2.5))
            child.kill()
            child.wait()
            assert not target.exists() or voxtool.read_svo(target).digest() == whole
        done = subprocess.run([*MODULE, *command.split()], env=ENVIRONMENT, check=False)
        assert done.returncode == 0
        assert voxtool.read_svo(target).digest() == whole
        assert {path.name for path in tmp_path.iterdir()} == {target.name}


def test_killed_batches_go_on_to_the_same_octrees(rounds, models: Path, tmp_path: Path) -> None:
    """The command or one of its workers is killed: each output is whole or missing, and the same
    command, given again, makes what is missing."""
    meshes, out = [tmp_path / f"{number}.obj" for number in range(24)], tmp_path / "out"
    for mesh in meshes:
        mesh.symlink_to(models / "bunny.obj")
    whole = voxtool.voxelize(models / "bunny.obj", dim=200).digest()
    words = ["voxelize", *map(str, meshes), "--dim", "200", "--workers", "2", "-q", "-o", str(out)]
    for rng in rounds:
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(rng.randint(1, 4)):
            child = subprocess.Popen([*MODULE, *words], env=ENVIRONMENT)
            time.sleep(rng.uniform(0.2, 1.5))
            workers = children_of(child.pid)
            os.kill(rng.choice([child.pid, *workers]), signal.SIGKILL)
            child.wait()
            for octree in out.glob("*.svo.h5"):
                assert voxtool.read_svo(octree).digest() == whole
        done = subprocess.run([*MODULE, *words], env=ENVIRONMENT, check=False)
        assert done.returncode == 0
        names = {f"{mesh.stem}.svo.h5" for mesh in meshes}
        assert {path.name for path in out.iterdir()} == {*names, "manifest.jsonl"}
        lines = list(map(json.loads, (out / "manifest.jsonl").read_text().splitlines()))
        assert {line["output"] for line in lines} == {str(out / name) for name in names}
        assert all(line.get("digest") == whole for line in lines)


def children_of(process: int) -> list[int]:
    """Return the processes that a process has started and that run a worker."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if parent == process and b"--as-worker" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


def test_many_calls_keep_their_memory(rounds, models: Path) -> None:
    mesh = voxtool.load_mesh(models / "bunny.obj")
    field = voxtool.read_adf(models / "bunny.adf.h5")
    resident: list[int] = []
    for number, rng in enumerate(rounds):
        octree = voxtool.voxelize(mesh, voxtool.Grid.fit(mesh, rng.choice([32, 64])))
        voxtool.extract(octree)
        voxtool.query_adf(field, np.random.default_rng(number).uniform(-1, 2, (100, 3)))
        resident.append(_resident())
    warm = len(resident) // 4
    if len(resident) > 100:
        assert max(resident[-warm:]) < 1.2 * max(resident[warm : 2 * warm]) + (32 << 20)


def _resident() -> int:
    """Bytes of memory that this process has."""
    words = Path("/proc/self/statm").read_text().split() if sys.platform == "linux" else ["0", "0"]
    return int(words[1]) * 4096


def test_models_have_one_digest_on_every_driver(rounds) -> None:
    names = sorted(path.name for path in MODELS.glob("*.obj"))
    if not names:
        pytest.skip("the folder of real models is absent")
    devices = [opened(index) for index, _ in usable_devices()]
    for rng in rounds:
        mesh = voxtool.load_mesh(MODELS / rng.choice(names))
        grid = voxtool.Grid.fit(mesh, rng.randint(8, 400))
        mode = rng.choice(["surface26", "surface6", "solid"])
        fill = rng.choice(["parity", "nonzero", "winding", "flood"])
        found = {
            voxtool.voxelize(mesh, grid, mode, fill=fill, device=device).digest()
            for device in devices
        }
        assert len(found) == 1, (mesh.name, grid.dim, mode, fill)


def test_random_scenes_of_parts_are_their_union(rounds) -> None:
    device = opened(usable_devices()[0][0])
    for count, rng in enumerate(rounds):
        seed = rng.getrandbits(40)
        scene = random_scene(np.random.default_rng(seed))
        check_scene(scene, seed, device, field=count % 50 == 0)
