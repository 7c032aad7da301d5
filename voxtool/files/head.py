"""What files say besides their arrays, checked in one place: versions, texts, JSON."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, NoReturn

from voxtool.errors import FileError
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping

# What each attribute is: a kind, and how many numbers or at most how many bytes of text.
INT, FLOAT, TEXT = int, float, str
Layout = dict[str, tuple[type, int]]

VERSION_LIMIT = 16  # bytes
JSON_TEXTS = ("plan", "reached")
JSON_LIMIT = 60_000  # HDF5 ends attributes at 64 KiB


def check_version(version: str, ours: str) -> None:
    """Take our major version, also with a newer minor one.

    Raises
    ------
    FileError : another major version, or none.
    """
    found = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", version)
    if found is None:
        raise FileError(f"format_version {version[:16]!r} is no version such as {ours}")
    major = int(ours.split(".")[0])
    if int(found[1]) > major:
        raise FileError(
            f"written in format {version}, newer than the {ours} that voxtool "
            f"{__version__} reads: update voxtool"
        )
    if int(found[1]) < major:
        raise FileError(
            f"written in format {version}, older than the {ours} that voxtool "
            f"{__version__} reads: write it anew"
        )


def check_texts(head: Mapping[str, Any], layout: Layout) -> None:
    """Check that every text is Unicode, fits, and can be printed.

    Raises
    ------
    FileError : names the attribute.
    """
    for name, (kind, limit) in layout.items():
        if kind is TEXT:
            _check_text(name, head[name], limit)


def _check_text(name: str, text: str, limit: int) -> None:
    try:
        size = len(text.encode())
    except UnicodeEncodeError:
        raise FileError(f"attribute {name} is not Unicode text") from None
    if size > limit:
        raise FileError(f"attribute {name} has {size} bytes: at most {limit} fit")
    if name not in JSON_TEXTS and not text.isprintable():
        raise FileError(f"attribute {name} has characters that cannot be printed")


def check_source(digest: str) -> None:
    """Check that a source's digest is one, or is left out.

    Raises
    ------
    FileError : it is not.
    """
    if not re.fullmatch(r"([0-9a-f]{64})?", digest):
        raise FileError("attribute source_sha256 is not 64 hexadecimal digits")


def expect(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Check that an attribute is one of the values that it may have.

    Raises
    ------
    FileError : names both.
    """
    if value not in allowed:
        wanted = " or ".join(map(str, allowed))
        raise FileError(f"attribute {name} is {str(value)[:40]!r} where {wanted} is expected")


def json_text(name: str, value: dict[str, Any]) -> str:
    """A dict of JSON types as text.

    Raises
    ------
    FileError : it holds what JSON cannot, such as infinite numbers.
    """
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise FileError(f"attribute {name} cannot be JSON: {str(error)[:80]}") from None


MAX_DEPTH = 16  # of JSON


def parse_json(name: str, text: str) -> dict[str, Any]:
    """A JSON object as a dict; only what JSON allows, finite numbers and real characters.

    Raises
    ------
    FileError : anything else.
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    try:
        value = json.loads(text, parse_constant=refuse)
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, RecursionError) as error:
        raise FileError(f"attribute {name} is not JSON: {str(error)[:80]}") from None
    if not isinstance(value, dict):
        raise FileError(f"attribute {name} is not a JSON object")
    if _depth(value) > MAX_DEPTH:
        raise FileError(f"attribute {name} is nested deeper than {MAX_DEPTH}")
    return value


def _depth(value: Any) -> int:
    """How deep lists and objects are nested; level by level, for they may be hostile."""
    depth, inner = 0, [value]
    while inner:
        depth += 1
        lists = [v.values() if isinstance(v, dict) else v for v in inner]
        inner = [v for one in lists for v in one if isinstance(v, dict | list)]
    return depth
