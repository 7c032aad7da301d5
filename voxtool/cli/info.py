"""The options of svo-info and adf-info, and the printing of their summaries."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli.options import flag, json_option, print_json, together
from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from voxtool.adf.field.field import DistanceField
    from voxtool.svo.octree.content import OctreeContent


info_options = together(
    flag("--check", "Check every invariant."),
    flag("--digest", "Print the SHA-256 of the content, and that alone."),
    json_option,
    flag(
        "-v --verbose", "Print how it is stored, too: levels, bytes in memory, what was left out."
    ),
)


def describe(
    file: str, content: OctreeContent | DistanceField,
    text: Callable[[dict[str, Any], bool], Iterable[str]], *, check: bool, as_json: bool,
    verbose: bool, **asked: bool,
) -> None:  # fmt: skip
    """Print the summary of the content of a file, as the lines of `text` or as JSON; or only the
    digests that are asked for, by the names of their methods, if there are any and no JSON. Reading
    the file has checked every invariant."""
    digests = {name: getattr(content, name)() for name in asked if asked[name]}
    if digests and not as_json:
        click.echo("\n".join(digests.values()))
        return
    info = content.summary()
    if os.path.isfile(file):  # neither stdin nor a pipe
        info["file_bytes"] = os.path.getsize(file)
    if check:
        info["check"] = "ok"
    info |= digests
    if as_json:
        print_json(info)
        return
    for line in text(info, verbose):
        click.echo(line)
    if verbose:
        for line in section("left out", info["plan"].get("left_out")):
            click.echo(line)
    if check:
        click.echo("\ncheck: ok")


def table(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Return lines of names and values."""
    return (f"{name:<12} {value}" for name, value in rows)


def sizes(info: dict[str, Any], verbose: bool, more: str = "") -> Iterator[tuple[str, str]]:
    """Yield the line of the bytes of the file, and if verbose that of the bytes in memory."""
    if "file_bytes" in info:
        yield "bytes", f"{info['file_bytes']:,}"
    if verbose:
        yield "memory", f"{info['memory_bytes']:,} bytes{more}"


def place(numbers: Iterable[float]) -> str:
    """Return coordinates or lengths along the axes."""
    return " ".join(f"{number:.9g}" for number in numbers)


def normalized(*transform: float) -> Iterator[tuple[str, str]]:
    """Yield the line of the transform of a normalized mesh, if there is one."""
    if transform:
        scale, *offset = transform
        yield "normalized", f"original * {scale:.9g} + ({place(offset)})"


def section(title: str, pairs: Any) -> Iterator[str]:
    """Return the lines of a dict of names and values, if there are any."""
    if pairs and isinstance(pairs, dict):
        yield f"\n{title}"
        for name, value in _flattened(pairs):
            yield f"  {printable(name)}: {printable(value)}"


def _flattened(pairs: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield names and values; a dict in the dict yields its own."""
    for name, value in pairs.items():
        if not isinstance(value, dict):
            yield name, _shown(value)
        elif any(isinstance(inner, dict) for inner in value.values()):
            yield from ((f"{name} {inner}", text) for inner, text in _flattened(value))
        else:
            yield name, ", ".join(f"{inner} {_shown(v)}" for inner, v in value.items())


def _shown(value: Any) -> str:
    """Return a value as text for people."""
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.6g}"
    if type(value) is int:
        return f"{value:,}"
    if isinstance(value, list):
        return f"({', '.join(map(_shown, value))})"
    return json.dumps(value, ensure_ascii=False)
