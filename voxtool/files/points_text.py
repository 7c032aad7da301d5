"""Points in text: one a line, with commas or white space between the columns."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import FileError, count_of, printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

TEXT_ROWS = 1 << 16  # lines that are in memory at once,
TEXT_LETTERS = 1 << 24  # unless they are long
LINE_LIMIT = 1 << 16  # letters
NUMBER = re.compile(
    r"\s*[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)\s*", re.ASCII | re.IGNORECASE
)


def cut_short(declared: int, there: int) -> FileError:
    """The error of a file that has fewer points than it declares."""
    return FileError(
        f"is cut short: {there} of {count_of(declared, 'point')} are there: copy it anew"
    )


@dataclass(frozen=True)
class Columns:
    """The columns of a line of text that hold a point.

    delimiter : between columns; None for white space.
    places : columns of x, y and z; None where a line has these three only.
    """

    delimiter: str | None
    places: tuple[int, ...] | None


def read_text(file: BinaryIO, format: str, block: int) -> Iterator[np.ndarray]:
    """Yield the points of a text file, in blocks of (k, 3) float64."""
    lines = lines_of(file)
    first = next(lines, None)
    if first is None:
        return
    if format == "csv" or (format == "text" and "," in first[1]):
        columns, is_header = _csv_columns(*first)
    else:
        columns, is_header = Columns(None, (0, 1, 2)), False
    yield from by_line(lines if is_header else chain([first], lines), columns, block)


def _csv_columns(number: int, line: str) -> tuple[Columns, bool]:
    """The columns of x, y and z, and whether the first line is a header."""
    words = line.split(",")
    if any(map(NUMBER.fullmatch, words)):
        return Columns(",", None), False
    names = [word.strip().strip('"').lower() for word in words]
    if all(names.count(axis) == 1 for axis in "xyz"):
        return Columns(",", tuple(map(names.index, "xyz"))), True
    if len(names) == 3 and not {*names} & {*"xyz"}:
        return Columns(",", None), True
    raise FileError(f"line {number}: a header of other columns than x, y and z: name each once")


def lines_of(file: BinaryIO, first: int = 1) -> Iterator[tuple[int, str]]:
    """Yield numbered lines, without comments and blank lines."""
    text = io.TextIOWrapper(file, "utf-8-sig", errors="replace")
    number = first
    while line := text.readline(LINE_LIMIT):
        if len(line) == LINE_LIMIT:
            raise FileError(f"line {number}: longer than {LINE_LIMIT} letters: no points of text")
        line = line.partition("#")[0]
        if line and not line.isspace():
            yield number, line
        number += 1


def by_line(lines: Iterable[tuple[int, str]], columns: Columns, block: int) -> Iterator[np.ndarray]:
    """Yield the points of lines, in blocks."""
    numbers: list[int] = []
    texts: list[str] = []
    letters = 0
    for number, line in lines:
        numbers.append(number)
        texts.append(line)
        letters += len(line)
        if len(texts) == min(block, TEXT_ROWS) or letters > TEXT_LETTERS:
            yield _points_of(numbers, texts, columns)
            numbers, texts, letters = [], [], 0
    if texts:
        yield _points_of(numbers, texts, columns)


def _points_of(numbers: list[int], lines: list[str], columns: Columns) -> np.ndarray:
    points = _parsed(lines, columns)
    if points is not None:
        return points
    wrong = next(i for i, line in enumerate(lines) if _parsed([line], columns) is None)
    raise FileError(f"line {numbers[wrong]}: {_fault(lines[wrong], columns)}")


def _parsed(lines: list[str], columns: Columns) -> np.ndarray | None:
    """(k, 3) float64, or None where a line does not hold a point."""
    try:
        points = np.loadtxt(
            lines, delimiter=columns.delimiter, usecols=columns.places, comments=None, ndmin=2
        )
    except ValueError:
        return None
    return points if points.shape[1] == 3 else None


def _fault(line: str, columns: Columns) -> str:
    """The reason why a line holds no point."""
    words = line.split(columns.delimiter)
    if columns.places is None and len(words) != 3:
        hint = ": name them in a header line" if len(words) > 3 else ""
        return f"{count_of(len(words), 'column')} where x,y,z are expected{hint}"
    places = columns.places or (0, 1, 2)
    if len(words) <= max(places):
        return f"{count_of(len(words), 'column')}, too few for x, y and z"
    wrong = next((p for p in places if not NUMBER.fullmatch(words[p])), places[0])
    word = words[wrong].strip()
    hint = ": columns with commas between them are .csv" if "," in word else ""
    return f"{printable(repr(word[:40]))} is no number{hint}"
