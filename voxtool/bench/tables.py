"""Points as tables, for a terminal and for a page: the error beside the time, further figures, and
the stages. A column that no point of a table has is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from voxtool.bench.points import FIGURES, MEASURES, duration, named, pareto
from voxtool.errors import human

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from voxtool.bench.points import Point

    Columns = dict[str, Callable[[Point], str]]
    T = TypeVar("T")

NONE = "-"  # a point without a value in a column


@dataclass(frozen=True)
class Table:
    """Texts in columns, of which the first names the rows.

    note : the units of the columns; front : numbers of the rows on the Pareto front.
    """

    head: list[str]
    rows: list[list[str]]
    note: str
    front: frozenset[int] = frozenset()

    def lines(self) -> list[str]:
        """Return the table as text: the front is marked with *."""
        first = [("* " if i in self.front else "  ") + row[0] for i, row in enumerate(self.rows)]
        cells = [[f"  {self.head[0]}", *self.head[1:]]]
        cells += [[name, *row[1:]] for name, row in zip(first, self.rows, strict=True)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
            for row in cells
        ]


def tables_of(points: Sequence[Point]) -> list[Table]:
    """Return the tables of the points of one chart."""
    front = {id(point) for point in pareto(points)}
    marked = frozenset(i for i, point in enumerate(points) if id(point) in front)
    stages = dict.fromkeys(stage for point in points for stage in point.stages)
    errors: Columns = {
        "time": lambda p: duration(p.seconds),
        "±": lambda p: f"{100 * p.spread:.0f} %",
        "first": lambda p: _text(p.first, duration),
        **{name: partial(_error, name) for name in MEASURES[points[0].bench]},
        "beside": partial(_ratio, points),
        "over parity": partial(_over_parity, points),
    }
    figures: Columns = {
        # if the label does not have it
        "size": lambda p: (
            NONE
            if p.size_of in ("dim", "pixels", "triangles", "cells")
            else _text(p.size, lambda size: f"{size:,.0f} {p.size_of}")
        ),
        "result": lambda p: _text(p.bytes, human),
        "peak memory": lambda p: _text(p.peak, human),
        **{name: partial(_figure, name) for name in FIGURES},
    }
    times: Columns = {
        "all": lambda p: _text(sum(p.stages.values()) or None, _milliseconds),
        **{name: partial(_stage, name) for name in stages},
    }
    found = [
        _table(points, _error_note(points), marked, errors),
        _table(points, _figures_note(points), frozenset(), figures),
        _table(points, "stages on the device, ms", frozenset(), times),
    ]
    return [table for table in found if len(table.head) > 1]


def absent_of(points: Sequence[Point]) -> list[str]:
    """Return the reasons why measures are missing in a chart, each once."""
    reasons: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for point in points:
        for measure, why in point.absent.items():
            methods, measures = reasons.setdefault(why, ({}, {}))
            methods[point.method] = measures[measure] = None
    every, lines = set(MEASURES[points[0].bench]), []
    for why, (methods, measures) in reasons.items():
        missing = "error" if set(measures) == every else ", ".join(measures)
        lines.append(f"{'; '.join(methods)}: no {missing}: {why}")
    return lines


def _table(points: Sequence[Point], note: str, front: frozenset[int], columns: Columns) -> Table:
    """Return a table of the columns that some point has, and of the points that have something in
    it."""
    texts = {name: [text(point) for point in points] for name, text in columns.items()}
    kept = {name: column for name, column in texts.items() if set(column) != {NONE}}
    rows = [
        [named(point), *(column[i] for column in kept.values())]
        for i, point in enumerate(points)
        if any(column[i] != NONE for column in kept.values())
    ]
    return Table(["setting", *kept], rows, note, front)


def _error_note(points: Sequence[Point]) -> str:
    """Return a line that names the units of the errors."""
    units: dict[str, list[str]] = {}
    for name, unit in MEASURES[points[0].bench].items():
        if any(name in point.errors for point in points):
            units.setdefault(unit, []).append(name)
    note = "; ".join(f"{', '.join(names)}: {unit}" for unit, names in units.items())
    return f"time, and errors: {note}" if note else "time"


def _figures_note(points: Sequence[Point]) -> str:
    """Return a line that explains the figures whose names do not."""
    words = {
        "host": "the time that Python adds to the stages",
        "command": "the whole command in its own process",
        "peak memory": "resident, of that command",
        "nodes": "cubes that the algorithm of [voCCeL] visits, of the grid's samples",
        "over the file": "bytes of the page, or of the export, over those of the content's .h5",
        "base": "bytes of the page without its data",
        "break-even": "points from which the field takes less time than exact distances",
    }
    names = {name for point in points for name in point.figures}
    names |= {"peak memory"} if any(point.peak for point in points) else set()
    return "; ".join(["figures", *(f"{n}: {what}" for n, what in words.items() if n in names)])


def _text(value: T | None, form: Callable[[T], str]) -> str:
    return NONE if value is None else form(value)


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _error(name: str, point: Point) -> str:
    return _text(point.errors.get(name), "{:.3g}".format)


def _stage(name: str, point: Point) -> str:
    return _text(point.stages.get(name), _milliseconds)


FORMS: dict[str, Callable[[float], str]] = {  # of figures, by their units
    "s": duration,
    "ns": "{:,.1f}".format,
    "share": lambda value: f"{100 * value:.2f} %",
    "count": "{:,.0f}".format,
    "number": "{:.3g}".format,
}


def _figure(name: str, point: Point) -> str:
    if name not in point.figures:
        return NONE
    value = point.figures[name]
    return "never" if value is None else FORMS[FIGURES[name]](value)


def _ratio(points: Sequence[Point], point: Point) -> str:
    """Return the time of another tool over voxtool's at the same setting."""
    ours = next((p for p in points if not p.peer and p.label == point.label), None)
    return f"{point.seconds / ours.seconds:.2g} times" if point.peer and ours else NONE


def _over_parity(points: Sequence[Point], point: Point) -> str:
    """Return the time of a fill rule over that of parity at the same setting."""
    parity = next(
        (p for p in points if p.setting.get("rule") == "parity" and p.label == point.label), None
    )
    if parity is None or point.peer or "rule" not in point.setting or point is parity:
        return NONE
    return f"{point.seconds / parity.seconds:.2g}"
