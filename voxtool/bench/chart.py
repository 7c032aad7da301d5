"""Charts of points by matplotlib (the extra `pictures`): SVG in the colours of the page around it,
and PNG on white."""

from __future__ import annotations

import io
import math
import re
import statistics
import warnings
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.points import (
    MEASURES,
    charted,
    cost_lines,
    duration,
    exponents,
    grouped,
    methods_of,
    pareto,
    title,
)
from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from voxtool.bench.points import Ablation, Point

    Lines = Mapping[str, Sequence[tuple[float, float, float]]]  # by name: number, ms, spread

COLOURS = ("#2f7ed8", "#e07b00", "#1a9e77", "#c2417c", "#7a6ad8", "#a07a1f", "#d0453e", "#1597a8",
           "#6b8e23", "#8a5a44", "#5f7f95", "#b05fd0")  # fmt: skip
MARKERS = "osD^vPXp"
WIDTH, HEIGHT = 7.2, 4.5  # inches, of a chart without its legend
BAR, REST = 0.42, 1.2  # inches, of the height of a chart of bars: each bar, and the rest
LINE, ROW = 110, 0.2  # letters in a row of the legend, and inches of its height
DPI = 144  # of PNG
NEAR = (80, 20)  # pixels, across and up, within which two labels of points would overlap


# Colours of letters, grid lines and background. Nothing else in a chart has these colours, so that
# those of the page can replace them.
INK, GRID, GROUND = "#1d2530", "#d5dae0", "#ffffff"
CSS = {INK: "currentColor", GRID: "var(--grid)", GROUND: "var(--card)"}


@dataclass(frozen=True)
class Chart:
    """A chart: the name of its file, and its two forms."""

    name: str
    svg: str
    png: bytes


def charts(points: Sequence[Point], name: str) -> list[Chart]:
    """Return the drawings of the points of one chart: error against time, cost against size, and
    stages; each if it was measured."""
    drawings = {
        "error": (draw_error, any(point.error is not None for point in points)),
        "cost": (draw_cost, bool(cost_lines(points))),
        "stages": (draw_stages, any(point.stages for point in points)),
    }
    return [
        _chart(draw, points, f"{name}-{kind}") for kind, (draw, drawn) in drawings.items() if drawn
    ]


def ablation_charts(ablations: Sequence[Ablation]) -> list[Chart]:
    """Return the time that plans saved by what they left out, a chart for each bench and model."""
    return [
        _chart(draw_ablations, found, slug(f"{bench}-{model}-saved"))
        for (bench, model), found in grouped(ablations, lambda one: (one.bench, one.model)).items()
    ]


def lines_chart(lines: Lines, heading: str, of: str) -> Chart:
    """Return the chart of milliseconds against a number, `of` what, with bars as long as
    spreads."""
    return _chart(partial(_draw_lines, heading=heading, of=of), lines, slug(heading))


def slug(text: str) -> str:
    """Return a file name for a title, such as "voxelize-bunny-obj-mesh-to-voxels"."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-")[:100]


def _chart(draw: Any, points: Any, name: str) -> Chart:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    style: dict[Any, Any] = {
        **matplotlib.rcParamsDefault,  # not the user's
        "svg.fonttype": "none", "svg.hashsalt": name, "font.size": 9, "text.color": INK,
        "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
        "axes.edgecolor": GRID, "axes.labelcolor": INK, "xtick.color": INK,
        "ytick.color": INK, "axes.facecolor": GROUND, "grid.color": GRID,
        "figure.facecolor": GROUND, "savefig.facecolor": GROUND,
        "axes.spines.top": False, "axes.spines.right": False, "grid.linewidth": 0.6,
        "legend.frameon": False, "legend.fontsize": 8, "axes.titlesize": 11,
        "axes.titlelocation": "left", "axes.titlepad": 12, "axes.axisbelow": True,
    }  # fmt: skip
    svg, png = io.BytesIO(), io.BytesIO()
    with matplotlib.rc_context(style), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # names may be in any script
        layout = ConstrainedLayoutEngine()
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, layout=layout)
        FigureCanvasAgg(figure)
        draw(figure, points)
        layout.execute(figure)  # once: it takes longer than drawing does
        figure.set_layout_engine(None)
        figure.savefig(svg, format="svg", metadata={"Date": None})
        figure.savefig(png, format="png", metadata={"Software": None})
    return Chart(name, inline(svg.getvalue().decode()), png.getvalue())


def inline(svg: str) -> str:
    """Return an SVG file as an element of a page: without its head, and in the page's colours."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    for colour, name in CSS.items():
        svg = svg.replace(colour, name)
    return svg


# --- drawings ------------------------------------------------------------------------------------


def draw_error(figure: Any, points: Sequence[Point]) -> None:
    """Draw error against time, one line a method, with the Pareto front marked."""
    plot = _logarithmic(figure)
    errors = [point.error for point in points if point.error is not None and point.error > 0]
    floor = min(errors, default=1e-6) / 4  # errors of 0 are drawn here

    def draw(some: Sequence[Point], **style: Any) -> None:
        plot.plot([p.seconds for p in some], [p.error or floor for p in some], **style)

    front = pareto(points)
    plot.step(
        [p.seconds for p in front], [p.error or floor for p in front], where="post",
        color=INK, alpha=0.16, linewidth=7, zorder=1, solid_capstyle="round",
        label="Pareto front",
    )  # fmt: skip
    for number, (method, found) in enumerate(methods_of(points).items()):
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        known = sorted((p for p in found if p.error is not None), key=lambda p: p.seconds)
        if not known:
            plot.axvline(found[0].seconds, color=colour, linestyle=":", linewidth=1.5,
                         label=plain(f"{method} (no error is measured)"))  # fmt: skip
            continue
        dashed = {"linestyle": (0, (4, 2)), "linewidth": 1.1} if found[0].peer else {}
        draw(
            known, color=colour, marker=marker, markersize=6, zorder=3, label=plain(method),
            markerfacecolor=GROUND, markeredgewidth=1.4, **{"linewidth": 1.5, **dashed},
        )  # fmt: skip
        best = [p for p in known if p in front]
        draw(best, linestyle="none", marker=marker, markersize=8, color=colour, zorder=4)
    plot.margins(0.12, 0.12)
    last = np.full(2, -math.inf)
    for p in front:
        place = plot.transData.transform((p.seconds, p.error or floor))
        if (np.abs(place - last) > NEAR).any():  # the labels do not overlap
            several = sum(q.method == p.method and q.error is not None for q in points) > 1
            text = plain(p.label if several else p.method) + ("" if p.error else " (0)")
            plot.annotate(text, (p.seconds, p.error or floor), (6, 6), fontsize=7,
                          textcoords="offset points", color=INK, zorder=5)  # fmt: skip
            last = place
    bench, measure = points[0].bench, charted(points[0].bench)
    plot.set(xlabel="seconds", ylabel=plain(f"{measure} error, {MEASURES[bench][measure]}"))
    _finish(figure, f"{title(points[0].chart)}: error against time")


def draw_cost(figure: Any, points: Sequence[Point]) -> None:
    """Draw seconds against size, with the exponents that fit."""
    plot = _logarithmic(figure)
    fitted, methods = exponents(points), list(methods_of(points))
    for method, line in cost_lines(points).items():
        number = methods.index(method)
        p, low, high = fitted[method]
        plot.plot(
            *zip(*line, strict=True), marker=MARKERS[number % len(MARKERS)], markersize=6,
            color=COLOURS[number % len(COLOURS)], markerfacecolor=GROUND, linewidth=1.5,
            label=plain(f"{method}: size^{p:.2f}, {low:g} to {high:g}"),
        )  # fmt: skip
    sizes = sorted({p.size for p in points if p.size})
    if len(sizes) <= 8:
        apart = [b for a, b in pairwise([0, *sizes]) if b > 1.5 * a]
        plot.set_xticks(apart, [f"{size:,g}" for size in apart])
        plot.set_xticks([], minor=True)
    plot.margins(0.08, 0.12)
    plot.set(xlabel=next(p.size_of for p in points if p.size), ylabel="seconds")
    _finish(figure, f"{title(points[0].chart)}: cost against size")


def _draw_lines(figure: Any, lines: Lines, *, heading: str, of: str) -> None:
    plot = _logarithmic(figure)
    for number, (name, line) in enumerate(lines.items()):
        x, y, spreads = zip(*line, strict=True)
        plot.errorbar(
            x, y, yerr=[np.zeros(len(y)), np.multiply(y, spreads)],
            marker=MARKERS[number % len(MARKERS)], markersize=5, markerfacecolor=GROUND,
            color=COLOURS[number % len(COLOURS)], linewidth=1.5, elinewidth=1, capsize=2,
            label=plain(name),
        )  # fmt: skip
    sizes = sorted({point[0] for line in lines.values() for point in line})
    plot.set_xticks(sizes, [f"{size:,g}" for size in sizes])
    plot.set_xticks([], minor=True)
    plot.set(xlabel=of, ylabel="milliseconds")
    _finish(figure, heading)


def draw_stages(figure: Any, points: Sequence[Point]) -> None:
    """Draw a bar of the stages on the device for the slowest setting of each method."""
    known = methods_of(point for point in points if point.stages)
    bars = [max(found, key=lambda p: p.seconds) for found in known.values()]
    plot = _bars(figure, [(p.method, p.label) for p in bars])
    left = np.zeros(len(bars))
    stages = dict.fromkeys(stage for point in bars for stage in point.stages)
    for number, stage in enumerate(stages):
        width = np.array([1e3 * point.stages.get(stage, 0.0) for point in bars])
        plot.barh(range(len(bars)), width, left=left, height=0.62, label=plain(stage),
                  color=COLOURS[number % len(COLOURS)], edgecolor=GROUND,
                  linewidth=0.8)  # fmt: skip
        left += width
    for row, (end, point) in enumerate(zip(left.tolist(), bars, strict=True)):
        plot.annotate(f" {duration(point.seconds)} in total", (end, row), va="center", fontsize=7)
    plot.set(xlim=(0, 1.22 * max(*left.tolist(), 1e-6)), xlabel="ms on the device")
    _finish(figure, f"{title(points[0].chart)}: stages")


def draw_ablations(figure: Any, ablations: Sequence[Ablation]) -> None:
    """Draw the time with a decision forced over the time as planned: a bar for each, from 1, and
    the range of the repeats."""
    plot = _bars(figure, [(one.what, one.work) for one in ablations])
    ratios = []
    for row, one in enumerate(ablations):
        planned = statistics.median(one.runs)
        least, middle, most = (f(one.forced) / planned for f in (min, statistics.median, max))
        ratios += [least, most]
        kind, colour = "within the noise", GRID
        if one.beyond_noise and one.saved > 0:
            kind, colour = "saved by leaving it out", COLOURS[0]
        elif one.beyond_noise:
            kind, colour = "lost by leaving it out", COLOURS[1]
        plot.barh(row, middle - 1, left=1, height=0.62, label=kind, color=colour)
        plot.plot((least, most), (row, row), color=INK, linewidth=1)
    plot.axvline(1, color=INK, linewidth=1)
    plot.set(
        xlim=(min(0.9, *ratios), max(1.1, *ratios)),
        xlabel="time with it forced over time as planned; lines: all repeats",
    )
    _finish(figure, f"{ablations[0].bench}, {ablations[0].model}: what was left out")


def plain(text: str) -> str:
    """Return the text, escaped so that matplotlib prints it unchanged."""
    return printable(text).replace("$", r"\$")


def _logarithmic(figure: Any) -> Any:
    """Return axes with two logarithmic scales, with plain numbers: formulas take long to be set."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    plot = figure.add_subplot()
    plot.set(xscale="log", yscale="log")
    for axis in (plot.xaxis, plot.yaxis):
        axis.set_major_formatter(Plain())
        axis.set_minor_formatter(Plain(labelOnlyBase=False))
    plot.grid(True, which="major")
    return plot


def _bars(figure: Any, names: Sequence[tuple[str, str]]) -> Any:
    """Return axes for one horizontal bar for each name, which has two lines; from the top down."""
    figure.set_size_inches(WIDTH, REST + BAR * len(names))
    plot = figure.add_subplot()
    plot.grid(True, axis="x")
    words = [f"{plain(first)}\n{plain(second)}" for first, second in names]
    plot.set_yticks(range(len(names)), words, fontsize=7)
    plot.set_ylim(len(names) - 0.5, -0.5)
    return plot


def _finish(figure: Any, heading: str) -> None:
    """Add the title, and a legend below the axes that has each label once."""
    (plot,) = figure.axes
    plot.set_title(plain(heading))
    handles, labels = plot.get_legend_handles_labels()
    keys = dict(zip(labels, handles, strict=True))
    columns = max(1, min(3, LINE // (10 + max(map(len, keys)))))
    figure.set_size_inches(WIDTH, figure.get_figheight() + ROW * -(-len(keys) // columns))
    figure.legend(
        list(keys.values()), list(keys), loc="outside lower center", ncols=columns, handlelength=2.4
    )
