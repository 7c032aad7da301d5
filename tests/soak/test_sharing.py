"""Pairs of processes on one output, and kills of processes and of their helpers, of every command
that writes."""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from helpers.cli import ENVIRONMENT, run
from helpers.writers import WINDOWED, WRITERS, Outputs, check_kill, check_pair

pytestmark = pytest.mark.soak


@pytest.fixture(scope="module")
def outputs(models: Path, tmp_path_factory: pytest.TempPathFactory) -> Outputs:
    run(f"voxelize {models}/bunny.obj --dim 400 -q -o {models}/big.svo.h5")
    run(f"voxelize {models}/open.obj --like {models}/big.svo.h5 -q -o {models}/other.svo.h5")
    return Outputs(models, tmp_path_factory.mktemp("outputs"))


def test_two_runs_on_one_output(rounds, outputs: Outputs, tmp_path: Path) -> None:
    """Half of them in windows, where what waits could be mixed."""
    codes: Counter[int] = Counter()
    for rng in rounds:
        writer = rng.choice(rng.choice([WINDOWED, WRITERS]))
        codes.update(check_pair(writer, rng, outputs, tmp_path))
    print(f"soak: exit codes of pairs: {dict(codes)}")


def test_killed_commands_leave_nothing_half(rounds, outputs: Outputs, tmp_path: Path) -> None:
    codes: Counter[int] = Counter()
    for rng in rounds:
        codes.update(check_kill(rng.choice(WRITERS), rng, outputs, tmp_path))
    print(f"soak: exit codes of kills: {dict(codes)}")


# Makes windows that all say a number, and a file of them; no device is needed.
STORED = """
import sys, time
import numpy as np
from voxtool.errors import FileError
from voxtool.files.storage.atomic import atomic_path
from voxtool.files.octrees.windows import Window, Windows
from voxtool.svo.octree.layout import BRICK
target, number, resume, keep = sys.argv[1], int(sys.argv[2]), *map(bool, sys.argv[3:])
states, bricks = np.full(99, number, np.uint8), np.full(99, number, BRICK)
try:
    with Windows(target, {"n": number}, resume=resume, keep=keep) as store:
        for x in range(24):
            if (x, 0, 0, 8) not in store:
                store.put((x, 0, 0, 8), Window([states], bricks, 1))
                time.sleep(0.004)
        with atomic_path(target) as path, open(path, "wb") as file:
            for x in range(24):
                for part in (*store.get((x, 0, 0, 8))[0], *store.take((x, 0, 0, 8))):
                    file.write(part.tobytes())
except FileError as error:
    sys.exit(f"refused: {error}")
"""


REFUSED = re.compile(r"^refused: (another run .*is making|.*is of another mesh).*\n$")


def test_stores_of_several_processes(rounds, tmp_path: Path) -> None:
    """Three at once, which are stopped and killed."""
    codes: Counter[str] = Counter()
    target = tmp_path / "o"
    for rng in rounds:
        target.unlink(missing_ok=True)
        children = []
        for number in rng.choice([(1, 2, 1), (1, 1, 1), (1, 2, 3)]):
            more = [rng.choice(["", "1"]) for _ in range(2)]
            words = [sys.executable, "-c", STORED, target, str(number), *more]
            child = subprocess.Popen(words, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
            children.append((child, number))
            time.sleep(rng.uniform(0, 0.8))
            disturb(child, rng)
        good = set()
        for child, number in children:
            child.send_signal(signal.SIGCONT)
            _, said = child.communicate(timeout=120)
            assert child.returncode <= 0 or REFUSED.search(said), said
            codes["refused" if child.returncode > 0 else str(child.returncode)] += 1
            good |= {number} if child.returncode == 0 else set()
        if target.exists():
            content = target.read_bytes()
            assert content in [one * 24 for one in map(window, {number for _, number in children})]
        else:
            assert not good
    print(f"soak: ends of stores: {dict(codes)}")


def window(number: int) -> bytes:
    """Return what a process writes of a window."""
    return bytes([number]) * 99 + number.to_bytes(8, "little") * 99


def disturb(child: subprocess.Popen[str], rng: random.Random) -> None:
    """Stop or kill a process, or leave it alone."""
    number = rng.choice([0, signal.SIGSTOP, signal.SIGKILL])
    if number and child.poll() is None:
        child.send_signal(number)
