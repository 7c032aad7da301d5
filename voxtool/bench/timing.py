"""How long: of work in this process, of its stages on the device, and of a whole command."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.opencl import Device


MOST_RUNS = 9
PEER_RUNS = 3
PATIENCE = 5.0  # seconds


def times(work: Callable[[], object], repeat: int) -> list[float]:
    """Seconds of each of `repeat` runs."""
    found = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return found


@dataclass(frozen=True)
class Runs:
    """How often work is timed: `repeat` times; what is short more often, up to MOST_RUNS, until it
    took `seconds` in all."""

    repeat: int
    seconds: float = 0.0

    def enough(self, found: list[float]) -> bool:
        """Whether these runs are."""
        many = len(found) >= MOST_RUNS or sum(found) >= self.seconds
        return len(found) >= self.repeat and many

    def times(self, work: Callable[[], object]) -> list[float]:
        """Seconds of each run."""
        found: list[float] = []
        while not self.enough(found):
            found += times(work, 1)
        return found

    def by_turns(
        self, one: Callable[[], float], other: Callable[[], float]
    ) -> tuple[list[float], list[float]]:
        """The seconds that two works return, by turns, so that what else the machine does meets
        both."""
        found: list[float] = []
        others: list[float] = []
        while not self.enough(found):
            found.append(one())
            others.append(other())
        return found, others


def stage_times(
    work: Callable[[], object], device: Device, repeat: int
) -> tuple[dict[str, float], float]:
    """Median seconds of each stage by the device's events, and of the whole in the same runs, after
    a warm-up."""
    runs, whole = [], []
    for _ in range(repeat + 1):
        whole += times(work, 1)
        runs.append(device.stage_times())
    stages = {name: statistics.median(run[name] for run in runs[1:]) for name in runs[0]}
    return stages, statistics.median(whole[1:])


class Peers:
    """Other tools, which may take very long: at most PEER_RUNS runs each, after the warm-up that we
    had, too; no more where they took over PATIENCE in all. One whose first run took that long has
    no other, and is not asked again.

    slow : their names.
    """

    def __init__(self, repeat: int) -> None:
        self.repeat = min(repeat, PEER_RUNS)
        self.slow: set[str] = set()

    def times(self, name: str, work: Callable[[], Any]) -> tuple[list[float], Any]:
        """Seconds of each run, and what the last one made; no runs of what was too slow."""
        if name in self.slow:
            return [], None
        made: Any = None

        def run() -> None:
            nonlocal made
            made = work()

        found = times(run, 1)
        if found[0] > PATIENCE:
            self.slow.add(name)
            return found, made
        warm, found = found[0], []
        while not found or (len(found) < self.repeat and warm + sum(found) < PATIENCE):
            found += times(run, 1)
        return found, made

    def medians(self, peers: dict[str, Callable[[], object]]) -> dict[str, float]:
        """By name, of those that are asked."""
        runs = {name: self.times(name, work)[0] for name, work in peers.items()}
        return {name: statistics.median(found) for name, found in runs.items() if found}


# A process counts the memory of the one that started it towards its own peak, so a small one
# stands between.
_LAUNCHER = """
import os, resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.call(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
seconds = time.perf_counter() - start
print(code, seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def command(*words: str) -> tuple[float, int]:
    """Seconds and peak resident bytes of `voxtool` with these words in a process of its own.

    Raises
    ------
    VoxtoolError : it fails.
    """
    launched = subprocess.run(
        [sys.executable, "-S", "-c", _LAUNCHER, sys.executable, "-m", "voxtool.cli.main", *words],
        stdout=subprocess.PIPE,
        check=True,
    )
    code, seconds, peak = launched.stdout.split()
    if int(code):
        raise VoxtoolError(f"bench: voxtool {' '.join(words)} failed with {int(code)}")
    return float(seconds), int(peak) * (1 if sys.platform == "darwin" else 1024)
