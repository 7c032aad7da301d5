"""Time of work in this process, of its stages on the device, and of a whole command."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.bench.request import Request
    from voxtool.opencl import Device


MOST_RUNS = 9
PEER_RUNS = 3
PATIENCE = 5.0  # seconds of a peer


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
    """How often work is timed: `repeat` times; short work more often, up to MOST_RUNS, until it
    took `seconds` in total."""

    repeat: int
    seconds: float = 0.0

    def enough(self, found: list[float]) -> bool:
        """Whether these runs are enough."""
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
        """The seconds that two works return, in turns, so that other load of the machine slows
        both."""
        found: list[float] = []
        others: list[float] = []
        while not self.enough(found):
            found.append(one())
            others.append(other())
        return found, others


@dataclass(frozen=True)
class Bench:
    """A request and the devices that it is measured on.

    Attributes
    ----------
    request : what is measured.
    timed, profiled : the same device twice, without and with events.
    tools : the functions of voxtool.bench.peers.
    """

    request: Request
    timed: Device
    profiled: Device
    tools: Any = field(default_factory=partial(import_module, "voxtool.bench.peers"))

    def measured(self, work: Callable[[Device], object]) -> dict[str, Any]:
        """The runs, the stages and the figure "host" of a Point, for work that takes a device.

        "host" is what Python adds to the stages, in the runs that give them.
        """
        work(self.timed)  # kernels are compiled
        stages, whole = self.stages(work)
        return {
            "runs": self.request.runs.times(partial(work, self.timed)),
            "stages": stages,
            "figures": {"host": whole - sum(stages.values())},
        }

    def stages(self, work: Callable[[Device], object]) -> tuple[dict[str, float], float]:
        """Median seconds of each stage on the device, and of the whole in the same runs, after a
        warm-up."""
        runs, whole = [], []
        for _ in range(self.request.repeat + 1):
            self.profiled.stage_times()
            whole += times(partial(work, self.profiled), 1)
            runs.append(self.profiled.stage_times())
        names = runs[-1]
        stages = {name: statistics.median(run.get(name, 0.0) for run in runs[1:]) for name in names}
        return stages, statistics.median(whole[1:])


class Peers:
    """Timing of other tools, which may take very long.

    Each has at most PEER_RUNS runs after a warm-up, and no further run once they took `patience`
    seconds in total. A tool whose first run takes longer is run once, and skipped afterwards.

    Attributes
    ----------
    slow : names of the tools that are skipped.
    """

    def __init__(self, repeat: int, patience: float = PATIENCE) -> None:
        self.repeat, self.patience = min(repeat, PEER_RUNS), patience
        self.slow: set[str] = set()

    def times(self, name: str, work: Callable[[], Any]) -> tuple[list[float], Any]:
        """Seconds of each run, and the last result; no runs if the tool is skipped."""
        if name in self.slow:
            return [], None
        made: Any = None

        def run() -> None:
            nonlocal made
            made = work()

        found = times(run, 1)
        if found[0] > self.patience:
            self.slow.add(name)
            return found, made
        warm, found = found[0], []
        while not found or (len(found) < self.repeat and warm + sum(found) < self.patience):
            found += times(run, 1)
        return found, made


# The peak memory of a process includes that of the process that started it: a small one stands
# between.
_LAUNCHER = """
import os, resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.call(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
seconds = time.perf_counter() - start
print(code, seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def command(*words: str) -> tuple[float, int]:
    """Seconds and peak resident bytes of `voxtool` with these words, in its own process.

    Raises
    ------
    VoxtoolError : the command fails.
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
