"""A report of `voxtool bench texts`: JSON, and one page of HTML with a section for each table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from voxtool.bench.chart import Chart, lines_chart
from voxtool.bench.report import machine, page, write_files
from voxtool.bench.text_layout import READING, sections
from voxtool.bench.text_rows import Row
from voxtool.opencl.discovery import DeviceInfo
from voxtool.version import __version__

FIGURES = ("[voCCeL] figure 7.1", "[voCCeL] figure 7.2")  # of times; others have words alone


def as_dict(rows: list[Row], device: DeviceInfo, command: str) -> dict[str, Any]:
    """Return the JSON of docs/benchmarks.md."""
    return {
        "voxtool": __version__, "command": command, "device": device.as_dict(),
        "machine": machine(), "rows": [row.as_dict() for row in rows],
    }  # fmt: skip


def figures_of(rows: list[Row]) -> dict[str, list[Chart]]:
    """Return the figures of the texts, drawn of voxtool's times: the charts of each, one a
    model."""
    lines: dict[tuple[str, str], dict[str, list[tuple[float, float, float]]]] = {}
    for row in rows:
        if row.table in FIGURES and row.unit == "ms" and row.voxtool:
            of_model = lines.setdefault((row.table, row.model), {})
            point = (float(row.setting.removeprefix("dim ")), row.voxtool, row.spread or 0)
            of_model.setdefault(f"{row.what}: {row.way}", []).append(point)
    drawn: dict[str, list[Chart]] = {}
    for (table, model), found in lines.items():
        drawn.setdefault(table, []).append(lines_chart(found, f"{table}: {model}", "dim"))
    return drawn


def write_text_report(
    rows: list[Row], device: DeviceInfo, command: str, folder: str, clobber: bool = True
) -> list[Path]:
    """Write report.json, report.html and a PNG of each figure into a folder, which may not exist
    yet; returns the paths.

    Raises
    ------
    FileError : a file cannot be written, or exists and clobber is False.
    """
    drawn = figures_of(rows)
    html = page(
        "texts.html",
        device=device.name,
        models=", ".join(dict.fromkeys(row.model for row in rows)),
        where=f"voxtool {__version__}; {device.name}, {device.platform} {device.driver}",
        command=command,
        reading=READING,
        sections=sections(rows),
        figures=drawn,
    )
    text = json.dumps(as_dict(rows, device, command), indent=1, allow_nan=False) + "\n"
    charts = (chart for found in drawn.values() for chart in found)
    contents = {f"{chart.name}.png": chart.png for chart in charts}
    contents |= {"report.json": text.encode(), "report.html": html.encode()}
    return write_files(contents, folder, clobber)
