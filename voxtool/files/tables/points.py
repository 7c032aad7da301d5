"""Points from files, block by block: a file may be larger than memory.

A file is not trusted: the sizes that it declares are compared with its bytes, pickles are never
loaded, and at most one block is in memory.
"""

from __future__ import annotations

import io
import re
import tempfile
import warnings
import zipfile
from contextlib import contextmanager
from itertools import chain, islice, takewhile
from math import isinf
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from voxtool.arrays import float64
from voxtool.errors import FileError, MemoryLimitError, count_of, printable
from voxtool.files.formats import MESH_EXTENSIONS
from voxtool.files.meshes import ply
from voxtool.files.meshes.ply import LINE_LIMIT
from voxtool.files.storage.streams import PathLike, input_name, open_stream, read_error
from voxtool.files.storage.unpacked import check_unpacked, open_entry, open_zip
from voxtool.memory import check_disk

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

POINT_FORMATS = ("npy", "npz", "csv", "xyz", "ply")
POINTS_AT_ONCE = 1 << 18
NPY_MAGIC, ZIP_MAGIC = b"\x93NUMPY", (b"PK\3\4", b"PK\5\6")
NPY_VERSION = (1, 0)  # the only one that numbers need; its header has at most 64 KiB
TEXT_ROWS = 1 << 16  # lines that are in memory at once,
TEXT_LETTERS = 1 << 24  # unless they are long
NUMBER = re.compile(
    r"\s*[+-]?((\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)\s*", re.ASCII | re.IGNORECASE
)
RECORD_BYTES = 1 << 26  # bytes of a PLY file's vertices that are in memory at once


def read_points(
    path: PathLike, format: str | None = None, block: int = POINTS_AT_ONCE
) -> Iterator[np.ndarray]:
    """Yield the points of a file, in (k, 3) float64 blocks, 1 <= k <= block; `-` reads stdin.

    The format is recognised by content; of text by the extension, or by commas:

    - .npy, (N, 3) integers, float32 or float64, and .npz, of which the array `points` or the only
      one; a .npz cannot be a stream;
    - .csv: three columns, or those that a header line calls x, y and z;
    - .xyz: white space between columns, of which the first three count;
    - .ply: the vertices.

    In text, # begins a comment, and blank lines do not count. NaN and infinity are numbers.

    Raises
    ------
    FileError : no such file, or it holds no points; the message names the line or the point.
    """
    name = input_name(path)
    if format not in (None, *POINT_FORMATS):
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(POINT_FORMATS)}")
    try:
        with open_stream(path) as (file, opening, size):
            if not opening:
                raise FileError(f"{name} is empty")
            try:
                format = format or _format(name, opening)
                if format in READERS:
                    yield from READERS[format](file, size, block)
                else:
                    yield from _read_text(file, format, block)
            except (FileError, MemoryLimitError) as error:
                raise type(error)(f"{name}: {error}") from error
    except OSError as error:
        raise read_error(name, error) from error


def _format(name: str, opening: bytes) -> str:
    """Return the format of a file by its opening; text by its extension, or else "text"."""
    if opening.startswith(NPY_MAGIC):
        return "npy"
    if opening.startswith(ZIP_MAGIC):
        return "npz"
    if opening.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if b"\0" in opening or opening.startswith((b"\x89", b"\x1f\x8b")):
        raise FileError("holds no points: expected .npy, .npz, .csv, .xyz or .ply")
    extension = name.lower().rpartition(".")[2]
    if f".{extension}" in MESH_EXTENSIONS and extension not in POINT_FORMATS:
        raise FileError("is a mesh: expected points, .npy, .npz, .csv, .xyz or .ply")
    return extension if extension in ("csv", "xyz") else "text"


def _cut_short(declared: int, there: int) -> FileError:
    """Return the error of a file that has fewer points than it declares."""
    points = count_of(declared, "point")
    return FileError(f"is cut short: {there:,} of {points} are there: copy it anew")


# --- .npy and .npz -------------------------------------------------------------------------------


def _read_npy(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    count, in_columns, dtype = _npy_header(file)
    row = 3 * dtype.itemsize

    def check(there: int) -> None:
        if there < count * row:
            whole = max(there // dtype.itemsize - 2 * count, 0) if in_columns else there // row
            raise _cut_short(count, whole)

    if size is not None:
        check(size - file.tell())
    if in_columns and count:
        with _on_disk(file, count * row) as (whole, there):
            check(there)
            for first in range(0, count, block):
                columns = []
                for axis in range(3):
                    whole.seek((axis * count + first) * dtype.itemsize)
                    data = whole.read(min(block, count - first) * dtype.itemsize)
                    columns.append(float64(np.frombuffer(data, dtype)))
                yield np.stack(columns, axis=1)
        return
    for first in range(0, count, block):
        rows = min(block, count - first)
        data = file.read(rows * row)
        if len(data) < rows * row:
            raise _cut_short(count, first + len(data) // row)
        yield float64(np.frombuffer(data, dtype).reshape(rows, 3))


def _npy_header(file: BinaryIO) -> tuple[int, bool, np.dtype]:
    """Return the number of points, whether all x come first, then all y, and the type of the
    numbers."""
    try:
        if np.lib.format.read_magic(file) != NPY_VERSION:
            raise ValueError
        with warnings.catch_warnings():
            # of arrays that Python 2 wrote; another thread may warn of the device
            warnings.filterwarnings("ignore", ".* created on Python 2", UserWarning)
            shape, in_columns, dtype = np.lib.format.read_array_header_1_0(file)
    except (OSError, FileError):
        raise
    except Exception:  # damage shows in many ways
        raise FileError(
            "is no .npy array, or its header is damaged: write it with numpy.save"
        ) from None
    if dtype.kind not in "iuf" or dtype.str[1:] in ("f2", "f12", "f16"):
        raise FileError(f"is an array of type {dtype.str}: points are integers, float32 or float64")
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 0:
        raise FileError(f"is an array of shape {printable(shape)[:60]}: points are (N, 3)")
    return shape[0], in_columns, dtype


@contextmanager
def _on_disk(file: BinaryIO, size: int) -> Iterator[tuple[BinaryIO, int]]:
    """Yield a temporary file of the next `size` bytes of another, and how many there are."""
    check_disk(tempfile.gettempdir(), size, "store the points one after the other (C order)")
    with tempfile.TemporaryFile() as whole:
        left = size
        while left and (data := file.read(min(left, 1 << 16))):
            whole.write(data)
            left -= len(data)
        whole.flush()
        yield whole, size - left  # pyright: ignore[reportReturnType]


def _read_npz(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    if size is None:
        raise FileError(
            "the contents of a .npz are listed at its end, and a stream is read from its "
            "beginning: save it to a file, or send .npy"
        )
    with open_zip(file) as packed:
        found = _points_member(packed)
        check_unpacked(found.file_size, size)
        with open_entry(packed, found) as member:
            yield from _read_npy(member, found.file_size, block)  # pyright: ignore


def _points_member(packed: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {member.filename.removesuffix(".npy"): member for member in packed.infolist()}
    if "points" not in members and len(members) != 1:
        names = printable(", ".join(members))[:80] or "nothing"
        raise FileError(f"holds {names}: call the array of points `points`")
    return members.get("points") or next(iter(members.values()))


# --- text ----------------------------------------------------------------------------------------


class _Columns(NamedTuple):
    """The columns of a line of text that hold a point."""

    delimiter: str | None  # None: white space
    places: tuple[int, ...] | None  # of x, y and z; None: a line has these three only


def _read_text(file: BinaryIO, format: str, block: int) -> Iterator[np.ndarray]:
    """Yield the points of a text file, in blocks of (k, 3) float64."""
    lines = _lines_of(file)
    first = next(lines, None)
    if first is None:
        return
    if format == "csv" or (format == "text" and "," in first[1]):
        columns, is_header = _csv_columns(*first)
    else:
        columns, is_header = _Columns(None, (0, 1, 2)), False
    yield from _by_line(lines if is_header else chain([first], lines), columns, block)


def _csv_columns(number: int, line: str) -> tuple[_Columns, bool]:
    """Return the columns of x, y and z, and whether the first line is a header."""
    words = line.split(",")
    if any(map(NUMBER.fullmatch, words)):
        return _Columns(",", None), False
    names = [word.strip().strip('"').lower() for word in words]
    if all(names.count(axis) == 1 for axis in "xyz"):
        return _Columns(",", tuple(map(names.index, "xyz"))), True
    if len(names) == 3 and not {*names} & {*"xyz"}:
        return _Columns(",", None), True
    raise FileError(f"line {number}: a header of other columns than x, y and z: name each once")


def _lines_of(file: BinaryIO, first: int = 1) -> Iterator[tuple[int, str]]:
    """Yield numbered lines, without comments and blank lines."""
    text = io.TextIOWrapper(file, "utf-8-sig", errors="replace")
    number = first
    try:
        while line := text.readline(LINE_LIMIT):
            if len(line) == LINE_LIMIT:
                raise FileError(
                    f"line {number}: longer than {LINE_LIMIT} letters: no points of text"
                )
            line = line.partition("#")[0]
            if line and not line.isspace():
                yield number, line
            number += 1
    finally:
        if not file.closed:  # by who opened it: without this, `text` would close it
            text.detach()


def _by_line(
    lines: Iterable[tuple[int, str]], columns: _Columns, block: int
) -> Iterator[np.ndarray]:
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


def _points_of(numbers: list[int], lines: list[str], columns: _Columns) -> np.ndarray:
    points = _parsed(lines, columns)
    if points is not None:
        for row in np.flatnonzero(np.isinf(points).any(axis=1)).tolist():
            _refuse_overflow(numbers[row], lines[row], columns)
        return points
    wrong = next(i for i, line in enumerate(lines) if _parsed([line], columns) is None)
    raise FileError(f"line {numbers[wrong]}: {_fault(lines[wrong], columns)}")


def _refuse_overflow(number: int, line: str, columns: _Columns) -> None:
    """Raise FileError if a coordinate is infinite since float64 does not hold its number."""
    words = line.split(columns.delimiter)
    for word in (words[place].strip() for place in columns.places or (0, 1, 2)):
        if isinf(float(word)) and "n" not in word.lower():  # inf has one
            raise FileError(f"line {number}: {printable(word)[:40]!r} is beyond float64")


def _parsed(lines: list[str], columns: _Columns) -> np.ndarray | None:
    """Return (k, 3) float64, or None where a line does not hold a point."""
    try:
        delimiter, places = columns
        points = np.loadtxt(lines, delimiter=delimiter, usecols=places, comments=None, ndmin=2)
    except ValueError:
        return None
    return points if points.shape[1] == 3 else None


def _fault(line: str, columns: _Columns) -> str:
    """Return the reason why a line holds no point."""
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


# --- .ply ----------------------------------------------------------------------------------------


def _read_ply(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    """Yield the vertices of a PLY file, in blocks of (k, 3) float64."""
    format, elements, lines, start = ply.read_header(file)
    before = list(takewhile(lambda element: element.name != "vertex", elements))
    if len(before) == len(elements):
        raise FileError("has no element vertex: points are its vertices")
    vertices = elements[len(before)]
    order = ply.ORDERS.get(format, "=")
    record, places = vertices.record(order, ply.LISTED_VERTEX), vertices.axes()
    if format == "ascii":
        skipped = sum(element.count for element in before)
        rows = islice(_lines_of(file, lines + 1), skipped, skipped + vertices.count)
        blocks = _by_line(rows, _Columns(None, places), block)
    else:
        fault = "a list comes before its vertices: write the vertices first"
        skipped = sum(e.count * e.record(order, fault).itemsize for e in before)
        if size is not None and start + skipped + vertices.count * record.itemsize > size:
            raise _cut_short(vertices.count, max(size - start - skipped, 0) // record.itemsize)
        while skipped and (data := file.read(min(skipped, LINE_LIMIT))):
            skipped -= len(data)
        blocks = _by_record(file, record, places, vertices.count, block)
    count = 0
    for points in blocks:
        count += len(points)
        yield points
    if count < vertices.count:
        raise _cut_short(vertices.count, count)


def _by_record(
    file: BinaryIO, record: np.dtype, places: tuple[int, ...], count: int, block: int
) -> Iterator[np.ndarray]:
    """Yield the points of at most `count` records, in blocks."""
    rows = min(block, max(RECORD_BYTES // record.itemsize, 1))
    while count:
        data = file.read(min(rows, count) * record.itemsize)
        records = np.frombuffer(data, record, len(data) // record.itemsize)
        if not len(records):
            return
        count -= len(records)
        yield np.stack([float64(records[f"{place}"]) for place in places], axis=1)


READERS = {"npy": _read_npy, "npz": _read_npz, "ply": _read_ply}
