"""A report of a benchmark: JSON, CSV, one page of HTML that needs no network, and PNG of charts."""

from __future__ import annotations

import csv
import importlib
import io
import json
import os
import platform
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.chart import Chart, ablation_charts, charts, slug
from voxtool.bench.compare import FORMAT, MAJOR
from voxtool.bench.points import (
    FIGURES,
    MEASURES,
    charts_of,
    costs,
    duration,
    named,
    title,
    verdicts,
)
from voxtool.bench.tables import absent_of, tables_of
from voxtool.errors import FileError, human, printable
from voxtool.files import alone, atomic_path, check_target
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.points import Ablation, Point
    from voxtool.opencl.discovery import DeviceInfo

SCHEMA_VERSION = f"{MAJOR}.1"
FILES = ("report.json", "report.csv", "report.html")
PATIENCE = 60  # seconds to wait for another run that writes into the same folder
NEEDS = {"matplotlib": "charts need matplotlib", "jinja2": "pages need Jinja2"}


@dataclass(frozen=True)
class Report:
    """The points and ablations, the device, and the command; date : as given, or None."""

    points: list[Point]
    ablations: list[Ablation]
    device: DeviceInfo
    command: str
    date: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON of docs/benchmarks.md."""
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "voxtool": __version__,
            **({"date": self.date} if self.date else {}),
            "command": self.command,
            "device": self.device.as_dict(),
            "machine": machine(),
            "measures": MEASURES,
            "figures": FIGURES,
            "points": [point.as_dict() for point in self.points],
            "savings": [ablation.as_dict() for ablation in self.ablations],
        }


def machine() -> dict[str, Any]:
    """Return the host, and the versions that figures may depend on."""
    return {
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def check_folder(folder: str, clobber: bool = True) -> None:
    """Raise FileError if a report could not be written into this folder."""
    for module, need in NEEDS.items():
        try:
            importlib.import_module(module)
        except ImportError:
            raise FileError(f"{need}: pip install 'voxtool[pictures]'") from None
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise FileError(f"cannot write {folder}: it is a file: name a folder")
    if not path.exists():
        check_target(path)  # its folder
    for name in FILES if path.exists() else ():
        check_target(path / name, clobber)


def write_report(report: Report, folder: str, clobber: bool = True) -> list[Path]:
    """Write report.json, report.csv, report.html and a PNG of each chart into a folder, which may
    not exist yet; returns the paths. Each file appears whole or not at all, the page last.

    Raises
    ------
    FileError : matplotlib or Jinja2 is missing, or a file cannot be written, or exists and clobber
        is False.
    """
    check_folder(folder, clobber)
    drawn = {
        chart: charts(points, slug(title(chart)))
        for chart, points in charts_of(report.points).items()
    }
    saved = ablation_charts(report.ablations)
    every = [*(chart for found in drawn.values() for chart in found), *saved]
    contents: dict[str, bytes] = {f"{chart.name}.png": chart.png for chart in every}
    text = json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n"
    contents["report.json"] = text.encode()
    contents["report.csv"] = as_csv(report.points).encode("utf-8", "replace")
    contents["report.html"] = as_html(report, drawn, saved).encode()
    return write_files(contents, folder, clobber)


def write_files(contents: dict[str, bytes], folder: str, clobber: bool) -> list[Path]:
    """Write files into a folder, which may not exist yet; returns their paths, in order."""
    Path(folder).mkdir(exist_ok=True)
    written = []
    with alone(folder, PATIENCE):  # the files of one report
        for name, content in contents.items():
            with atomic_path(Path(folder, name), clobber) as temporary:
                temporary.write_bytes(content)
            written.append(Path(folder, name))
    return written


# --- CSV -----------------------------------------------------------------------------------------


def as_csv(points: Sequence[Point]) -> str:
    """Return a line for each point and a column for each measure and figure; empty if not
    measured."""
    measures = list(dict.fromkeys(name for found in MEASURES.values() for name in found))
    file = io.StringIO()
    rows = csv.writer(file)
    head = ["bench", "model", "work", "method", "setting", "peer", "seconds", "least", "most",
            "first", "size", "size of", *(f"{name} error" for name in measures), "bytes",
            "peak bytes", *FIGURES, "command"]  # fmt: skip
    rows.writerow(head)
    for p in points:
        words = (p.bench, p.model, p.work, p.method, p.label)
        rows.writerow([
            *map(_cell, words), int(p.peer), p.seconds, min(p.runs), max(p.runs), p.first, p.size,
            p.size_of, *map(p.errors.get, measures), p.bytes, p.peak, *map(p.figures.get, FIGURES),
            _cell(p.command),
        ])  # fmt: skip
    return file.getvalue()


def _cell(text: str) -> str:
    """Return the text; quoted if a spreadsheet would take it for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


# --- HTML ----------------------------------------------------------------------------------------


def as_html(
    report: Report,
    drawn: dict[tuple[str, str, str], list[Chart]],
    ablation_charts: Sequence[Chart],
) -> str:
    """Return the page, from report.html beside this module: what to choose first, then charts, what
    was left out, and all figures."""
    points, device = report.points, report.device
    found = f"{device.name}, {device.platform} {device.driver}"
    return page(
        "report.html",
        models=", ".join(dict.fromkeys(point.model for point in points)),
        where="; ".join([f"voxtool {__version__}", found, *([report.date] if report.date else [])]),
        sections=[
            {
                "title": title(chart), "verdicts": [*verdicts(some), *costs(some)],
                "charts": drawn[chart], "tables": tables_of(some), "absent": absent_of(some),
            }
            for chart, some in charts_of(points).items()
        ],
        ablation_charts=ablation_charts,
        ablations=[_ablation_row(one) for one in report.ablations],
        left_out=sorted({
            (point.bench, *item) for point in points for item in point.left_out.items()
        }),
        machine=list(_machine(report).items()),
        command=report.command,
        commands=[(f"{title(p.chart)}: {named(p)}", p.command) for p in points],
    )  # fmt: skip


def page(template: str, **values: Any) -> str:
    """Return a page from a template beside this module; values are escaped."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined,
        finalize=lambda value: printable(value) if type(value) is str else value,
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
    )  # fmt: skip
    return environment.get_template(template).render(**values)


def _ablation_row(one: Ablation) -> tuple[str, ...]:
    times = (duration(statistics.median(runs)) for runs in (one.runs, one.forced))
    result = "the same" if one.same else "differs"
    return (one.bench, one.model, one.work, one.what, one.why, *times, one.verdict, result)


def _machine(report: Report) -> dict[str, str]:
    device = report.device
    peers = dict.fromkeys(point.method for point in report.points if point.peer)
    return {
        "device": f"{device.name} ({device.kind})",
        "platform": f"{device.platform}, driver {device.driver}, {device.opencl}",
        "units": f"{device.units}, {human(device.memory)} of memory",
        **{name: str(value) for name, value in machine().items()},
        "voxtool": __version__,
        **({"other tools": "; ".join(peers)} if peers else {}),
    }
