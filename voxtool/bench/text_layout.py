"""The tables of `voxtool bench texts`: a line for the source and one for voxtool, or for each way,
under each of which the settings stand side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from voxtool.bench.text_rows import HARDWARE, SOURCES, TITLES, Row

K = TypeVar("K")
TEXT, VOXTOOL = "text", "voxtool"
WIDTH = 100
READING = (
    "Each table has the figures of a text and, below, those of voxtool on the models of this call. "
    "Where a text has no figure, the lines below the table quote it, translated and shortened. "
    "Times are of different machines: compare how they grow from column to column. "
    "Figures with a * have a note. ± is the slowest run minus the fastest, over the median."
)


@dataclass(frozen=True)
class Line:
    """The figures of a text, or of voxtool, in the order of the settings."""

    name: str
    figures: tuple[str, ...]


@dataclass(frozen=True)
class Group:
    """A quantity that is measured, and its lines."""

    what: str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Part:
    """A table: the models, the settings, and a group for each thing that is measured."""

    models: str
    settings: tuple[str, ...]
    groups: tuple[Group, ...]


@dataclass(frozen=True)
class Section:
    """A table or section of a text: its parts, and words on what is measured."""

    title: str
    source: str
    parts: tuple[Part, ...]
    words: tuple[str, ...]


def sections(rows: Iterable[Row]) -> list[Section]:
    """Return a section for each table, in the order of TITLES."""
    by_table = _by(rows, lambda row: row.table)
    return [
        Section(f"{table}: {title}", source(some[0].key), tuple(_parts(some)), tuple(_words(some)))
        for table, title in TITLES.items()
        if (some := by_table.get(table))
    ]


def source(key: str) -> str:
    """Return a source and its hardware."""
    return f"{key} {SOURCES[key]}; {HARDWARE[key]}"


def _by(rows: Iterable[Row], key: Callable[[Row], K]) -> dict[K, list[Row]]:
    found: dict[K, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return found


def _parts(rows: Sequence[Row]) -> Iterator[Part]:
    """Yield the parts of a section: what has the same models and settings stands in one table."""
    alike: dict[tuple[str, tuple[str, ...]], list[Group]] = {}
    for some in _by(rows, lambda row: (row.text_model, row.model, row.what, row.unit)).values():
        settings = tuple(dict.fromkeys(row.setting for row in some))
        models = some[0].model
        if some[0].text_model:
            models = f"text: {some[0].text_model}; voxtool: {models}"
        if lines := tuple(_lines(some, settings)):
            unit = f", {some[0].unit}" if some[0].unit else ""
            alike.setdefault((models, settings), []).append(Group(some[0].what + unit, lines))
    for (models, settings), groups in alike.items():
        yield Part(models, settings, tuple(groups))


def _lines(rows: Sequence[Row], settings: Sequence[str]) -> Iterator[Line]:
    printed = {row.setting: _figure(row.text, row.note) for row in rows if row.text is not None}
    if printed:
        yield Line(TEXT, tuple(printed.get(setting, "-") for setting in settings))
    for way, some in _by(rows, lambda row: row.way).items():
        ours = {
            row.setting: _figure(row.voxtool, spread=row.spread)
            for row in some
            if row.voxtool is not None
        }
        if ours:
            yield Line(way or VOXTOOL, tuple(ours.get(setting, "-") for setting in settings))


def _figure(number: float, note: str = "", spread: float | None = None) -> str:
    whole = number == int(number) or abs(number) >= 1000
    text = (f"{number:,.0f}" if whole else f"{number:.4g}") + "*" * bool(note)
    return text if spread is None else f"{text} ±{100 * spread:.0f} %"


def _words(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what a text states, what our figures mean, and the notes; equal words once."""
    said: dict[tuple[str, str], dict[str, None]] = {}  # what they are about, by who and words
    for (what, way), some in _by(rows, lambda row: (row.what, row.way)).items():
        own = _by(some, lambda row: row.ours)
        words = [(TEXT, row.statement) for row in some]
        for ours, these in own.items():
            where = (
                "" if len(own) == 1 else f"{', '.join(dict.fromkeys(r.setting for r in these))}: "
            )
            words.append((way or VOXTOOL, f"{where}{ours}" if ours else ""))
        words += [("*", f"{r.text_model.split(',')[0]} {r.setting}: {r.note}".strip(" :"))
                  for r in some if r.note]  # fmt: skip
        for who, each in words:
            if each:
                said.setdefault((who, each), {})[what] = None
    every = tuple(dict.fromkeys(row.what for row in rows))
    merged: dict[tuple[tuple[str, ...], str], list[str]] = {}
    for (who, each), whats in said.items():
        merged.setdefault((tuple(whats), each), []).append(who)
    for (whats, each), whos in merged.items():
        about = "" if whats == every and len(every) > 1 else f"{'; '.join(whats)}, "
        yield f"{about}{', '.join(whos)}: {each}".replace(", *:", "*:")


def as_text(found: Sequence[Section], keys: Iterable[str]) -> Iterator[str]:
    """Yield the lines of the sections, for a terminal."""
    for words in (READING, *map(source, keys)):
        yield ""
        yield from textwrap.wrap(words, WIDTH)
    for section in found:
        yield ""
        yield section.title
        for part in section.parts:
            yield ""
            yield from textwrap.wrap(
                part.models, WIDTH, initial_indent="  ", subsequent_indent="    "
            )
            yield from _table(part)
        yield ""
        for words in section.words:
            yield from textwrap.wrap(words, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _table(part: Part) -> Iterator[str]:
    rows = [("", "", part.settings)]
    for group in part.groups:
        for i, line in enumerate(group.lines):
            rows.append(("" if i else group.what, line.name, line.figures))
    first, second = (max(len(row[i]) for row in rows) for i in (0, 1))
    widths = [max(map(len, column)) for column in zip(*(row[2] for row in rows), strict=True)]
    for what, name, figures in rows:
        cells = "  ".join(f"{f:>{width}}" for f, width in zip(figures, widths, strict=True))
        if cells.strip():
            yield f"    {what:<{first}}  {name:<{second}}  {cells}".rstrip()
