"""The parts of `python -m tests.frame_rates`: processor time, and fetches of texels."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import written

import voxtool
from tests.frame_rates import fetches, processor_seconds

SPENT = 0.2  # seconds
WORK = f"""
import subprocess, sys, time
while time.process_time() < {SPENT}:
    pass
print(flush=True)
input()
"""


def test_processor_time_is_that_of_all_processes_below() -> None:
    below = [sys.executable, "-c", WORK]
    start = f"import subprocess; subprocess.run({below!r})"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", start], **pipes) as child:
        assert child.stdin
        assert child.stdout
        child.stdout.readline()
        spent = processor_seconds(child.pid)
        child.stdin.close()
    assert SPENT - 0.02 <= spent < SPENT + 2


@pytest.mark.slow
def test_fetches_are_counted(browser, tmp_path: Path) -> None:
    """A ray beside the grid reads nothing. One that meets a cell reads where it begins, a table, a
    block or none, for the normal 4 x 4 rows in two blocks each, and where these eight are."""
    found = fetches(browser, written(voxtool.Octree.from_dense(np.ones((8, 8, 8))), tmp_path), 24)
    assert found[0, 0] == 0
    assert 2 + 32 <= found[12, 12] <= 3 + 32 + 8
