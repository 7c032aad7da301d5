"""Comparison of two reports of benchmarks: what became slower or less accurate, beyond the noise.

Rows are matched by bench, model, work, method and label. A time has changed if all runs of one
report are slower than all runs of the other. Errors have no noise, because the same input gives the
same output; differences below ERROR_NOISE are allowed for other tools.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from voxtool.errors import FileError, one_line
from voxtool.files.streams import PathLike, input_name, open_whole, read_error

if TYPE_CHECKING:
    from collections.abc import Mapping

FORMAT, MAJOR = "voxtool-bench", "1"
MOST_BYTES = 64 << 20  # of a report
MOST_TEXT = 1000  # characters of a name
ERROR_NOISE = 1e-6  # relative
KEY = ("bench", "model", "work", "method", "label")


@dataclass(frozen=True)
class Row:
    """One setting of a report: the median, least and most seconds of its runs, and its errors by
    measure."""

    seconds: float
    least: float
    most: float
    errors: dict[str, float]


@dataclass(frozen=True)
class Summary:
    """A report: its rows by bench, model, work, method and label; where : the device, in words."""

    rows: dict[tuple[str, ...], Row]
    where: str


@dataclass(frozen=True)
class Change:
    """A row that two reports have.

    Attributes
    ----------
    faster, slower : whether the time has changed beyond the noise.
    percent : by which the new median is over the old one.
    worse, better : errors that became larger or smaller, by measure, with both values.
    """

    key: tuple[str, ...]
    old: Row
    new: Row
    worse: dict[str, tuple[float, float]]
    better: dict[str, tuple[float, float]]

    @property
    def percent(self) -> float:
        return 100 * (self.new.seconds / self.old.seconds - 1)

    @property
    def slower(self) -> bool:
        return self.new.least > self.old.most

    @property
    def faster(self) -> bool:
        return self.new.most < self.old.least

    def fails(self, over: float) -> bool:
        """Whether the row is slower by more than `over` percent, or less accurate."""
        return bool(self.worse) or (self.slower and self.percent > over)

    def as_dict(self) -> dict[str, Any]:
        """JSON types."""
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
    """The changes of the rows that both reports have, in the order of the new one."""
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
    FileError : there is none, or it is damaged, hostile or of another kind.
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
    return _Checked(name).summary(value)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON number")


@dataclass(frozen=True)
class _Checked:
    """Checked access to the JSON of a report; every method raises FileError."""

    name: str

    def fail(self, where: str, what: str) -> NoReturn:
        raise FileError(f"{self.name}: damaged: {where} {what}")

    def summary(self, value: Mapping[str, Any]) -> Summary:
        points = value.get("points")
        if not isinstance(points, list):
            self.fail("points", "is no list")
        rows: dict[tuple[str, ...], Row] = {}
        for number, point in enumerate(points):
            where = f"point {number}"
            if not isinstance(point, dict):
                self.fail(where, "is no object")
            key = tuple(self.text(point.get(word), f"{where}, {word},") for word in KEY)
            if key in rows:
                self.fail(where, "is there twice")
            rows[key] = self.row(point, where)
        device = value.get("device")
        if not isinstance(device, dict):
            self.fail("device", "is no object")
        words = [self.text(device.get(word), f"device, {word},") for word in ("name", "driver")]
        return Summary(rows, ", ".join(words))

    def row(self, point: Mapping[str, Any], where: str) -> Row:
        seconds, errors = point.get("seconds"), point.get("errors")
        if not isinstance(seconds, dict):
            self.fail(f"{where}, seconds,", "is no object")
        if not isinstance(errors, dict):
            self.fail(f"{where}, errors,", "is no object")
        names = ("median", "least", "most")
        median, least, most = (
            self.number(seconds.get(word), f"{where}, {word},", positive=True) for word in names
        )
        if not least <= median <= most:
            self.fail(f"{where}, seconds,", "are not in order")
        return Row(
            median,
            least,
            most,
            {
                self.text(word, f"{where}, errors,"): self.number(found, f"{where}, an error,")
                for word, found in errors.items()
            },
        )

    def text(self, value: Any, where: str) -> str:
        if not isinstance(value, str) or len(value) > MOST_TEXT:
            self.fail(where, f"is no text of up to {MOST_TEXT} characters")
        return value

    def number(self, value: Any, where: str, positive: bool = False) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(where, "is no number")
        try:
            found = float(value)
        except OverflowError:
            found = math.inf
        if not (found > 0 if positive else found >= 0) or found == math.inf:
            self.fail(where, "is out of range")
        return found
