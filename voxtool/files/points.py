"""Points from files and answers to files, block by block: memory does not grow with their number.

A file of points is not trusted: what it declares is held against what is there, and no more than a
block of it is in memory.
"""

from __future__ import annotations

import ast
import io
import re
import shutil
import sys
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, VoxtoolError, count_of, one_line, printable
from voxtool.files import MESH_EXTENSIONS, format_of
from voxtool.files.atomic import atomic_path
from voxtool.files.streams import (
    STREAM,
    PathLike,
    input_name,
    open_stream,
    read_error,
    standard_output,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import DTypeLike

POINT_FORMATS = ("npy", "npz", "csv", "xyz", "ply")
BLOCK = 1 << 18  # points
TEXT_ROWS = 1 << 16  # lines that are in memory at once,
TEXT_LETTERS = 1 << 24  # unless they are long
LINE_LIMIT = 1 << 16  # letters
BLOCK_BYTES = 1 << 26  # of a PLY file's vertices, with all their properties

NPY_MAGIC, ZIP_MAGIC = b"\x93NUMPY", (b"PK\3\4", b"PK\5\6")
NPY_HEADER_LIMIT = 10_000  # bytes; those of points have 118
NPY_TYPE = re.compile(r"[<>|]?(f[48]|[iu][1248])")
NUMBER = re.compile(
    r"\s*[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)\s*", re.ASCII | re.IGNORECASE
)
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
PLY_HEADER_LINES = 1000


def read_points(
    path: PathLike, format: str | None = None, block: int = BLOCK
) -> Iterator[np.ndarray]:
    """Points of a file, in blocks; `-` reads stdin.

    The format is recognised by content, of text by its extension or by commas:

    - .npy, (N, 3) integers, float32 or float64, and .npz, of which the array `points` or the only
      one; not from a stream, as the contents of a .npz are listed at its end;
    - .csv: three columns, or those that a header line calls x, y and z;
    - .xyz: white space between columns, of which the first three count;
    - .ply: the vertices.

    In text, # begins a comment and blank lines do not count. NaN and infinity are numbers.

    Parameters
    ----------
    format : one of POINT_FORMATS instead of what the content says.
    block : points, at most, that a block has.

    Yields
    ------
    (k, 3) float64, 1 <= k <= block.

    Raises
    ------
    FileError : no such file, or it holds no points: names the line or the point. At the first
        block, unless what is wrong is further on.
    """
    name = input_name(path)
    if format not in (None, *POINT_FORMATS):
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(POINT_FORMATS)}")
    try:
        with open_stream(path) as (file, opening, size):
            if not opening:
                raise FileError(f"{name} is empty")
            try:
                yield from _blocks(file, size, format or _format(name, opening), block)
            except FileError as error:
                raise FileError(f"{name}: {error}") from error
    except OSError as error:
        raise read_error(name, error) from error


def _format(name: str, opening: bytes) -> str:
    """What a file is by its opening; text by its extension, or else "text"."""
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


def _blocks(file: BinaryIO, size: int | None, format: str, block: int) -> Iterator[np.ndarray]:
    if format == "npy":
        return _read_npy(file, size, block)
    if format == "npz":
        return _read_npz(file, size, block)
    if format == "ply":
        return _read_ply(file, size, block)
    return _read_text(file, format, block)


# --- .npy and .npz -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Npy:
    """What the header of a .npy file says.

    count : of points; fortran : whether all x come first, then all y; start : of the numbers.
    """

    dtype: np.dtype
    count: int
    fortran: bool
    start: int

    def bytes_of(self, points: int) -> int:
        return 3 * points * self.dtype.itemsize

    def check_size(self, size: int) -> None:
        """Refuse a file that is shorter than it says."""
        if self.start + self.bytes_of(self.count) > size:
            raise _cut_short(self.count, (size - self.start) // self.bytes_of(1))


def _read_npy(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    header = _npy_header(file)
    if size is not None:
        header.check_size(size)
    if not header.fortran:
        yield from _by_point(file, header, block)
    elif size is not None:
        yield from _by_axis([file] * 3, header, block)
    else:
        with tempfile.TemporaryFile() as whole:
            shutil.copyfileobj(file, whole, 1 << 20)
            header = replace(header, start=0)
            header.check_size(whole.tell())
            yield from _by_axis([whole] * 3, header, block)


def _read_npz(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    if size is None:
        raise FileError(
            "the contents of a .npz are listed at its end, and a stream is read from its "
            "beginning: save it to a file, or send .npy"
        )
    try:
        with zipfile.ZipFile(file) as packed, ExitStack() as stack:
            member = _points_member(packed)
            streams: list[Any] = [stack.enter_context(packed.open(member)) for _ in range(3)]
            header = _npy_header(streams[0])
            if header.fortran:
                for axis, stream in enumerate(streams):
                    start = header.start + axis * header.bytes_of(header.count) // 3
                    _pass_over(stream, start - stream.tell())
                yield from _by_axis(streams, header, block)
            else:
                yield from _by_point(streams[0], header, block)
    except (FileError, OSError):
        raise
    except Exception as error:  # damage shows in any of the library's errors
        raise FileError(f"damaged .npz: {one_line(error)}") from error


def _points_member(packed: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {member.filename.removesuffix(".npy"): member for member in packed.infolist()}
    if "points" not in members and len(members) != 1:
        names = printable(", ".join(members))[:80] or "nothing"
        raise FileError(f"holds {names}: call the array of points `points`")
    member = members.get("points") or next(iter(members.values()))
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FileError(
            f"is packed by method {member.compress_type}: write it with numpy.savez or "
            "numpy.savez_compressed"
        )
    return member


def _npy_header(file: BinaryIO) -> _Npy:
    opening = file.read(len(NPY_MAGIC) + 2)
    if not opening.startswith(NPY_MAGIC):
        raise FileError("is no .npy array: write it with numpy.save")
    width = {b"\1\0": 2, b"\2\0": 4}.get(opening[len(NPY_MAGIC) :])
    if width is None:
        raise FileError("is a .npy of a version that no array of numbers has: use numpy.save")
    length = int.from_bytes(file.read(width), "little")
    if length > NPY_HEADER_LIMIT:
        raise FileError(f"its header has {length} bytes: at most {NPY_HEADER_LIMIT} are read")
    try:
        found = ast.literal_eval(file.read(length).decode("ascii").strip())
        descr, shape, fortran = (found[key] for key in ("descr", "shape", "fortran_order"))
    except (SyntaxError, ValueError, TypeError, KeyError, MemoryError, RecursionError):
        raise FileError("its header is damaged: write it anew with numpy.save") from None
    if type(fortran) is not bool:
        raise FileError("its header is damaged: fortran_order is neither True nor False")
    if not isinstance(descr, str) or not NPY_TYPE.fullmatch(descr):
        shown = printable(descr)[:40]
        raise FileError(f"is an array of type {shown}: points are integers, float32 or float64")
    if not (_is_shape(shape) and len(shape) == 2 and shape[1] == 3):
        raise FileError(f"is an array of shape {printable(shape)[:60]}: points are (N, 3)")
    return _Npy(np.dtype(descr), shape[0], fortran, len(opening) + width + length)


def _is_shape(shape: object) -> bool:
    return isinstance(shape, tuple) and all(type(side) is int and side >= 0 for side in shape)


def _by_point(file: BinaryIO, header: _Npy, block: int) -> Iterator[np.ndarray]:
    """Blocks of points that are stored one after the other."""
    for first in range(0, header.count, block):
        count = min(block, header.count - first)
        data = file.read(header.bytes_of(count))
        if len(data) < header.bytes_of(count):
            raise _cut_short(header.count, first + len(data) // header.bytes_of(1))
        yield np.frombuffer(data, header.dtype).reshape(count, 3).astype(np.float64)


def _by_axis(files: list[BinaryIO], header: _Npy, block: int) -> Iterator[np.ndarray]:
    """Blocks of points whose x, y and z are apart; a file for each, which may be the same."""
    size = header.dtype.itemsize
    for first in range(0, header.count, block):
        count = min(block, header.count - first)
        points = np.empty((count, 3))
        for axis, file in enumerate(files):
            file.seek(header.start + (axis * header.count + first) * size)
            data = file.read(count * size)
            if len(data) < count * size:
                raise _cut_short(header.count, first + len(data) // size)
            points[:, axis] = np.frombuffer(data, header.dtype)
        yield points


def _pass_over(file: BinaryIO, size: int) -> None:
    """Read so many bytes, or what is left; in small pieces: what is packed would seek in large."""
    while size and (data := file.read(min(size, 1 << 16))):
        size -= len(data)


def _cut_short(declared: int, there: int) -> FileError:
    return FileError(
        f"is cut short: {there} of {count_of(declared, 'point')} are there: copy it anew"
    )


# --- text ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Columns:
    """How a line of text holds a point.

    delimiter : between columns, None for white space; places : of x, y and z, None where the line
    holds these three alone.
    """

    delimiter: str | None
    places: tuple[int, ...] | None


def _read_text(file: BinaryIO, format: str, block: int) -> Iterator[np.ndarray]:
    lines = _lines(file)
    first = next(lines, None)
    if first is None:
        return
    if format == "csv" or (format == "text" and "," in first[1]):
        columns, is_header = _csv_columns(*first)
    else:
        columns, is_header = _Columns(None, (0, 1, 2)), False
    yield from _by_line(lines if is_header else chain([first], lines), columns, block)


def _csv_columns(number: int, line: str) -> tuple[_Columns, bool]:
    """Where x, y and z are, and whether the first line is a header that says so."""
    words = line.split(",")
    if any(map(NUMBER.fullmatch, words)):
        return _Columns(",", None), False
    names = [word.strip().strip('"').lower() for word in words]
    if all(names.count(axis) == 1 for axis in "xyz"):
        return _Columns(",", tuple(map(names.index, "xyz"))), True
    if len(names) == 3 and not {*names} & {*"xyz"}:
        return _Columns(",", None), True
    raise FileError(f"line {number}: a header of other columns than x, y and z: name each once")


def _lines(file: BinaryIO, first: int = 1) -> Iterator[tuple[int, str]]:
    """The lines with their numbers, without comments, and without those that are blank then."""
    text = io.TextIOWrapper(file, "utf-8-sig", errors="replace")
    number = first
    while line := text.readline(LINE_LIMIT):
        if len(line) == LINE_LIMIT:
            raise FileError(f"line {number}: longer than {LINE_LIMIT} letters: no points of text")
        line = line.partition("#")[0]
        if line and not line.isspace():
            yield number, line
        number += 1


def _by_line(
    lines: Iterable[tuple[int, str]], columns: _Columns, block: int
) -> Iterator[np.ndarray]:
    """Blocks of points of a line each."""
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
        return points
    wrong = next(i for i, line in enumerate(lines) if _parsed([line], columns) is None)
    raise FileError(f"line {numbers[wrong]}: {_fault(lines[wrong], columns)}")


def _parsed(lines: list[str], columns: _Columns) -> np.ndarray | None:
    """(k, 3) float64, or None where a line does not hold a point."""
    try:
        points = np.loadtxt(
            lines, delimiter=columns.delimiter, usecols=columns.places, comments=None, ndmin=2
        )
    except ValueError:
        return None
    return points if points.shape[1] == 3 else None


def _fault(line: str, columns: _Columns) -> str:
    """What is wrong with a line that holds no point."""
    words = line.split(columns.delimiter)
    if columns.places is None and len(words) != 3:
        mend = ": name them in a header line" if len(words) > 3 else ""
        return f"{count_of(len(words), 'column')} where x,y,z are expected{mend}"
    places = columns.places or (0, 1, 2)
    if len(words) <= max(places):
        return f"{count_of(len(words), 'column')}, too few for x, y and z"
    wrong = next((p for p in places if not NUMBER.fullmatch(words[p])), places[0])
    word = words[wrong].strip()
    mend = ": columns with commas between them are .csv" if "," in word else ""
    return f"{printable(repr(word[:40]))} is no number{mend}"


# --- .ply ----------------------------------------------------------------------------------------


@dataclass
class _Element:
    """An element of a PLY file; the type of a property is None where it is a list."""

    name: str
    count: int
    properties: list[tuple[str, str | None]]

    @property
    def is_plain(self) -> bool:
        """Whether each has the same bytes, or words."""
        return all(kind for _, kind in self.properties)


def _read_ply(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    format, elements, lines, start = _ply_header(file)
    before, vertices = _up_to_vertices(elements)
    names = [name for name, _ in vertices.properties]
    for axis in "xyz":
        if names.count(axis) != 1:
            raise FileError(f"its vertices have {names.count(axis)} properties {axis}, not one")
    places = tuple(map(names.index, "xyz"))
    if format == "ascii":
        rows = _lines(file, lines + 1)
        skipped = sum(element.count for element in before)
        rows = islice(rows, skipped, skipped + vertices.count)
        blocks = _by_line(rows, _Columns(None, places), block)
    else:
        order = PLY_ORDERS[format]
        if not all(element.is_plain for element in before):
            raise FileError("a list comes before its vertices: write the vertices first")
        skipped = sum(element.count * _record(element, order).itemsize for element in before)
        record = _record(vertices, order)
        if size is not None and start + skipped + vertices.count * record.itemsize > size:
            raise _cut_short(vertices.count, max(size - start - skipped, 0) // record.itemsize)
        _pass_over(file, skipped)
        blocks = _by_record(file, record, places, vertices.count, block)
    count = 0
    for points in blocks:
        count += len(points)
        yield points
    if count < vertices.count:
        raise _cut_short(vertices.count, count)


def _ply_header(file: BinaryIO) -> tuple[str, list[_Element], int, int]:
    """The format, the elements, and the lines and bytes of the header."""
    line = file.readline(LINE_LIMIT)
    if line.split() != [b"ply"]:
        raise FileError("is no PLY file: its first line is not ply")
    format, elements, size = "", [], len(line)
    for number in range(2, PLY_HEADER_LINES + 1):
        line = file.readline(LINE_LIMIT)
        size += len(line)
        words = line.decode("ascii", "replace").split()
        match words:
            case ["end_header"] if format:
                return format, elements, number, size
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name == "ascii" or name in PLY_ORDERS:
                format = name
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,15}", count):
                elements.append(_Element(name, int(count), []))
            case ["property", kind, name] if kind in PLY_TYPES and elements:
                elements[-1].properties.append((name, PLY_TYPES[kind]))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, None))
            case _:
                shown = printable(" ".join(words))[:40]
                raise FileError(f"line {number}: {shown!r} does not belong in a PLY header")
    raise FileError(f"its header has no end within {PLY_HEADER_LINES} lines")


def _up_to_vertices(elements: list[_Element]) -> tuple[list[_Element], _Element]:
    for place, element in enumerate(elements):
        if element.name == "vertex":
            if not element.is_plain:
                raise FileError("its vertices have a list among their properties: leave it out")
            return elements[:place], element
    raise FileError("has no element vertex: points are its vertices")


def _record(element: _Element, order: str) -> np.dtype:
    return np.dtype([(f"{i}", f"{order}{kind}") for i, (_, kind) in enumerate(element.properties)])


def _by_record(
    file: BinaryIO, record: np.dtype, places: tuple[int, ...], count: int, block: int
) -> Iterator[np.ndarray]:
    """Blocks of the points of `count` records, as many as are there."""
    rows = min(block, max(BLOCK_BYTES // record.itemsize, 1))
    while count:
        data = file.read(min(rows, count) * record.itemsize)
        records = np.frombuffer(data, record, len(data) // record.itemsize)
        if not len(records):
            return
        count -= len(records)
        yield np.stack([records[f"{place}"].astype(np.float64) for place in places], axis=1)


# --- answers -------------------------------------------------------------------------------------


class Answers(ABC):
    """A table in a file, written block by block.

    text : whether it is fit for a terminal.
    columns : the name and the type of each.
    count : of the rows that have been written.
    """

    text: bool

    def __init__(self, file: BinaryIO, columns: Sequence[tuple[str, DTypeLike]]) -> None:
        self.file = file
        self.columns = [(name, np.dtype(kind)) for name, kind in columns]
        self.count = 0
        self._begin()

    def write(self, block: Mapping[str, Any] | Sequence[Any]) -> None:
        """Write k rows.

        Parameters
        ----------
        block : (k,) arrays by the names of the columns; or a list of arrays, (k,) for a column and
            (k, c) for c of them, in the order of the columns.

        Raises
        ------
        VoxtoolError : they are not the columns, or not of one length.
        OSError : the file cannot be written.
        """
        if isinstance(block, Mapping):
            block = [block[name] for name, _ in self.columns]
        parts = [part if part.ndim == 2 else part[:, None] for part in map(np.asarray, block)]
        values = [column for part in parts for column in part.T]
        if len(values) != len(self.columns) or len({len(column) for column in values}) != 1:
            raise VoxtoolError(
                f"answers of shapes {', '.join(str(part.shape) for part in parts)}: "
                f"{len(self.columns)} columns of one length are expected"
            )
        self._write(values)
        self.count += len(values[0])

    @abstractmethod
    def _begin(self) -> None:
        """Write what comes before the rows."""

    @abstractmethod
    def _write(self, values: list[np.ndarray]) -> None:
        """Write rows, of which each column is given."""

    @abstractmethod
    def end(self) -> None:
        """Write what is known only in the end."""


class NpyAnswers(Answers):
    """(N,) float64 where there is one column, (N, C) elsewhere. The header is written again when N
    is known: numpy pads it, so that its size does not depend on N."""

    text = False

    def _begin(self) -> None:
        more = (len(self.columns),) if len(self.columns) > 1 else ()
        header = {"descr": "<f8", "fortran_order": False, "shape": (self.count, *more)}
        np.lib.format.write_array_header_1_0(self.file, header)

    def _write(self, values: list[np.ndarray]) -> None:
        self.file.write(np.stack(values, axis=1).astype("<f8", "C").tobytes())

    def end(self) -> None:
        self.file.seek(0)
        self._begin()


class CsvAnswers(Answers):
    """A line of names, then a line a row: the shortest decimals that read back as the same number
    of the column's type, and integers for integers and bools."""

    text = True

    def _begin(self) -> None:
        self.file.write(",".join(name for name, _ in self.columns).encode() + b"\n")

    def end(self) -> None:
        pass

    def _write(self, values: list[np.ndarray]) -> None:
        for first in range(0, len(values[0]), TEXT_ROWS):
            words = [
                _words(column[first : first + TEXT_ROWS].astype(kind))
                for column, (_, kind) in zip(values, self.columns, strict=True)
            ]
            rows = map(",".join, zip(*words, strict=True))
            self.file.write("".join(f"{row}\n" for row in rows).encode())


def _words(column: np.ndarray) -> Iterable[str]:
    if column.dtype.kind != "f":
        return map(str, column.astype(np.int64).tolist())
    return map(str, column if column.dtype.itemsize < 8 else column.tolist())


ANSWER_FORMATS: dict[str, type[Answers]] = {"npy": NpyAnswers, "csv": CsvAnswers}


@contextmanager
def open_answers(
    path: PathLike,
    columns: Sequence[tuple[str, DTypeLike]],
    format: str | None = None,
    clobber: bool = True,
) -> Iterator[Answers]:
    """A table of answers for writing, as .npy or .csv; `-` writes stdout, as .csv to a terminal and
    else as .npy. It appears when the block ends, and not at all if it ends with an error.

    Parameters
    ----------
    columns : the name of each and its type, which decides the decimals of text; a .npy is float64.
    format : "npy" or "csv" instead of what the name says.
    clobber : False refuses an existing file.

    Raises
    ------
    FileError : the file cannot be written, or its name says no format.
    """
    if format is None:
        if path == STREAM:
            format = "csv" if sys.stdout.isatty() else "npy"
        else:
            format = format_of(path, ANSWER_FORMATS)
    if format not in ANSWER_FORMATS:
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(ANSWER_FORMATS)}")
    kind = ANSWER_FORMATS[format]
    with ExitStack() as stack:
        if path == STREAM:
            file = stack.enter_context(standard_output(kind.text))
        else:
            temporary = stack.enter_context(atomic_path(path, clobber))
            file = stack.enter_context(open(temporary, "w+b"))
        answers = kind(file, columns)
        yield answers
        answers.end()
