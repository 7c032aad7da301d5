"""Peak memory of whole commands on large octrees."""

from __future__ import annotations

import filecmp
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_cli import ENVIRONMENT, run

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


PEAKS = """
import atexit, resource, sys
from voxtool.__main__ import main

def tell():
    kinds = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    print(*(resource.getrusage(kind).ru_maxrss for kind in kinds), file=sys.stderr)

atexit.register(tell)
sys.argv[0] = "voxtool"
main()
"""


def test_many_meshes_take_the_memory_of_few(models: Path, tmp_path: Path) -> None:
    """The command keeps a line of the manifest for each mesh, about 1 kB, and its worker nothing:
    with 10,000 meshes they take 10 MB more than with one. Peaks of equal runs differ by 3 MB, so
    what is kept must show in each of three attempts."""
    meshes = [tmp_path / f"{number}.obj" for number in range(2000)]
    for mesh in meshes:
        mesh.symlink_to(models / "open.obj")

    def peaks(count: int, folder: Path) -> np.ndarray:
        """Return the peak memory of the command and of its worker with `count` meshes, (2,) int64
        bytes."""
        words = ["voxelize", *map(str, meshes[:count]), "--dim", "8", "-q", "-o", str(folder)]
        found = subprocess.run(
            [sys.executable, "-c", PEAKS, *words],
            env=ENVIRONMENT,
            capture_output=True,
            check=True,
            text=True,
        )
        assert len((folder / "manifest.jsonl").read_text().splitlines()) == count
        return 1024 * np.array(found.stderr.split()[-2:], np.int64)

    grown = []
    for attempt in range(3):
        few, all_ = (peaks(count, tmp_path / f"out{attempt}-{count}") for count in (200, 2000))
        grown.append(all_ - few)
        if (np.min(grown, axis=0) < 4_000_000).all():
            return
    raise AssertionError(f"{grown} bytes more, of the command and its worker")
