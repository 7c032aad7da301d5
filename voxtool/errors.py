"""Errors and warnings. Each message is one line: the thing, the place, and a hint that helps."""

from __future__ import annotations

import math
import re
from typing import Any


class VoxtoolError(Exception):
    """Base of every error that voxtool raises on purpose. Its text is one printable line."""

    def __str__(self) -> str:
        return printable(super().__str__())


class MeshError(VoxtoolError):
    """A mesh cannot be read or holds no usable geometry."""


class GridError(VoxtoolError):
    """A grid cannot be placed as asked, or a point lies beyond its fixed-point range."""


class FileError(VoxtoolError):
    """A file is missing, damaged, hostile, or of another kind than expected."""


class DeviceError(VoxtoolError):
    """No OpenCL device can be used, or one failed."""


class MemoryLimitError(VoxtoolError):
    """A request needs more memory than it may take."""


class OnePieceError(MemoryLimitError):
    """A request that does not fit in memory has something that is not made in windows."""


class CheckError(VoxtoolError):
    """A check or a comparison that was asked for does not hold."""


class VoxtoolWarning(UserWarning):
    """Base of every warning that voxtool issues. Its text is one printable line."""

    def __str__(self) -> str:
        return printable(super().__str__())


class MeshWarning(VoxtoolWarning):
    """A result may surprise: it is empty, or the input has a fault that shows in it."""


class DeviceWarning(VoxtoolWarning):
    """An OpenCL device cannot be used and is passed over."""


# --- words for messages --------------------------------------------------------------------------


def count_of(count: int, noun: str) -> str:
    """Return a number with its noun: 1 vertex, 2 vertices."""
    plural = {"vertex": "vertices", "patch": "patches", "cavity": "cavities", "leaf": "leaves"}.get(
        noun, noun + "s"
    )
    return f"{count:,} {noun if count == 1 else plural}"


LESS = "choose a smaller dim, picture or number of points"


def printable(text: Any) -> str:
    """Replace characters that would break a line or a terminal by ?."""
    plain = re.sub(r"\\udc[89a-f][0-9a-f]", "?", str(text))  # as repr writes such bytes
    return plain if plain.isprintable() else "".join(c if c.isprintable() else "?" for c in plain)


def one_line(error: BaseException) -> str:
    """Return another library's message, on one line of bounded length."""
    return printable(" ".join(str(error).split()))[:200]


def shown(word: bytes) -> str:
    """Return the beginning of a word of a file, in quotes."""
    return repr(word[:40].decode("ascii", "replace"))


def at_least(number: float) -> str:
    """Return a positive number as messages say a least value: to 4 digits, never rounded down."""
    text = f"{number:.4g}"
    if float(text) < number:
        last = math.floor(math.log10(number)) - 3  # place of the last digit
        text = f"{float(text) + 10.0**last:.4g}"
    return text


def human(size: int) -> str:
    """Return the bytes as people read them: 12.3 GB."""
    value = float(size)
    for unit in ("bytes", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} TB"
