"""Points: the error of one setting beside its time. Pareto fronts, exponents, and the cheapest
setting that meets a budget are computed from points."""

from __future__ import annotations

import math
import statistics
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

from voxtool.errors import VoxtoolError, human

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Sequence

    T = TypeVar("T")
    K = TypeVar("K", bound=Hashable)

SURFACE = {
    "rms": "of the model's diagonal",
    "hausdorff": "of the model's diagonal",
    "volume": "of the model's volume",
    "area": "of the model's area",
}
CUBE = dict.fromkeys(("rms", "p99", "max"), "of the cube's side")
MEASURES = {  # of errors, by bench, and their units; the first is drawn in charts
    "voxelize": SURFACE,
    "extract": SURFACE,
    "fractions": {"rms": "of a voxel", "volume": "of the mesh's volume"},
    "attributes": {
        "wrong": "of the grid's voxels",
        "area": "of the triangles' area",
        "volume": "of the octree's volume",
    },
    "surfaces": SURFACE,
    "adf": CUBE | {f"{name} near the surface": unit for name, unit in CUBE.items()},
    "distance": CUBE,
    "pictures": {"outline": "of the pixels"},
    "tets": dict.fromkeys(("rms", "max"), "of colours from 0 to 1"),
    "view": {"unpacked": "of the values"},
    "exchange": {"returned": "of the voxels", "uncrossed": "of the links"},
    "combine": {"wrong": "of the grid's voxels"},
    "morph": {"wrong": "of the grid's voxels"},
    "scale": {"different": "of the octrees"},
    "repair": SURFACE | {"not closed": "1 unless closed and manifold"},
    "growth": {"rms": "of the cube's side"},
    "degenerate": {"rms": "of the cube's side"},
    "plans": {},
}
_UNITS = {  # of further measures, in the order of their columns
    "host": "s", "command": "s", "build": "s", "upload": "s", "ns a point": "ns",
    "samples a side": "count", "nodes": "share", "looked at": "share", "cut": "share",
    "rms in voxels": "number", "max in voxels": "number", "lipschitz": "number", "load": "share",
    "outer surface": "share", "within": "share", "within near the surface": "share",
    "bits a key": "number", "max unsigned": "number", "largest alpha": "number",
    "by the lattice": "share", "times a peer": "number", "over the file": "number",
    "triangles saved": "share", "from uniform": "number",
}  # fmt: skip
_COUNTS = ("triangles", "vertices", "voxels", "depth", "blocks", "over tolerance", "side of slots",
           "side of offsets", "w", "break-even", "other sign", "pixels compared",
           "base")  # fmt: skip
FIGURES = {**dict.fromkeys(_COUNTS, "count"), **_UNITS}  # what else is measured, and in what unit


@dataclass(frozen=True)
class Point:
    """One setting of one method on one model.

    Attributes
    ----------
    work : name of the work that is timed; the same for all points of a chart.
    method, label : name of a line of a chart, and the setting in words.
    runs : seconds of each repeat, after a warm-up.
    command : measures the point again.
    first : seconds of the first run, if later runs reuse data that it made, as frames and
        fill "auto" do.
    size, size_of : the number that the cost is drawn against, and the name of that number.
    errors, figures : numbers by the names in MEASURES and FIGURES; a break-even of None is never
        reached.
    absent : why a measure is missing, by its name.
    stages : seconds of each stage on the device, by its events.
    left_out : the parts that the plan left out, and why.
    bytes : size of the result.
    peak : bytes of resident memory of the whole command, in a process of its own.
    peer : True for another tool; its errors are by the same measure.
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
    figures: dict[str, float | None] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes: int | None = None
    peak: int | None = None
    peer: bool = False

    @property
    def seconds(self) -> float:
        return statistics.median(self.runs)

    @property
    def spread(self) -> float:
        """The slowest run minus the fastest, over the median."""
        return (max(self.runs) - min(self.runs)) / self.seconds

    @property
    def error(self) -> float | None:
        """The error that charts show, if it was measured."""
        return self.errors.get(charted(self.bench))

    @property
    def chart(self) -> tuple[str, str, str]:
        """The names that the points of one chart have in common."""
        return self.bench, self.model, self.work

    def as_dict(self) -> dict[str, Any]:
        """Return the point in JSON types."""
        times = {"median": self.seconds, "least": min(self.runs), "most": max(self.runs)}
        return {**asdict(self), "seconds": times}


@dataclass(frozen=True)
class Ablation:
    """Work with one decision of its plan forced, compared with the same work as planned.

    Attributes
    ----------
    what, why : the part that the plan left out, and its reason.
    runs, forced : seconds of each repeat as planned, and with the decision forced, in turns.
    same : True if the results are the same, bit for bit.
    saved_bytes : bytes that leaving it out saves: device memory, as the plans predict, or of a
        field.
    """

    bench: str
    model: str
    work: str
    what: str
    why: str
    runs: list[float]
    forced: list[float]
    same: bool
    saved_bytes: int = 0

    @property
    def saved(self) -> float:
        """The seconds that leaving it out saves, by medians; negative if it costs time."""
        return statistics.median(self.forced) - statistics.median(self.runs)

    @property
    def beyond_noise(self) -> bool:
        """True if the slowest run of one kind is faster than the fastest of the other."""
        return max(self.runs) < min(self.forced) or max(self.forced) < min(self.runs)

    @property
    def verdict(self) -> str:
        """The time and the bytes that were saved or lost, in words."""
        time = "0 s, within the noise"
        if self.beyond_noise:
            time = f"{duration(abs(self.saved))} {'saved' if self.saved > 0 else 'lost'}"
        size = f"{human(abs(self.saved_bytes))} {'saved' if self.saved_bytes >= 0 else 'lost'}"
        return f"{time}; {size}"

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison in JSON types."""
        return {**asdict(self), "saved": self.saved, "beyond_noise": self.beyond_noise}


def charted(bench: str) -> str:
    """Return the measure that charts show."""
    return next(iter(MEASURES[bench]))


def grouped(points: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Return the points by key, in their order."""
    found: dict[K, list[T]] = {}
    for point in points:
        found.setdefault(key(point), []).append(point)
    return found


def charts_of(points: Iterable[Point]) -> dict[tuple[str, str, str], list[Point]]:
    """Return the points of each chart, in their order."""
    return grouped(points, lambda point: point.chart)


def methods_of(points: Iterable[Point]) -> dict[str, list[Point]]:
    """Return the points of each method, in their order."""
    return grouped(points, lambda point: point.method)


def pareto(points: Iterable[Point]) -> list[Point]:
    """Return the points with an error that no other point dominates, the fastest first."""
    front: list[Point] = []
    known = [(point.seconds, point.error, point) for point in points if point.error is not None]
    for _, error, point in sorted(known, key=lambda found: found[:2]):
        if not front or error < (front[-1].error or 0):
            front.append(point)
    return front


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Return p of y ~ x**p by least squares on logarithms; None for fewer than two different x,
    or if a number is not positive."""
    if len({x for x, _ in points}) < 2 or any(v <= 0 for point in points for v in point):
        return None
    xs, ys = ([math.log(point[i]) for point in points] for i in range(2))
    return statistics.linear_regression(xs, ys).slope


def cost_lines(points: Sequence[Point]) -> dict[str, list[tuple[float, float]]]:
    """Return size and seconds of the points of each method that has several sizes."""
    lines = {
        method: sorted((p.size, p.seconds) for p in found if p.size)
        for method, found in methods_of(points).items()
    }
    return {method: line for method, line in lines.items() if len({x for x, _ in line}) > 1}


def exponents(points: Sequence[Point]) -> dict[str, tuple[float, float, float]]:
    """Return, for each method, p of seconds ~ size**p and the least and largest size of the fit."""
    return {
        method: (p, line[0][0], line[-1][0])
        for method, line in cost_lines(points).items()
        if (p := exponent(line)) is not None
    }


# --- what to choose ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Budget:
    """The limits of a setting: seconds, an error by some measure, or both."""

    time: float | None = None
    error: float | None = None
    measure: str | None = None  # the charted one by default

    def met(self, point: Point) -> bool:
        """Return True if a point keeps both limits."""
        error = point.errors.get(self.measure or charted(point.bench))
        return (self.time is None or point.seconds <= self.time) and (
            self.error is None or (error is not None and error <= self.error)
        )

    def choose(self, points: Iterable[Point]) -> Point | None:
        """Return the cheapest point that meets the error; the most accurate, if only time is
        limited."""
        met = [point for point in points if self.met(point)]
        if self.error is not None:
            return min(met, key=lambda point: point.seconds, default=None)
        known = [(point.error, point.seconds, point) for point in met if point.error is not None]
        return min(known, key=lambda found: found[:2])[2] if known else None

    def check(self, benches: Iterable[str]) -> None:
        """Raise VoxtoolError if one of the benches does not have the measure."""
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
    """Return the title of each chart in which an error was measured, and the point to choose in it,
    or None if no point meets the budget."""
    return [
        (title(chart), budget.choose(found))
        for chart, found in charts_of(points).items()
        if any(point.errors for point in found)
    ]


def verdicts(points: Sequence[Point]) -> list[str]:
    """Return advice on one chart, in words: the cheapest point for each power of ten of the error,
    the most accurate point, and the methods that are never on the Pareto front."""
    front = pareto(points)
    if not front:
        return []
    said = []
    measure = charted(front[0].bench)
    unit = f"{measure} {MEASURES[front[0].bench][measure]}"
    logs = [math.log10(point.error) for point in front if point.error] or [0]
    powers = range(math.ceil(max(logs)), math.floor(min(logs)) - 1, -1)
    chosen = [(power, Budget(error=10.0**power).choose(points)) for power in powers]
    for (power, point), (_, after) in pairwise([*chosen, (0, None)]):
        if point is not None and point is not after:
            said.append(
                f"error up to 1e{power}: {named(point)}, {duration(point.seconds)} "
                f"(error {point.error:.2g})"
            )
    best = front[-1]
    said.append(
        f"most accurate: {named(best)}, {duration(best.seconds)} (error {best.error:.2g}, {unit})"
    )
    on_front = {point.method for point in front}
    known = dict.fromkeys(point.method for point in points if point.error is not None)
    if beaten := [method for method in known if method not in on_front]:
        said.append(f"never the fastest for its error: {'; '.join(beaten)}")
    return said


def costs(points: Sequence[Point]) -> list[str]:
    """Return the growth of the time of each method of one chart with the size, in words."""
    size_of = next((point.size_of for point in points if point.size), "")
    return [
        f"time of {method} ~ {size_of}^{p:.2f}, from {low:,g} to {high:,g} {size_of}"
        for method, (p, low, high) in exponents(points).items()
    ]


# --- words ---------------------------------------------------------------------------------------


def title(chart: tuple[str, str, str]) -> str:
    """Return the title of a chart: "voxelize, bunny.obj: mesh to solid voxels"."""
    bench, model, work = chart
    return f"{bench}, {model}: {work}"


def named(point: Point) -> str:
    """Return method and label: "solid, parity, dim 64"."""
    return f"{point.method}, {point.label}" if point.label else point.method


def duration(seconds: float) -> str:
    """Return a time as text: "12.3 ms"."""
    if seconds >= 1:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} µs"
