"""The refusal of an output that would replace an input of the command."""

from __future__ import annotations

import os
import stat
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from voxtool.errors import printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

OUTPUTS = ("output", "obj")  # parameters that name what is written
Key = tuple[int, int]  # device and inode: the same for all names of a file


def refuse_inputs(outputs: Iterable[str | os.PathLike[str]], more: Iterable[str] = ()) -> None:
    """Raise UsageError if an output, a file or a folder, is an input of the command or one of
    `more`, or holds one, by whatever name."""
    known: dict[Key, str] = {}
    for name in (*_named(), *more):
        for key in _keys(name):
            known.setdefault(key, name)
    for output in outputs:
        name = known.get(_key(output) or (0, 0)) if output != "-" else None
        if name is None:
            continue
        what = "holds" if os.path.isdir(output) and not os.path.isdir(name) else "is"
        shown = "stdin" if name == "-" else f"the input {printable(name)}"
        raise click.UsageError(
            f"{printable(str(output))} {what} {shown}: name another output, or give --overwrite to "
            "replace it"
        )


def _named() -> Iterator[str]:
    """Yield the texts that the command was given, some of which are names of inputs."""
    context = click.get_current_context()
    for parameter in context.command.params:
        value: Any = context.params.get(parameter.name or "")
        if value and parameter.name not in OUTPUTS and parameter.type is click.STRING:
            yield from [value] if isinstance(value, str) else value


def _keys(name: str) -> Iterator[Key]:
    """Yield the key of an input, and those of the folders that hold it."""
    if (key := _key(name)) is None:
        return
    yield key
    path = os.path.realpath(name)
    while name != "-" and path != (path := os.path.dirname(path)):
        if key := _key(path):
            yield key


def _key(name: str | os.PathLike[str]) -> Key | None:
    """Return the key of a file or a folder that exists; None for a device or a pipe."""
    with suppress(OSError, ValueError):
        found = os.fstat(sys.stdin.fileno()) if name == "-" else os.stat(name)
        if stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode):
            return found.st_dev, found.st_ino
    return None
