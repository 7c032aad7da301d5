"""Charts of points by matplotlib (the extra `pictures`): SVG in the colours of the page around it,
and PNG on white."""

from __future__ import annotations

import io
import math
import re
import statistics
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.points import (
    MEASURES,
    charted,
    cost_lines,
    duration,
    exponents,
    methods_of,
    pareto,
    title,
)
from voxtool.errors import FileError, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.points import Ablation, Point

COLOURS = ("#2f7ed8", "#e07b00", "#1a9e77", "#c2417c", "#7a6ad8", "#a07a1f", "#d0453e", "#1597a8",
           "#6b8e23", "#8a5a44", "#5f7f95", "#b05fd0")  # fmt: skip
MARKERS = "osD^vPXp"
WIDTH, PLOT = 7.2, 3.7  # inches: of a chart, and the height of what is within its axes
LEFT, RIGHT, TOP, BOTTOM = 0.95, 0.25, 0.45, 0.55  # around that
LEGEND = 0.19  # of a line of the legend
LETTER, KEY = 0.07, 6  # the width of a letter there, and letters that what is before a name takes
DPI = 144  # of PNG
NEAR = (80, 20)  # pixels, across and up, within which two labels of points would overlap
BAR = 0.42  # inches, of the height of a chart of bars, for each


@dataclass(frozen=True)
class Theme:
    """Colours of what is written, of lines that guide the eye, and of the ground."""

    ink: str
    grid: str
    ground: str


PAPER = Theme("#1d2530", "#d5dae0", "#ffffff")
# of no chart, so that they can be replaced by what CSS says
PAGE = Theme("#010203", "#040506", "#070809")
CSS = {PAGE.ink: "currentColor", PAGE.grid: "var(--grid)", PAGE.ground: "var(--card)"}


def check_matplotlib() -> None:
    """Raise FileError if matplotlib is missing."""
    try:
        import matplotlib as _  # noqa: F401
    except ImportError:
        raise FileError("charts need matplotlib: pip install 'voxtool[pictures]'") from None


@dataclass(frozen=True)
class Chart:
    """A chart: its name, for a file, and its two forms."""

    name: str
    svg: str
    png: bytes


def charts(points: Sequence[Point], name: str) -> list[Chart]:
    """The drawings of the points of one chart: error against time, cost against size, and stages;
    without those for which nothing was measured."""
    drawings = {
        "error": (draw_error, any(point.error is not None for point in points)),
        "cost": (draw_cost, bool(cost_lines(points))),
        "stages": (draw_stages, bool(_bars(points))),
    }
    return [
        _chart(draw, points, f"{name}-{kind}") for kind, (draw, drawn) in drawings.items() if drawn
    ]


def ablation_charts(ablations: Sequence[Ablation]) -> list[Chart]:
    """The time that plans saved by what they left out, a chart for each bench and model."""
    found: dict[tuple[str, str], list[Ablation]] = {}
    for ablation in ablations:
        found.setdefault((ablation.bench, ablation.model), []).append(ablation)
    return [
        _chart(draw_ablations, some, slug(f"{bench}-{model}-saved"))
        for (bench, model), some in found.items()
    ]


def slug(text: str) -> str:
    """A file name of a title: voxelize-bunny-obj-mesh-to-voxels."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-")[:100]


def _chart(draw: Any, points: Sequence[Any], name: str) -> Chart:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    forms: list[bytes] = []
    for theme, form in ((PAGE, "svg"), (PAPER, "png")):
        style: dict[Any, Any] = {
            **matplotlib.rcParamsDefault,  # whatever the user prefers
            "svg.fonttype": "none", "svg.hashsalt": name, "font.size": 9, "text.color": theme.ink,
            "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
            "axes.edgecolor": theme.grid, "axes.labelcolor": theme.ink, "xtick.color": theme.ink,
            "ytick.color": theme.ink, "axes.facecolor": theme.ground, "grid.color": theme.grid,
            "figure.facecolor": theme.ground, "savefig.facecolor": theme.ground,
            "axes.spines.top": False, "axes.spines.right": False, "grid.linewidth": 0.6,
            "legend.frameon": False, "legend.fontsize": 8, "axes.titlesize": 11,
            "axes.titlelocation": "left", "axes.titlepad": 12, "axes.axisbelow": True,
        }  # fmt: skip
        with matplotlib.rc_context(style), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph")  # names may be in any script
            figure = Figure(figsize=(WIDTH, PLOT), dpi=DPI)
            FigureCanvasAgg(figure)
            draw(figure, points, theme)
            file = io.BytesIO()
            metadata = {"Software": None} if form == "png" else {"Date": None}
            figure.savefig(file, format=form, metadata=metadata)
        forms.append(file.getvalue())
    return Chart(name, inline(forms[0].decode()), forms[1])


def inline(svg: str) -> str:
    """An SVG file as an element of a page: without its head, and in the page's colours."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    for colour, name in CSS.items():
        svg = svg.replace(colour, name)
    return svg


# --- error against time --------------------------------------------------------------------------


def draw_error(figure: Any, points: Sequence[Point], theme: Theme) -> None:
    """Error against time, one line a method, the Pareto front marked."""
    plot = figure.add_subplot()
    plot.set_xscale("log")
    plot.set_yscale("log")
    plot.grid(True, which="major")
    errors = [point.error for point in points if point.error is not None and point.error > 0]
    floor = min(errors, default=1e-6) / 4  # where errors of 0 are drawn
    front = pareto(points)
    where = [(point.seconds, point.error or floor) for point in front]
    steps = [x for pair in zip(where, [*where[1:], where[-1]], strict=True)
             for x in (pair[0], (pair[1][0], pair[0][1]))]  # fmt: skip
    plot.plot(*zip(*steps, strict=True), color=theme.ink, alpha=0.16, linewidth=7, zorder=1,
              solid_capstyle="round", label="Pareto front")  # fmt: skip
    for number, (method, found) in enumerate(methods_of(points).items()):
        colour = COLOURS[number % len(COLOURS)]
        marker = MARKERS[number % len(MARKERS)]
        known = sorted((p for p in found if p.error is not None), key=lambda p: p.seconds)
        style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 6,
                                 "linewidth": 1.5, "label": plain(method)}  # fmt: skip
        if found[0].peer:
            style |= {"linestyle": (0, (4, 2)), "linewidth": 1.1}
        if not known:
            plot.axvline(found[0].seconds, color=colour, linestyle=":", linewidth=1.5,
                         label=plain(f"{method} (no error is measured)"))  # fmt: skip
            continue
        plot.plot(
            [p.seconds for p in known], [p.error or floor for p in known], zorder=3,
            markerfacecolor=theme.ground, markeredgewidth=1.4, **style,
        )  # fmt: skip
        best = [p for p in known if p in front]
        plot.plot(
            [p.seconds for p in best], [p.error or floor for p in best], linestyle="none",
            marker=marker, markersize=8, color=colour, zorder=4,
        )  # fmt: skip
    plot.margins(0.12, 0.12)
    last = np.full(2, -math.inf)
    for p in front:
        place = plot.transData.transform((p.seconds, p.error or floor))
        if (np.abs(place - last) > NEAR).any():  # or their words would overlap
            several = sum(q.method == p.method and q.error is not None for q in points) > 1
            text = plain(p.label if several else p.method) + ("" if p.error else " (0)")
            plot.annotate(text, (p.seconds, p.error or floor), (6, 6), fontsize=7,
                          textcoords="offset points", color=theme.ink, zorder=5)  # fmt: skip
            last = place
    point = points[0]
    measure = charted(point.bench)
    plot.set_xlabel("seconds")
    plot.set_ylabel(plain(f"{measure} error, {MEASURES[point.bench][measure]}"))
    plot.set_title(plain(f"{title(point.chart)}: error against time"))
    _lay_out(figure, plot)


# --- cost against size ---------------------------------------------------------------------------


def draw_cost(figure: Any, points: Sequence[Point], theme: Theme) -> None:
    """Seconds against size, with the exponents that fit."""
    plot = figure.add_subplot()
    plot.set_xscale("log")
    plot.set_yscale("log")
    plot.grid(True, which="major")
    fitted = exponents(points)
    methods = list(methods_of(points))
    for method, line in cost_lines(points).items():
        number = methods.index(method)
        p, low, high = fitted[method]
        plot.plot(
            *zip(*line, strict=True), marker=MARKERS[number % len(MARKERS)], markersize=6,
            color=COLOURS[number % len(COLOURS)], markerfacecolor=theme.ground, linewidth=1.5,
            label=plain(f"{method}: size^{p:.2f}, {low:g} to {high:g}"),
        )  # fmt: skip
    point = next(p for p in points if p.size)
    sizes = sorted({p.size for p in points if p.size})
    if len(sizes) <= 8:
        apart = [b for a, b in pairwise([0, *sizes]) if b > 1.5 * a]
        plot.set_xticks(apart, [f"{size:,g}" for size in apart])
        plot.set_xticks([], minor=True)
    plot.margins(0.08, 0.12)
    plot.set_xlabel(point.size_of)
    plot.set_ylabel("seconds")
    plot.set_title(plain(f"{title(point.chart)}: cost against size"))
    _lay_out(figure, plot)


# --- stages --------------------------------------------------------------------------------------


def _bars(points: Sequence[Point]) -> list[Point]:
    """The slowest point of each method whose stages are known."""
    known = methods_of(point for point in points if point.stages)
    return [max(found, key=lambda p: p.seconds) for found in known.values()]


def draw_stages(figure: Any, points: Sequence[Point], theme: Theme) -> None:
    """A bar of the stages on the device for the slowest setting of each method."""
    bars = _bars(points)
    plot = figure.add_subplot()
    plot.grid(True, axis="x")
    stages = list(dict.fromkeys(stage for point in bars for stage in point.stages))
    rows, left = range(len(bars)), [0.0] * len(bars)
    for number, stage in enumerate(stages):
        width = [1e3 * point.stages.get(stage, 0.0) for point in bars]
        plot.barh(rows, width, left=left, color=COLOURS[number % len(COLOURS)], height=0.62,
                  edgecolor=theme.ground, linewidth=0.8, label=plain(stage))  # fmt: skip
        left = [a + b for a, b in zip(left, width, strict=True)]
    for row, (end, point) in enumerate(zip(left, bars, strict=True)):
        plot.annotate(f" {duration(point.seconds)} in total", (end, row), va="center", fontsize=7)
    names = [f"{plain(p.method)}\n{plain(p.label)}" for p in bars]
    plot.set_yticks(rows, names)
    plot.invert_yaxis()
    plot.set_xlim(0, 1.22 * max(max(left), 1e-6))
    plot.set_xlabel("ms on the device")
    plot.set_title(plain(f"{title(points[0].chart)}: stages"))
    _lay_out(figure, plot, names)


# --- what was left out ---------------------------------------------------------------------------


def draw_ablations(figure: Any, ablations: Sequence[Ablation], theme: Theme) -> None:
    """The time with a decision forced over the time as planned: a bar for each, from 1, and the
    range of the repeats."""
    plot = figure.add_subplot()
    plot.grid(True, axis="x")
    ratios = []
    for row, one in enumerate(ablations):
        planned = statistics.median(one.runs)
        least, middle, most = (f(one.forced) / planned for f in (min, statistics.median, max))
        ratios += [least, most]
        kind = "within the noise"
        if one.beyond_noise:
            kind = "saved by leaving it out" if one.saved > 0 else "lost by leaving it out"
        number = {"saved by leaving it out": 0, "lost by leaving it out": 1}.get(kind)
        plot.barh(row, middle - 1, left=1, height=0.62, label=kind,
                  color=theme.grid if number is None else COLOURS[number])  # fmt: skip
        plot.plot((least, most), (row, row), color=theme.ink, linewidth=1)
    plot.axvline(1, color=theme.ink, linewidth=1)
    names = [f"{plain(s.what)}\n{plain(s.work)}" for s in ablations]
    plot.set_yticks(range(len(ablations)), names, fontsize=7)
    plot.invert_yaxis()
    plot.set_xlim(min(0.9, *ratios), max(1.1, *ratios))
    plot.set_xlabel("time with it forced over time as planned; lines: all repeats")
    plot.set_title(plain(f"{ablations[0].bench}, {ablations[0].model}: what was left out"))
    _lay_out(figure, plot, names)


# --- words ---------------------------------------------------------------------------------------


def plain(text: str) -> str:
    """A text that matplotlib takes as it is."""
    return printable(text).replace("$", r"\$")


def _lay_out(figure: Any, plot: Any, bars: Sequence[str] = ()) -> None:
    """Place the axes, with room for what bars are called, and the legend below them."""
    lines = [line for name in bars for line in name.split("\n")]
    left = max(LEFT, LETTER * (max(map(len, lines), default=0) + 3))
    height = BAR * (len(bars) + 0.4) if bars else PLOT
    handles, labels = plot.get_legend_handles_labels()
    keys = dict(zip(labels, handles, strict=True))  # each label once
    longest = LETTER * (KEY + max(map(len, keys)))
    columns = max(1, min(3, int(WIDTH / longest)))
    legend = LEGEND * -(-len(keys) // columns) + 0.1
    whole = TOP + height + BOTTOM + legend
    figure.set_size_inches(WIDTH, whole)
    plot.set_position(
        (left / WIDTH, (BOTTOM + legend) / whole, 1 - (left + RIGHT) / WIDTH, height / whole)
    )
    figure.legend(
        list(keys.values()), list(keys), loc="lower center", ncols=columns, handlelength=2.4
    )
