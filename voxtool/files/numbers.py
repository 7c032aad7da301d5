"""Lines of numbers to arrays, a million numbers in a tenth of a second; and polygons to fans."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

BLOCK_BYTES = 1 << 21  # of text that is parsed at once: beyond that, caches overflow
LETTERS = b"0123456789+-.eE \t\r\n"  # of numbers and between them
NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"  # a pattern
SPACE, NEWLINE = ord(" "), ord("\n")


class OddityError(Exception):
    """Raised for a text that is not numbers alone."""


def blocks_of(data: bytes, start: int = 0, size: int = BLOCK_BYTES) -> Iterator[bytes]:
    """Yield a text from a place on, in blocks of whole lines of about `size` bytes; the last line
    may have no end."""
    while start < len(data):
        end = data.find(b"\n", start + size) + 1 or len(data)
        yield data[start:end]
        start = end


def numbers_in(words: np.ndarray, dtype: type) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of a text, (N,), and the places where they begin, (N,) int64.

    Parameters
    ----------
    words : (letters,) uint8, all among LETTERS.
    dtype : np.float64 or np.int64.
    """
    letter = words > SPACE
    letter[1:] &= words[:-1] <= SPACE
    begins = np.flatnonzero(letter)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy warns of text that is no number
        try:
            numbers = np.fromstring(words.tobytes(), dtype, sep=" ") if len(begins) else begins
        except (DeprecationWarning, ValueError, OverflowError):
            raise OddityError from None
    if len(numbers) != len(begins):
        raise OddityError
    return numbers.astype(dtype, copy=False), begins


def by_line(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first number of each line and how many it has, (L,) int64 each, from the places
    where numbers begin and lines end."""
    upto = np.searchsorted(begins, ends)
    counts = np.diff(upto, prepend=0)
    return upto - counts, counts


def fans(corners: np.ndarray, first: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return polygons as fans of triangles, (F, 3): polygon i has counts[i] corners, from
    corners[first[i]] on."""
    triangles = np.maximum(counts - 2, 0)
    centre = np.repeat(first, triangles)
    nth = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return corners[np.stack([centre, centre + nth + 1, centre + nth + 2], axis=1)]
