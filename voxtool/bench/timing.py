"""Time of work in this process, of its stages on the device, and of a whole command."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from voxtool.bench.points import Point
from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from voxtool.bench.request import Request
    from voxtool.opencl import Device

T = TypeVar("T")
MOST_RUNS = 9
WHOLE = ""  # beside stages: the whole run
PEER_RUNS = 3
PATIENCE = 5.0  # seconds of a peer
LONG = 5.0  # seconds of work whose stages are timed without a warm-up: compiling hardly shows


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds of a run, and its result."""
    start = time.perf_counter()
    made = work()
    return time.perf_counter() - start, made


def times(work: Callable[[], object], repeat: int) -> list[float]:
    """Return the seconds of each of `repeat` runs."""
    return [timed(work)[0] for _ in range(repeat)]


def spread(seconds: Sequence[float]) -> float:
    """Return the slowest run minus the fastest, over the median."""
    return (max(seconds) - min(seconds)) / statistics.median(seconds)


def by_turns(request: Request, *works: Callable[[], object]) -> list[list[float]]:
    """Return the seconds of each run of each work, in turns, so that other load slows all of them.

    Each has `request.repeat` runs; short work has more, up to MOST_RUNS, until the first work took
    `request.seconds` in total.
    """
    found: list[list[float]] = [[] for _ in works]
    first = found[0]
    while len(first) < request.repeat or (len(first) < MOST_RUNS and sum(first) < request.seconds):
        for seconds, work in zip(found, works, strict=True):
            seconds += times(work, 1)
    return found


@dataclass(frozen=True)
class Bench:
    """The settings to measure, the devices to measure on, and the current bench and model.

    Attributes
    ----------
    timed, profiled : the same device twice, without and with events.
    name, model : the bench, and the path of its model.
    tools : the functions of voxtool.bench.peers.
    """

    request: Request
    timed: Device
    profiled: Device
    name: str = ""
    model: str = ""
    tools: Any = field(default_factory=partial(import_module, "voxtool.bench.peers"))

    @property
    def names(self) -> tuple[str, str]:
        """The names of bench and model: the first fields of every Point and Ablation."""
        return self.name, Path(self.model).name

    def point(
        self,
        work: str,
        method: str,
        label: str = "",
        *,
        run: Callable[[Device], object] | None = None,
        asked: dict[str, Any] | None = None,
        setting: dict[str, Any] | None = None,
        figures: Mapping[str, float | None] | None = None,
        places: int | None = None,
        **fields: Any,
    ) -> Point:
        """Return a point of this bench and model.

        Parameters
        ----------
        run : work that is timed here; without it `runs` is among `fields`.
        asked : the fields of the request that measure the point again.
        setting : the setting beside these.
        places : number of points in space that the work handles, for the figure "ns a point".
        fields : the other fields of the Point.
        """
        again, found = asked or {}, dict(figures or {})
        if run:
            measured = self.measured(run)
            found |= measured.pop("figures")
            fields |= measured
        if places:
            found["ns a point"] = 1e9 * statistics.median(fields["runs"]) / places
        return Point(
            *self.names, work, method, label, setting={**again, **(setting or {})},
            command=self.request.command(self.name, self.model, **again), figures=found, **fields,
        )  # fmt: skip

    def measured(self, work: Callable[[Device], object]) -> dict[str, Any]:
        """Return the runs, the stages and the figure "host" of a Point, for work that takes a
        device.

        The stages are medians; "host" is the time that Python adds to them in the same runs.
        """
        first, _ = timed(partial(work, self.timed))  # compile the kernels
        ((stages, host),) = self.profile(partial(work, self.profiled), warm_up=first < LONG)
        runs = by_turns(self.request, partial(work, self.timed))[0]
        return {"runs": runs, "stages": stages, "figures": {"host": host}}

    def profile(
        self, *works: Callable[[], object], warm_up: bool = True
    ) -> list[tuple[dict[str, float], float]]:
        """Return the seconds of the stages of each work on the profiled device, and those that
        Python adds; medians of runs in turns, after one that does not count if `warm_up`."""
        found = []
        for runs in self.stage_runs(*works, warm_up=warm_up):
            stages = {
                name: statistics.median(run.get(name, 0.0) for run in runs)
                for name in runs[-1]
                if name != WHOLE
            }
            whole = statistics.median(run[WHOLE] for run in runs)
            found.append((stages, whole - sum(stages.values())))
        return found

    def stage_runs(
        self, *works: Callable[[], object], warm_up: bool = True
    ) -> list[list[dict[str, float]]]:
        """Return the seconds of the stages of each run of each work, and of the whole run as WHOLE;
        as of profile."""
        found: list[list[dict[str, float]]] = [[] for _ in works]
        for _ in range(self.request.repeat + warm_up):
            for work, runs in zip(works, found, strict=True):
                self.profiled.stage_times()
                seconds = times(work, 1)[0]
                runs.append({**self.profiled.stage_times(), WHOLE: seconds})
        return [runs[warm_up:] for runs in found]


class Peers:
    """Timing of other tools, which may take very long.

    A tool has at most PEER_RUNS runs after a warm-up, and no further run once they took `patience`
    seconds in total. A tool whose first run takes longer is run once, and skipped afterwards.
    """

    def __init__(self, repeat: int, patience: float = PATIENCE) -> None:
        self.repeat, self.patience = min(repeat, PEER_RUNS), patience
        self.slow: set[str] = set()  # names of the tools that are skipped

    def times(self, name: str, work: Callable[[], Any]) -> tuple[list[float], Any]:
        """Return the seconds of each run, and the last result; no runs if the tool is skipped."""
        if name in self.slow:
            return [], None
        warm, made = timed(work)
        if warm > self.patience:
            self.slow.add(name)
            return [warm], made
        found: list[float] = []
        while not found or (len(found) < self.repeat and warm + sum(found) < self.patience):
            seconds, made = timed(work)
            found.append(seconds)
        return found, made


# The peak memory of a process includes that of its parent, so a small one starts the command.
_LAUNCHER = """
import os, resource, subprocess, sys, time
start = time.perf_counter()
code = subprocess.call(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
seconds = time.perf_counter() - start
print(code, seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def command(*words: str, output: str, device: Device) -> tuple[float, int]:
    """Return the seconds and peak resident bytes of `voxtool` with these words, in its own process.

    Parameters
    ----------
    output : name of the file that the command writes, and that is removed.

    Raises
    ------
    VoxtoolError : the command fails.
    """
    import tempfile  # slow to import, and the help of bench imports this module

    with tempfile.TemporaryDirectory(prefix="voxtool-bench-") as folder:
        target = Path(folder, output)
        more = ("-q", "--device", str(device.info.index), "-o", str(target))
        program = (sys.executable, "-m", "voxtool", *words, *more)
        launched = subprocess.run(
            [sys.executable, "-S", "-c", _LAUNCHER, *program], stdout=subprocess.PIPE, check=True
        )
        written = target.exists()
    code, seconds, peak = launched.stdout.split()
    if int(code) or not written:
        raise VoxtoolError(f"bench: voxtool {' '.join(words)} failed with {int(code)}")
    return float(seconds), int(peak) * (1 if sys.platform == "darwin" else 1024)
