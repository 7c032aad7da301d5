"""Comparison of two reports of benchmarks: what became slower or less accurate, beyond the noise.

Rows are matched by bench, model, work, method and label. A time has changed if all runs of one
report are slower than all runs of the other. Errors have no noise, because the same input gives the
same output; differences below ERROR_NOISE are allowed for other tools.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any, NoReturn

from voxtool.errors import FileError, one_line
from voxtool.files.storage.streams import PathLike, input_name, open_whole, read_error

FORMAT, MAJOR = "voxtool-bench", "1"
MOST_BYTES = 64 << 20  # bytes of a report
MOST_TEXT = 1000  # characters of a name
ERROR_NOISE = 1e-6  # relative
KEY = ("bench", "model", "work", "method", "label")


@dataclass(frozen=True)
class Row:
    """The seconds of the runs of a point: median, least and most; and its errors by measure."""

    seconds: float
    least: float
    most: float
    errors: dict[str, float]


@dataclass(frozen=True)
class Summary:
    """The rows of a report by the fields of KEY; where : the name and driver of the device."""

    rows: dict[tuple[str, ...], Row]
    where: str


@dataclass(frozen=True)
class Change:
    """A row of two reports; worse, better : the errors that became larger or smaller, by measure,
    each with its old and new value."""

    key: tuple[str, ...]
    old: Row
    new: Row
    worse: dict[str, tuple[float, float]]
    better: dict[str, tuple[float, float]]

    @property
    def percent(self) -> float:
        """The percentage by which the new median is larger than the old one."""
        return min(100 * (self.new.seconds / self.old.seconds - 1), sys.float_info.max)

    @property
    def slower(self) -> bool:
        """True if every new run is slower than every old one."""
        return self.new.least > self.old.most

    @property
    def faster(self) -> bool:
        return self.new.most < self.old.least

    def fails(self, over: float) -> bool:
        """Return True if the row is slower by more than `over` percent, or less accurate."""
        return bool(self.worse) or (self.slower and self.percent > over)

    def as_dict(self) -> dict[str, Any]:
        """Return the change in JSON types."""
        return {
            **dict(zip(KEY, self.key, strict=True)),
            "old": self.old.seconds,
            "new": self.new.seconds,
            "percent": self.percent,
            "time": "slower" if self.slower else "faster" if self.faster else "same",
            "less accurate": {name: list(pair) for name, pair in self.worse.items()},
            "more accurate": {name: list(pair) for name, pair in self.better.items()},
        }


def compare(old: Summary, new: Summary) -> list[Change]:
    """Return the changes of the rows that both reports have, in the order of the new one."""
    return [change(key, old.rows[key], row) for key, row in new.rows.items() if key in old.rows]


def change(key: tuple[str, ...], old: Row, new: Row) -> Change:
    worse, better = {}, {}
    for name, was in old.errors.items():
        if name not in new.errors:
            continue
        now = new.errors[name]
        if abs(now - was) > ERROR_NOISE * max(now, was):
            (worse if now > was else better)[name] = was, now
    return Change(key, old, new, worse, better)


# --- reading -------------------------------------------------------------------------------------


def read_report(path: PathLike) -> Summary:
    """Read a report.json; `-` reads stdin.

    Raises
    ------
    FileError : the file is missing, damaged, hostile or of another kind.
    """
    name = input_name(path)
    try:
        with open_whole(path) as (file, size):
            if size > MOST_BYTES:
                raise FileError(f"{name}: {size:,} bytes, a report has at most {MOST_BYTES:,}")
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise read_error(name, error) from None
    try:
        value = json.loads(data, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{name}: is no JSON: {one_line(error)[:80]}") from None
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise FileError(f"{name}: is no report of `voxtool bench`: write one with -o")
    version = value.get("schema_version")
    if not isinstance(version, str) or version.partition(".")[0] != MAJOR:
        raise FileError(
            f"{name}: schema version {one_line(ValueError(version))[:20]}, and {MAJOR} can be read:"
            " measure it again with this voxtool"
        )
    try:
        return _summary(value)
    except ValueError as error:
        raise FileError(f"{name}: damaged: {error}") from None


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")


def _summary(report: dict[str, Any]) -> Summary:
    """Return the Summary of a report. This and all below raise ValueError where it is damaged."""
    rows: dict[tuple[str, ...], Row] = {}
    for number, point in enumerate(_typed(list, report.get("points"), "points")):
        where = f"point {number}"
        _typed(dict, point, where)
        key = tuple(_text(point.get(word), f"{where}, {word},") for word in KEY)
        if key in rows:
            raise ValueError(f"{where} is there twice")
        rows[key] = _row(point, where)
    device = _typed(dict, report.get("device"), "device")
    words = [_text(device.get(word), f"device, {word},") for word in ("name", "driver")]
    return Summary(rows, ", ".join(words))


def _row(point: dict[str, Any], where: str) -> Row:
    seconds = _typed(dict, point.get("seconds"), f"{where}, seconds,")
    errors = _typed(dict, point.get("errors"), f"{where}, errors,")
    median, least, most = (
        _number(seconds.get(word), f"{where}, {word},") for word in ("median", "least", "most")
    )
    if not 0 < least <= median <= most:
        raise ValueError(f"{where}, seconds, are not positive and in order")
    found = {
        _text(word, f"{where}, errors,"): _number(value, f"{where}, an error,")
        for word, value in errors.items()
    }
    return Row(median, least, most, found)


def _typed(kind: type, value: Any, where: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{where} is no {'list' if kind is list else 'object'}")
    return value


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        raise ValueError(f"{where} is no text of up to {MOST_TEXT} characters")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{where} is no number")
    if not 0 <= value <= sys.float_info.max:
        raise ValueError(f"{where} is out of range")
    return float(value)
