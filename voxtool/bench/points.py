"""What a benchmark measured, point by point: an error beside every time, and what follows from
them: Pareto fronts, exponents, and the cheapest setting that meets a demand."""

from __future__ import annotations

import math
import statistics
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

SURFACE = {
    "rms": "of the model's diagonal",
    "hausdorff": "of the model's diagonal",
    "volume": "of the model's volume",
    "area": "of the model's area",
}
FIELD = dict.fromkeys(("rms", "p99", "max"), "sides of the cube")
MEASURES = {  # of errors, by bench, and their units; the first is drawn in charts
    "voxelize": SURFACE,
    "extract": SURFACE,
    "adf": FIELD | {f"{name} near the surface": unit for name, unit in FIELD.items()},
    "tets": dict.fromkeys(("rms", "max"), "of colours from 0 to 1"),
}


@dataclass(frozen=True)
class Point:
    """One setting of one method on one model.

    work : what is timed, which is the same for all points of a chart; method : a line of a chart;
    label : the setting in words; setting : all of it.
    size, size_of : a number that the cost goes with, and what it counts; None where there is none.
    runs : seconds of each repeat, after a warm-up; first : of the first one, where later ones have
    what it made, as frames do.
    errors : by name, as MEASURES; absent : why a measure is not among them.
    stages : seconds on the device, by its events; left_out : what the plan left out, and why.
    bytes : of the result; peak : of resident memory, of the whole command in its own process.
    command : measures it again. peer : another tool; its errors are by the same measure.
    """

    bench: str
    model: str
    work: str
    method: str
    label: str
    setting: dict[str, Any]
    runs: list[float]
    command: str
    first: float | None = None
    size: float | None = None
    size_of: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes: int | None = None
    peak: int | None = None
    peer: bool = False

    @property
    def seconds(self) -> float:
        return statistics.median(self.runs)

    @property
    def error(self) -> float | None:
        """The error that charts show, if it was measured."""
        return self.errors.get(charted(self.bench))

    @property
    def chart(self) -> tuple[str, str, str]:
        """Points of one chart have this in common."""
        return self.bench, self.model, self.work

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """By this points of two reports are the same."""
        return *self.chart, self.method, self.label

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
        times = {"median": self.seconds, "least": min(self.runs), "most": max(self.runs)}
        return {**asdict(self), "seconds": times}


@dataclass(frozen=True)
class Saving:
    """What leaving something out saved: the same work with it, and without.

    runs, forced : seconds of each repeat as planned, and with it forced in, by turns.
    same : whether the results were the same, bit for bit.
    """

    bench: str
    model: str
    work: str
    what: str
    why: str
    runs: list[float]
    forced: list[float]
    same: bool

    @property
    def saved(self) -> float:
        """Seconds, of medians; below 0 if it takes longer without."""
        return statistics.median(self.forced) - statistics.median(self.runs)

    @property
    def beyond_noise(self) -> bool:
        """Whether the slowest of one kind is faster than the fastest of the other."""
        return max(self.runs) < min(self.forced) or max(self.forced) < min(self.runs)

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
        return {**asdict(self), "saved": self.saved, "beyond_noise": self.beyond_noise}


def charted(bench: str) -> str:
    """The measure that charts show."""
    return next(iter(MEASURES[bench]))


def charts_of(points: Iterable[Point]) -> dict[tuple[str, str, str], list[Point]]:
    """The points of each chart, in their order."""
    found: dict[tuple[str, str, str], list[Point]] = {}
    for point in points:
        found.setdefault(point.chart, []).append(point)
    return found


def methods_of(points: Iterable[Point]) -> dict[str, list[Point]]:
    """The points of each method, in their order."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(point.method, []).append(point)
    return found


def pareto(points: Iterable[Point]) -> list[Point]:
    """The points that no other one beats: as fast or faster and as exact or more exact, and one of
    both truly. The fastest first; points without an error are not among them."""
    front: list[Point] = []
    known = [(point.seconds, point.error, point) for point in points if point.error is not None]
    least = math.inf
    for _, error, point in sorted(known, key=lambda found: found[:2]):
        if error < least:
            front.append(point)
            least = error
    return front


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """p of y ~ x**p by least squares on logarithms; None for less than two different x, or where a
    number is not positive."""
    if len({x for x, _ in points}) < 2 or any(v <= 0 for point in points for v in point):
        return None
    xs, ys = ([math.log(point[i]) for point in points] for i in range(2))
    x, y = statistics.mean(xs), statistics.mean(ys)
    return sum((a - x) * (b - y) for a, b in zip(xs, ys, strict=True)) / sum(
        (a - x) ** 2 for a in xs
    )


# --- what to choose ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Budget:
    """What a setting must keep: seconds, an error by some measure, or both."""

    time: float | None = None
    error: float | None = None
    measure: str | None = None  # the charted one by default

    def met(self, point: Point) -> bool:
        error = point.errors.get(self.measure or charted(point.bench))
        return (self.time is None or point.seconds <= self.time) and (
            self.error is None or (error is not None and error <= self.error)
        )

    def choose(self, points: Iterable[Point]) -> Point | None:
        """The cheapest of those that meet it; the most accurate, if only time is asked for."""
        met = [point for point in points if self.met(point)]
        if self.error is not None:
            return min(met, key=lambda point: point.seconds, default=None)
        known = [(point.error, point.seconds, point) for point in met if point.error is not None]
        return min(known, key=lambda found: found[:2])[2] if known else None

    def check(self, benches: Iterable[str]) -> None:
        """Refuse a measure that one of the benches does not have; raises VoxtoolError."""
        for bench in benches:
            if self.measure is not None and self.measure not in MEASURES[bench]:
                raise VoxtoolError(
                    f"{bench} has no error {self.measure!r}: choose {', '.join(MEASURES[bench])}"
                )

    def __str__(self) -> str:
        words = []
        if self.error is not None:
            words.append(f"{self.measure or 'error'} up to {self.error:g}")
        if self.time is not None:
            words.append(f"time up to {duration(self.time)}")
        return ", ".join(words)


def answers(points: Iterable[Point], budget: Budget) -> list[tuple[str, Point | None]]:
    """What each chart has to say to a budget: its title, and the point to choose, if any is."""
    return [(title(chart), budget.choose(found)) for chart, found in charts_of(points).items()]


def verdicts(points: Sequence[Point]) -> list[str]:
    """Of one chart: the cheapest point for each power of ten of the error, what is always beaten,
    and what errors come to. In words."""
    front = pareto(points)
    if not front:
        return []
    said = []
    unit = f"{charted(front[0].bench)} {MEASURES[front[0].bench][charted(front[0].bench)]}"
    positive = [point.error for point in front if point.error]
    powers = range(
        math.ceil(math.log10(max(positive, default=1))),
        math.floor(math.log10(min(positive, default=1))) - 1,
        -1,
    )
    chosen = [(power, Budget(error=10.0**power).choose(points)) for power in powers]
    for (power, point), (_, after) in pairwise([*chosen, (0, None)]):
        if point is not None and point is not after:
            said.append(
                f"error up to 1e{power}: {named(point)}, {duration(point.seconds)} "
                f"(its error is {point.error:.2g})"
            )
    best = front[-1]
    said.append(
        f"most accurate: {named(best)}, {best.error:.2g} ({unit}) in {duration(best.seconds)}"
    )
    on_front = {point.method for point in front}
    beaten = [method for method in methods_of(points) if method not in on_front]
    known = {point.method for point in points if point.error is not None}
    if always := [method for method in beaten if method in known]:
        said.append(f"never the fastest for its error: {'; '.join(always)}")
    return said


# --- words ---------------------------------------------------------------------------------------


def title(chart: tuple[str, str, str]) -> str:
    bench, model, work = chart
    return f"{bench}, {model}: {work}"


def named(point: Point) -> str:
    return f"{point.method}, {point.label}" if point.label else point.method


def duration(seconds: float) -> str:
    """12.3 ms."""
    if seconds >= 1:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} µs"
