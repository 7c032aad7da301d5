"""A report of `voxtool bench texts`: JSON, and one page of HTML with a section for each table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from voxtool.bench.report import machine, page, write_files
from voxtool.bench.text_layout import READING, sections
from voxtool.bench.text_rows import Row
from voxtool.opencl.discovery import DeviceInfo
from voxtool.version import __version__


def as_dict(rows: list[Row], device: DeviceInfo, command: str) -> dict[str, Any]:
    """The JSON of docs/benchmarks.md."""
    return {
        "voxtool": __version__, "command": command, "device": device.as_dict(),
        "machine": machine(), "rows": [row.as_dict() for row in rows],
    }  # fmt: skip


def write_text_report(
    rows: list[Row], device: DeviceInfo, command: str, folder: str, clobber: bool = True
) -> list[Path]:
    """Write report.json and report.html into a folder, which may not exist yet; returns the paths.

    Raises
    ------
    FileError : a file cannot be written, or exists and clobber is False.
    """
    html = page(
        "texts.html",
        device=device.name,
        models=", ".join(dict.fromkeys(row.model for row in rows)),
        where=f"voxtool {__version__}; {device.name}, {device.platform} {device.driver}",
        command=command,
        reading=READING,
        sections=sections(rows),
    )
    text = json.dumps(as_dict(rows, device, command), indent=1, allow_nan=False) + "\n"
    contents = {"report.json": text.encode(), "report.html": html.encode()}
    return write_files(contents, folder, clobber)
