"""Lines of numbers to arrays, a million numbers in a tenth of a second; and polygons to fans.

The text readers of meshes share these: a block of lines, the rows of numbers in it, and the
vertices and triangles that rows hold.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np

from voxtool.errors import MeshError, shown

BLOCK_BYTES = 1 << 19  # bytes of text that is parsed at once: beyond that, caches overflow
LETTERS = b"0123456789+-.eE \t\r\n"  # of numbers and between them
NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"  # a pattern
MOST_LINE = 1 << 24  # letters of a line, two million corners of a face
SPLIT_FACE = "split its face into smaller ones"
WORD = re.compile(rb"[^ \t\r]+")
SPACE, NEWLINE, POINT, MINUS = b" \n.-"
EIGHT = 8  # digits, which a uint64 holds as letters
MOST_DIGITS = 15  # of a number below 2**53, so that float64 holds it
TENS = 10 ** np.arange(MOST_DIGITS + 1, dtype=np.uint64)  # float64 holds them, too
# By how many of the last of eight letters are digits: their values, of which each is four bits.
VALUES = np.array([0x0F0F0F0F0F0F0F0F << 8 * (8 - n) & (1 << 64) - 1 for n in range(9)], np.uint64)
THREADS = 2  # that parse blocks; more would wait for the interpreter's lock
_alone = threading.Lock()  # fromstring holds the interpreter's lock; filters are for all threads

Parsed = TypeVar("Parsed")


class OddityError(Exception):
    """Raised for a text that is not numbers alone."""


def check_lines(name: str, data: bytes, ends: bytes = b"\n") -> None:
    """Raise MeshError if a line, which one of `ends` ends, has more than MOST_LINE letters: while
    it is parsed it would take thirty times its size."""
    start = 0
    while len(data) - start > MOST_LINE:
        last = max(data.rfind(end, start, start + MOST_LINE) for end in ends.split(b" "))
        if last < 0:
            raise MeshError(f"{name}: a line of more than {MOST_LINE >> 20} MiB: {SPLIT_FACE}")
        start = last + 1


def blocks_of(data: bytes, start: int = 0, size: int = BLOCK_BYTES) -> Iterator[bytes]:
    """Yield a text from a place on, in blocks of whole lines of about `size` bytes; the last line
    may have no end."""
    while start < len(data):
        end = data.find(b"\n", start + size) + 1 or len(data)
        yield data[start:end]
        start = end


def beside(parse: Callable[[bytes], Parsed], blocks: Iterable[bytes]) -> Iterator[Parsed]:
    """Yield what `parse` returns for each block, in order; threads parse a few at a time, because
    numpy's work on arrays does not hold the interpreter's lock."""
    with ThreadPoolExecutor(THREADS) as threads:
        begun: deque[Future[Parsed]] = deque()
        for block in blocks:
            begun.append(threads.submit(parse, block))
            if len(begun) > 2 * THREADS:
                yield begun.popleft().result()
        while begun:
            yield begun.popleft().result()


def numbers_in(words: np.ndarray, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of a text, (N,), and the places where they begin, (N,) int64.

    Parameters
    ----------
    words : (letters,) uint8, all among LETTERS.
    dtype : np.float64 or np.int64.
    """
    if (plain := _decimals_in(words, dtype)) is not None:
        return plain
    letter = words > SPACE
    letter[1:] &= words[:-1] <= SPACE
    begins = np.flatnonzero(letter)
    with _alone, warnings.catch_warnings():
        # Older numpy warns of text that is no number. The filter holds in all threads, of which one
        # may open the device and warn of that, so it is for this category alone.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers = np.fromstring(words.tobytes(), dtype, sep=" ") if len(begins) else begins
        except (DeprecationWarning, ValueError, OverflowError):
            raise OddityError from None
    if len(numbers) != len(begins):
        raise OddityError
    return numbers.astype(dtype, copy=False), begins


def _decimals_in(words: np.ndarray, dtype: type) -> tuple[np.ndarray, np.ndarray] | None:
    """Return numbers_in of a text of whole numbers alone, such as -7, or of decimals alone, such as
    12.50, of at most MOST_DIGITS digits; None for others.

    Eight digits become a number by three multiplications [Lemire 2021]. The quotient of a whole
    number and a power of ten, both of which float64 holds, is the float64 nearest to the decimal.
    """
    letters = np.zeros(EIGHT + len(words) + 1, np.uint8)  # blank at both ends
    letters[EIGHT:-1] = words
    digit = letters[EIGHT - 1 :] - np.uint8(ord("0")) < 10
    bounds = np.flatnonzero(digit[1:] != digit[:-1])
    starts, ends = bounds[::2], bounds[1::2]  # of runs of digits
    lengths = ends - starts
    points = np.count_nonzero(words == POINT)
    step = 2 if points else 1  # runs of a number
    first, after = starts[::step], ends[::step]
    minus = letters[first + (EIGHT - 1)] == MINUS
    begins = first - minus
    if (
        lengths.sum() + points + np.count_nonzero(minus) != np.count_nonzero(words > SPACE)
        or (letters[begins + (EIGHT - 1)] > SPACE).any()
        or lengths.max(initial=0) > MOST_DIGITS
    ):
        return None
    numbers = _values_of(letters, ends, lengths)
    if not points:
        found = numbers.astype(dtype)
    else:
        places = lengths[1::2]
        if (
            dtype is not np.float64
            or len(first) != points
            or len(places) != points
            or not (letters[after + EIGHT] == POINT).all()
            or (starts[1::2] != after + 1).any()
            or (lengths[::2] + places).max() > MOST_DIGITS
        ):
            return None
        found = (numbers[::2] * TENS[places] + numbers[1::2]).astype(np.float64)
        found /= TENS[places]
    np.negative(found, out=found, where=minus)
    return found, begins


def _values_of(letters: np.ndarray, ends: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the numbers, (n,) uint64, of runs of at most 16 digits that end EIGHT letters after
    `ends`."""
    last = np.ndarray(len(letters) - EIGHT + 1, "<u8", letters, strides=(1,))[ends]
    last &= VALUES[np.minimum(lengths, EIGHT)]
    for factor, shift, kept in (
        (1 + (10 << 8), 8, 0x00FF00FF00FF00FF),  # pairs of digits
        (1 + (100 << 16), 16, 0x0000FFFF0000FFFF),  # pairs of those
        (1 + (10000 << 32), 32, 0xFFFFFFFF),
    ):
        last *= np.uint64(factor)
        last >>= np.uint64(shift)
        last &= np.uint64(kept)
    long = np.flatnonzero(lengths > EIGHT)
    if len(long):
        last[long] += TENS[EIGHT] * _values_of(letters, ends[long] - EIGHT, lengths[long] - EIGHT)
    return last


def by_line(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first number of each line and how many it has, (L,) int64 each, from the places
    where numbers begin and lines end."""
    each, rest = divmod(len(begins), max(len(ends), 1))
    if each and not rest:  # as many on each line, as in most files
        lines = begins.reshape(-1, each)
        if (lines[:, -1] < ends).all() and (lines[1:, 0] >= ends[:-1]).all():
            return each * np.arange(len(ends)), np.full(len(ends), each)
    upto = np.searchsorted(begins, ends)
    counts = np.diff(upto, prepend=0)
    return upto - counts, counts


def fans(corners: np.ndarray, first: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return polygons as fans of triangles, (F, 3): polygon i has counts[i] corners, from
    corners[first[i]] on."""
    if (counts == 3).all():
        return corners[first[:, None] + np.arange(3)]
    triangles = np.maximum(counts - 2, 0)
    centre = np.repeat(first, triangles)
    nth = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return corners[np.stack([centre, centre + nth + 1, centre + nth + 2], axis=1)]


class Rows(NamedTuple):
    """The lines of a text that hold numbers: these, (N,) float64; and of each line the first, their
    count, and the number of the line, (L,) int64 each."""

    numbers: np.ndarray
    first: np.ndarray
    counts: np.ndarray
    lines: np.ndarray

    def part(self, begin: int, end: int) -> Rows:
        """Return the rows from one to another."""
        return Rows(self.numbers, *(each[begin:end] for each in self[1:]))


def rows_in(name: str, block: bytes, line: int) -> Rows:
    """Return the rows of a block whose first line has the number `line`; MeshError names the line
    of a word that is no number."""
    block = block if block.endswith(b"\n") else block + b"\n"
    words = np.frombuffer(block, np.uint8)
    try:
        if block.translate(None, LETTERS):
            raise OddityError
        numbers, begins = numbers_in(words, np.float64)
    except OddityError:
        texts = enumerate(block.split(b"\n"), line)
        found = ((n, word) for n, text in texts for word in WORD.findall(text))
        line, word = next((n, word) for n, word in found if not re.fullmatch(NUMBER, word))
        raise MeshError(f"{name}, line {line}: {shown(word)} is not a number: correct it") from None
    first, counts = by_line(begins, np.flatnonzero(words == NEWLINE))
    some = np.flatnonzero(counts)
    return Rows(numbers, first[some], counts[some], line + some)


def vertices_in(name: str, rows: Rows, axes: tuple[int, ...] = (0, 1, 2)) -> np.ndarray:
    """Return the (V, 3) vertices of rows whose numbers at `axes` are x, y and z."""
    short = np.flatnonzero(rows.counts <= max(axes))
    if len(short):
        raise MeshError(
            f"{name}, line {rows.lines[short[0]]}: a vertex of {rows.counts[short[0]]} numbers "
            f"where {max(axes) + 1} are needed: correct it, or the file is truncated"
        )
    return rows.numbers[rows.first[:, None] + np.array(axes)]


def triangles_in(name: str, vertices: int, rows: Rows) -> np.ndarray:
    """Return the (F, 3) int64 triangles of rows: each row is a polygon's number of corners and
    its corners, which count from 0 and are less than `vertices`."""
    sides = rows.numbers[rows.first]
    short = np.flatnonzero(~((sides >= 0) & (sides < rows.counts) & (sides == np.floor(sides))))
    if len(short):
        raise MeshError(
            f"{name}, line {rows.lines[short[0]]}: a face of {sides[short[0]]:g} vertices names "
            f"{rows.counts[short[0]] - 1}: correct it, or the file is truncated"
        )
    sides = sides.astype(np.int64)
    corners = fans(rows.numbers, rows.first + 1, sides)
    wrong = ~((corners >= 0) & (corners < vertices) & (corners == np.floor(corners)))
    if wrong.any():
        face = int(np.argmax(wrong.any(axis=1)))
        line = np.repeat(rows.lines, np.maximum(sides - 2, 0))[face]
        raise MeshError(
            f"{name}, line {line}: the face names vertex {corners[face][wrong[face]][0]:g} where "
            f"there are {vertices:,}, counted from 0: correct the index, or the file is truncated"
        )
    return corners.astype(np.int64)
