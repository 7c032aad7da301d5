"""Peak memory of whole commands on large octrees."""

from __future__ import annotations

import filecmp
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import ENVIRONMENT, run

pytestmark = pytest.mark.soak
LIMIT = 2 << 30


MOST = """
import atexit, re, sys
from voxtool.__main__ import main

def tell():
    with open("/proc/self/status") as status:
        print(re.search(r"VmHWM:\\s+(\\d+) kB", status.read())[1], file=sys.stderr)

atexit.register(tell)
sys.argv[0] = "voxtool"
main()
"""


def peak_of(words: str) -> int:
    """Run a command; return the most bytes that it had. The system's own count of a process (wait4)
    begins with what the process had that started it."""
    found = subprocess.run(
        [sys.executable, "-c", MOST, *words.split()],
        env=ENVIRONMENT,
        capture_output=True,
        check=True,
        text=True,
    )
    return 1024 * int(found.stderr.split()[-1])


def test_an_octree_of_2048_is_closed_within_2_gb(models: Path, tmp_path: Path) -> None:
    octree = tmp_path / "large.svo.h5"
    run(f"voxelize {models}/bunny.obj --dim 2048 -o {octree}")
    for words in ("--close 8", "--open 40", "--keep largest"):
        peak = peak_of(f"morph {octree} {words} -q -o {tmp_path}/out.svo.h5")
        assert peak < LIMIT


def test_combining_takes_less_memory_in_windows(models: Path, tmp_path: Path) -> None:
    solid, surface = tmp_path / "solid.svo.h5", tmp_path / "surface.svo.h5"
    for mode, octree in (("solid", solid), ("surface26", surface)):
        run(f"voxelize {models}/bunny.obj --dim 4096 --mode {mode} -o {octree}")
    words = f"combine {solid} {surface} --op difference -q"
    part = peak_of(f"{words} --max-memory 150M -o {tmp_path}/part.svo.h5")
    whole = peak_of(f"{words} -o {tmp_path}/whole.svo.h5")
    assert part < whole / 2
    assert filecmp.cmp(tmp_path / "part.svo.h5", tmp_path / "whole.svo.h5", shallow=False)


SAMPLES = """
import atexit, sys, threading
from pathlib import Path
from voxtool.__main__ import main

def held(process):
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0
    return int(status.partition("VmRSS:")[2].split()[0]) if "VmRSS:" in status else 0

def sample():
    while not ended.wait(0.25):
        tasks = Path("/proc/self/task").glob("*/children")
        workers = [held(child) for task in tasks for child in task.read_text().split()]
        samples.append((held("self"), sum(workers)))

samples, ended = [], threading.Event()
threading.Thread(target=sample, daemon=True).start()
atexit.register(lambda: print(*(f"{a},{b}" for a, b in samples), file=sys.stderr))
sys.argv[0] = "voxtool"
main()
"""


def test_many_meshes_take_the_memory_of_few(models: Path, tmp_path: Path) -> None:
    """The command keeps a line of the manifest for each mesh, about 1 kB, and its worker nothing.
    What is held is sampled four times a second. Allocators take some MB at once, now and then, so
    the growth is the median of the growth between samples, for all meshes together."""
    meshes = [tmp_path / f"{number}.obj" for number in range(2000)]
    for mesh in meshes:
        mesh.symlink_to(models / "open.obj")
    words = ["voxelize", *map(str, meshes), "--dim", "8", "-q", "-o", str(tmp_path / "out")]
    found = subprocess.run(
        [sys.executable, "-c", SAMPLES, *words],
        env=ENVIRONMENT, capture_output=True, check=True, text=True,
    )  # fmt: skip
    assert len((tmp_path / "out" / "manifest.jsonl").read_text().splitlines()) == len(meshes)
    samples = 1024 * np.array([pair.split(",") for pair in found.stderr.split()], np.int64)
    samples = samples[samples[:, 1] > 0][8:]  # the command and its worker have begun
    assert len(samples) > 40
    chunks = samples[: len(samples) // 20 * 20].reshape(20, -1, 2).mean(axis=1)
    grown = 20 * np.median(np.diff(chunks, axis=0), axis=0)
    assert (grown < 4_000_000).all(), f"{grown} bytes more, of the command and its worker"
