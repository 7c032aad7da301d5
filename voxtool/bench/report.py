"""A report of a benchmark: JSON, CSV, one page of HTML that needs no network, and PNG of charts."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.chart import (
    Chart,
    charts,
    check_matplotlib,
    exponents,
    savings_charts,
    slug,
)
from voxtool.bench.compare import FORMAT, MAJOR
from voxtool.bench.points import (
    MEASURES,
    charts_of,
    duration,
    named,
    pareto,
    title,
    verdicts,
)
from voxtool.errors import FileError, human, printable
from voxtool.files import atomic_path, check_target
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.points import Point, Saving
    from voxtool.opencl.device import DeviceInfo

SCHEMA_VERSION = f"{MAJOR}.0"
FILES = ("report.json", "report.csv", "report.html")
STYLE = """
:root { color-scheme: light dark; --ground: #f4f6f8; --card: #ffffff; --ink: #1d2530;
  --faint: #5c6875; --grid: #d5dae0; --mark: #1a6fc4; }
@media (prefers-color-scheme: dark) { :root { --ground: #12161b; --card: #1b2128; --ink: #e3e8ee;
  --faint: #98a4b1; --grid: #3a444f; --mark: #74b3f2; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 78rem; padding: 2rem 1.2rem 4rem; background: var(--ground);
  color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
h1 { font-size: 1.7rem; margin: 0; } h2 { margin: 2.6rem 0 .8rem; font-size: 1.25rem; }
h3 { margin: 0 0 .6rem; font-size: 1rem; }
p, li { max-width: 60rem; } .faint { color: var(--faint); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr));
  gap: 1rem; align-items: start; }
.card { background: var(--card); border: 1px solid var(--grid); border-radius: .6rem;
  padding: 1rem 1.1rem; overflow-x: auto; }
.card ul { margin: 0; padding-left: 1.1rem; } .card li { margin: .25rem 0; }
figure { margin: 0; } svg { display: block; width: 100%; height: auto; }
table { border-collapse: collapse; font-size: .82rem; font-variant-numeric: tabular-nums;
  width: 100%; }
th, td { padding: .28rem .6rem; text-align: left; border-bottom: 1px solid var(--grid);
  vertical-align: top; }
th { color: var(--faint); font-weight: 600; white-space: nowrap; }
td.number { text-align: right; white-space: nowrap; }
tr.front td:first-child { box-shadow: inset 3px 0 var(--mark); }
code { font: .92em ui-monospace, "SF Mono", Consolas, monospace; overflow-wrap: anywhere; }
summary { cursor: pointer; padding: .3rem 0; }
"""


@dataclass(frozen=True)
class Report:
    """What was measured, where, and by which command; date : as it was given, or None."""

    points: list[Point]
    savings: list[Saving]
    device: DeviceInfo
    command: str
    date: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """The JSON of docs/benchmarks.md."""
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "voxtool": __version__,
            **({"date": self.date} if self.date else {}),
            "command": self.command,
            "device": self.device.as_dict(),
            "machine": machine(),
            "measures": MEASURES,
            "points": [point.as_dict() for point in self.points],
            "savings": [saving.as_dict() for saving in self.savings],
        }


def machine() -> dict[str, Any]:
    """What the host is, and what else the figures may depend on."""
    return {
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def check_folder(folder: str, clobber: bool = True) -> None:
    """Refuse early a folder that a report could not be written into; raises FileError."""
    check_matplotlib()
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise FileError(f"cannot write {folder}: it is a file: name a folder")
    if not path.exists():
        check_target(path)  # its folder
    for name in FILES if path.exists() else ():
        check_target(path / name, clobber)


def write_report(report: Report, folder: str, clobber: bool = True) -> list[Path]:
    """Write report.json, report.csv, report.html and a PNG of each chart into a folder, which is
    made if there is none; each appears whole or not at all, the page the last.

    Raises
    ------
    FileError : matplotlib is missing, or a file cannot be written, or exists and clobber is False.
    """
    check_folder(folder, clobber)
    Path(folder).mkdir(exist_ok=True)
    drawn = {
        chart: charts(points, slug(title(chart)))
        for chart, points in charts_of(report.points).items()
    }
    saved = savings_charts(report.savings)
    every = [*(chart for found in drawn.values() for chart in found), *saved]
    contents: dict[str, bytes] = {f"{chart.name}.png": chart.png for chart in every}
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n"
    contents["report.json"] = text.encode()
    contents["report.csv"] = as_csv(report.points).encode("utf-8", "replace")
    contents["report.html"] = as_html(report, drawn, saved).encode()
    written = []
    for name, content in contents.items():
        with atomic_path(Path(folder, name), clobber) as temporary:
            temporary.write_bytes(content)
        written.append(Path(folder, name))
    return written


# --- CSV -----------------------------------------------------------------------------------------


def as_csv(points: Sequence[Point]) -> str:
    """A line a point: every measure has a column, and what was not measured is empty."""
    measures = list(dict.fromkeys(name for found in MEASURES.values() for name in found))
    file = io.StringIO()
    rows = csv.writer(file)
    rows.writerow(
        ["bench", "model", "work", "method", "setting", "peer", "seconds", "least", "most",
         "first", "size", "size of", *(f"{name} error" for name in measures), "bytes",
         "peak bytes", "command"]
    )  # fmt: skip
    for point in points:
        words = (point.bench, point.model, point.work, point.method, point.label)
        rows.writerow(
            [*map(_cell, words), int(point.peer), point.seconds, min(point.runs), max(point.runs),
             point.first, point.size, point.size_of, *(point.errors.get(name) for name in measures),
             point.bytes, point.peak, _cell(point.command)]
        )  # fmt: skip
    return file.getvalue()


def _cell(text: str) -> str:
    """A text that no spreadsheet takes for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


# --- HTML ----------------------------------------------------------------------------------------


def as_html(
    report: Report, drawn: dict[tuple[str, str, str], list[Chart]], saved: Sequence[Chart]
) -> str:
    """The page: what to choose first, then charts, what was left out, and all figures."""
    found = charts_of(report.points)
    models = ", ".join(dict.fromkeys(point.model for point in report.points))
    cards = "".join(verdict_card(chart, points) for chart, points in found.items())
    pictures = "".join(
        f"<h3>{shown(title(chart))}</h3>{figures(drawings)}<br>"
        for chart, drawings in drawn.items()
    )
    return f"""<!doctype html>
<html lang=en>
<head>
<meta charset=utf-8>
<meta name=viewport content="width=device-width, initial-scale=1">
<title>voxtool bench: {shown(models)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>voxtool bench: {shown(models)}</h1>
<p class=faint>{shown(where(report))}</p>
<h2>What to choose</h2>
<div class=cards>{cards}</div>
<h2>Charts</h2>
<p class=faint>Times are medians, after a warm-up, on logarithmic scales; lower and farther left is
better. Full markers and the wide band are the Pareto front: nothing measured here is as fast and
as exact. Dashed lines are other tools, on the same work in the same run.</p>
{pictures}
<h2>What the plans left out, and the time that saved</h2>
{figures(saved)}
{savings_table(report.savings)}
{left_out_list(report.points)}
<h2>Machine and device</h2>
<div class=card>{machine_table(report)}</div>
<h2>All figures</h2>
<p class=faint>The bar marks the Pareto front of a chart. Times in brackets are the fastest and the
slowest of all repeats.</p>
<div class=card>{points_table(found)}</div>
<h2>Commands</h2>
<p>This page: <code>{shown(report.command)}</code></p>
<details class=card><summary>What measures each row again</summary>
{commands_table(report.points)}</details>
</body>
</html>
"""


def shown(text: str) -> str:
    """A text that is only text in a page."""
    return escape(printable(text))


def figures(drawings: Sequence[Chart]) -> str:
    every = "".join(f"<figure class=card>{one.svg}</figure>" for one in drawings)
    return f"<div class=cards>{every}</div>"


def where(report: Report) -> str:
    device = report.device
    date = f"; {report.date}" if report.date else ""
    return f"voxtool {__version__}; {device.name}, {device.platform} {device.driver}{date}"


def verdict_card(chart: tuple[str, str, str], points: Sequence[Point]) -> str:
    lines = verdicts(points) or ["no error was measured"]
    for method, (p, low, high) in exponents(points).items():
        size_of = next(point.size_of for point in points if point.size)
        lines.append(f"cost of {method}: {size_of} to the {p:.2f}, from {low:,g} to {high:,g}")
    items = "".join(f"<li>{shown(line)}</li>" for line in lines)
    return f"<div class=card><h3>{shown(title(chart))}</h3><ul>{items}</ul></div>"


def table(head: Sequence[str], rows: Sequence[tuple[str, Sequence[Any]]]) -> str:
    """A table of a class and cells for each row; numbers are given as (text,)."""

    def cell(value: Any) -> str:
        if isinstance(value, tuple):
            return f"<td class=number>{shown(value[0])}</td>"
        return f"<td>{value if isinstance(value, Markup) else shown(value)}</td>"

    heads = "".join(f"<th>{shown(word)}</th>" for word in head)
    lines = "".join(
        f"<tr{f' class={kind}' if kind else ''}>{''.join(map(cell, cells))}</tr>"
        for kind, cells in rows
    )
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table>"


class Markup(str):
    """A text that is HTML already."""


def savings_table(savings: Sequence[Saving]) -> str:
    if not savings:
        return "<p>Nothing was forced in.</p>"
    rows = []
    for saving in savings:
        planned, forced = sorted(saving.runs), sorted(saving.forced)
        middle, other = planned[len(planned) // 2], forced[len(forced) // 2]
        verdict = f"{duration(abs(saving.saved))} {'saved' if saving.saved > 0 else 'lost'}"
        rows.append(
            ("", (
                saving.bench, saving.model, saving.work, saving.what, saving.why,
                (duration(middle),), (duration(other),),
                (verdict if saving.beyond_noise else "within the noise",),
                "the same" if saving.same else "differs",
            ))
        )  # fmt: skip
    head = ("bench", "model", "work", "left out", "because", "as planned", "forced in",
            "difference", "result")  # fmt: skip
    return f"<div class=card>{table(head, rows)}</div>"


def left_out_list(points: Sequence[Point]) -> str:
    """What the plans say, of everything that was left out."""
    found: dict[tuple[str, str], str] = {}
    for point in points:
        for what, why in point.left_out.items():
            found.setdefault((point.bench, what), why)
    rows = [("", (bench, what, why)) for (bench, what), why in found.items()]
    return (
        "<details class=card><summary>All that was left out, in the plans' words; what is not in "
        "the table above there is no way to force in, or it would be other work</summary>"
        f"{table(('bench', 'left out', 'because'), rows)}</details>"
    )


def machine_table(report: Report) -> str:
    device = report.device
    rows = {
        "device": f"{device.name} ({device.kind})",
        "platform": f"{device.platform}, driver {device.driver}, {device.opencl}",
        "units": f"{device.units}, {human(device.memory)} of memory",
        **{name: str(value) for name, value in machine().items()},
        "voxtool": __version__,
    }
    peers = dict.fromkeys(point.method for point in report.points if point.peer)
    if peers:
        rows["other tools"] = "; ".join(peers)
    return table(("", ""), [("", item) for item in rows.items()])


def points_table(found: dict[tuple[str, str, str], list[Point]]) -> str:
    rows = []
    for chart, points in found.items():
        front = {id(point) for point in pareto(points)}
        for point in points:
            errors = "; ".join(f"{name} {value:.3g}" for name, value in point.errors.items())
            missing = "; ".join(f"no {name}: {why}" for name, why in point.absent.items())
            spread = f"[{duration(min(point.runs))}, {duration(max(point.runs))}]"
            if point.first is not None:
                spread += f", the first {duration(point.first)}"
            size = f"{point.size:,g} {point.size_of}" if point.size else ""
            rows.append(
                ("front" if id(point) in front else "", (
                    title(chart), named(point), (duration(point.seconds),), (spread,),
                    Markup(f"{shown(errors)}<br><span class=faint>{shown(missing)}</span>"),
                    (size,), (human(point.bytes) if point.bytes else "",),
                    (human(point.peak) if point.peak else "",),
                ))
            )  # fmt: skip
    head = ("work", "setting", "time", "of repeats", "errors", "size", "result", "peak of memory")
    return table(head, rows)


def commands_table(points: Sequence[Point]) -> str:
    rows = [
        ("", (title(point.chart), named(point), Markup(f"<code>{shown(point.command)}</code>")))
        for point in points
    ]
    return table(("work", "setting", "command"), rows)
