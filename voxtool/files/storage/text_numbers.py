"""Numbers of a text that is not trusted, as numbers of a type: none of them is rounded to another
whole number, wraps around or becomes infinite. A word that is no number of the type is refused."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from voxtool.errors import FileError, shown
from voxtool.files.storage.numbers import BLOCK_BYTES, LETTERS, NUMBER, OddityError, numbers_in

WHOLE = re.compile(rb"[-+]?\d+")
DIGITS = 400  # of a number that are read: no type holds more
REAL = re.compile(rb"(?i)" + NUMBER + rb"|[-+]?(?:nan|inf|infinity)")
REAL_TEXT, WHOLE_TEXT = (re.compile(each.pattern.decode(), re.ASCII) for each in (REAL, WHOLE))
BLANK = re.compile(rb"\s")
WHOLE_FLOATS = 1 << 53  # up to which float64 holds every whole number


class BeyondError(FileError):
    """Raised for a number that its type does not hold."""


def array_of_text(text: bytes, dtype: np.dtype) -> np.ndarray:
    """Return the numbers of a text with white space between them, (N,) of a dtype.

    Raises
    ------
    FileError
        If a word is no number, or none that the type holds; the message shows it.
    """
    parts = [_numbers(block, dtype) for block in _blocks(text)]
    return np.concatenate([np.empty(0, dtype), *parts], dtype=dtype)


def real(word: str) -> float:
    """Return a number, which may be infinite or NaN; FileError for other text."""
    word = word.strip()
    if not REAL_TEXT.fullmatch(word):
        raise FileError(f"{shown(word.encode())} is no number")
    number = float(word)
    if math.isinf(number) and "n" not in word.lower():  # inf has one
        raise FileError(f"{shown(word.encode())} is beyond float64")
    return number


def whole(word: str) -> int:
    """Return a whole number; FileError for other text."""
    word = word.strip()
    if not WHOLE_TEXT.fullmatch(word):
        raise FileError(f"{shown(word.encode())} is no whole number")
    return int(word[:DIGITS])


def _blocks(text: bytes) -> Iterator[bytes]:
    """Yield a text in blocks of whole words."""
    start = 0
    while start < len(text):
        end = BLANK.search(text, start + BLOCK_BYTES)
        stop = end.end() if end else len(text)
        yield text[start:stop]
        start = stop


def _numbers(block: bytes, dtype: np.dtype) -> np.ndarray:
    """Return the numbers of a block."""
    wide = np.float64 if dtype.kind == "f" else np.int64
    try:
        if block.translate(None, LETTERS):
            raise OddityError
        found, _ = numbers_in(np.frombuffer(block, np.uint8), wide)
    except OddityError:
        return _by_word(block, dtype)
    if dtype.kind == "f":
        with np.errstate(over="ignore", under="ignore"):
            result = found.astype(dtype)
        return result if np.isfinite(result).all() else _by_word(block, dtype)
    least, most = (getattr(np.iinfo(dtype), end) for end in ("min", "max"))
    ends = np.iinfo(np.int64)  # which a number beyond int64 becomes
    if ((found < least) | (found > most) | (found == ends.min) | (found == ends.max)).any():
        return _by_word(block, dtype)
    return found.astype(dtype)


def _by_word(block: bytes, dtype: np.dtype) -> np.ndarray:
    read = _real if dtype.kind == "f" else _whole
    return np.array([read(word, dtype) for word in block.split()], dtype)


def _real(word: bytes, dtype: np.dtype) -> float:
    if not REAL.fullmatch(word):
        raise FileError(f"{shown(word)} is no number")
    number = float(word)
    with np.errstate(over="ignore", under="ignore"):
        fits = math.isfinite(dtype.type(number)) or b"n" in word.lower()  # nan, inf
    if not fits:
        raise BeyondError(f"{shown(word)} is beyond {dtype.name}")
    return number


def _whole(word: bytes, dtype: np.dtype) -> int:
    if WHOLE.fullmatch(word):
        number = int(word[:DIGITS])
    elif REAL.fullmatch(word) and abs(float(word)) < WHOLE_FLOATS and float(word).is_integer():
        number = int(float(word))
    else:
        kind = BeyondError if REAL.fullmatch(word) else FileError
        raise kind(f"{shown(word)} is no whole number, where the type is {dtype.name}")
    ends = np.iinfo(dtype)
    if not ends.min <= number <= ends.max:
        raise BeyondError(f"{shown(word)} is beyond {dtype.name}")
    return number
