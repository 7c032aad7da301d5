"""Peak memory of whole commands on large octrees."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from helpers_cli import ENVIRONMENT, MODULE, run

pytestmark = pytest.mark.soak
LIMIT = 2 << 30


def peak_of(words: str) -> int:
    """Run a command; return the most bytes that it had."""
    child = subprocess.Popen([*MODULE, *words.split()], env=ENVIRONMENT)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0
    return 1024 * usage.ru_maxrss


def test_an_octree_of_2048_is_closed_within_2_gb(models: Path, tmp_path: Path) -> None:
    octree = tmp_path / "large.svo.h5"
    run(f"voxelize {models}/bunny.obj --dim 2048 -o {octree}")
    for words in ("--close 8", "--open 40", "--keep largest"):
        peak = peak_of(f"morph {octree} {words} -q -o {tmp_path}/out.svo.h5")
        assert peak < LIMIT
