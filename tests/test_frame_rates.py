"""The parts of `python -m tests.frame_rates` that need no browser."""

from __future__ import annotations

import subprocess
import sys

from tests.frame_rates import processor_seconds

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
    before = processor_seconds()
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", start], **pipes) as child:
        assert child.stdin
        assert child.stdout
        child.stdout.readline()
        spent = processor_seconds() - before
        child.stdin.close()
    assert SPENT - 0.02 <= spent < 5 * SPENT + 2
