"""Standard input and output as files, and errors of reading in one line."""

from __future__ import annotations

import io
import os
import shutil
import sys
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any, BinaryIO, TextIO

from voxtool.errors import FileError, human, one_line
from voxtool.files.storage import atomic
from voxtool.files.storage.atomic import atomic_path, write_error
from voxtool.memory import available_memory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PathLike = str | os.PathLike[str]
PACKED = 1032  # bytes that a byte of deflate can become, at most
STREAM = "-"  # stdin or stdout
OPENING = 64  # bytes by which a format is recognised


def input_name(path: PathLike) -> str:
    """Return the name of an input in messages."""
    return "stdin" if path == STREAM else os.fspath(path)


def folder_size(folder: Path) -> int:
    """Return the bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def read_error(name: str, error: Exception) -> FileError:
    """Return the error of reading `name`, in one line."""
    if isinstance(error, FileNotFoundError):
        return FileError(f"{name}: there is no such file")
    if isinstance(error, IsADirectoryError) or os.path.isdir(name):
        return FileError(f"{name}: is a folder: name a file in it")
    if isinstance(error, PermissionError):
        return FileError(f"{name}: no permission to read it")
    reason = getattr(error, "strerror", None) or one_line(error)
    return FileError(f"{name}: cannot be read: {reason}")


@contextmanager
def open_whole(path: PathLike) -> Iterator[tuple[BinaryIO, int]]:
    """Yield a seekable file and its size; stdin and pipes are read into memory first."""
    with open_stream(path) as (file, _, size):
        if size is None:
            most = available_memory() // 2
            data = read_at_most(file, most)
            if data is None:
                raise FileError(f"{input_name(path)}: more than {human(most)}: store it in a file")
            yield io.BytesIO(data), len(data)
        else:
            yield file, size


def read_at_most(file: BinaryIO, most: int, first: bytes = b"") -> bytes | None:
    """Return the rest of a file after its first bytes; None if there are more bytes than `most`."""
    whole = io.BytesIO()
    whole.write(first)
    while whole.tell() <= most:
        piece = file.read(1 << 20)
        if not piece:
            return whole.getvalue()
        whole.write(piece)
    return None


@contextmanager
def open_stream(path: PathLike) -> Iterator[tuple[BinaryIO, bytes, int | None]]:
    """Yield a file at its start, its first bytes, and its size, or None for stdin and pipes."""
    is_stdin = path == STREAM
    with nullcontext(sys.stdin.buffer) if is_stdin else open(path, "rb") as file:
        opening = file.read(OPENING)
        if file.seekable() and not is_stdin:
            file.seek(0)
            yield file, opening, os.fstat(file.fileno()).st_size
        else:
            yield io.BufferedReader(_Resumed(opening, file)), opening, None


class _Resumed(io.RawIOBase):
    """A stream from its start, of which the first bytes have been read already."""

    def __init__(self, opening: bytes, rest: Any) -> None:
        self._opening = opening
        self._rest = rest

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._opening:
            return self._rest.readinto1(buffer)
        count = min(len(buffer), len(self._opening))
        buffer[:count] = self._opening[:count]
        self._opening = self._opening[count:]
        return count


@contextmanager
def _standard_output(text: bool) -> Iterator[BinaryIO]:
    """Yield a temporary file, in which a format may seek; stdout gets it when the block ends."""
    if not text and sys.stdout.isatty():
        raise FileError("standard output is a terminal: redirect it, or name a file with -o")
    import tempfile

    try:
        with tempfile.TemporaryFile() as file:
            yield file  # pyright: ignore[reportReturnType]
            atomic.count(file.seek(0, os.SEEK_END))
            file.seek(0)
            shutil.copyfileobj(file, sys.stdout.buffer, 1 << 20)
        sys.stdout.buffer.flush()
    except BrokenPipeError as error:
        discard(sys.stdout)
        raise FileError("standard output was closed before all was written") from error
    except OSError as error:
        discard(sys.stdout)
        raise write_error("standard output", error) from error


def discard(stream: TextIO) -> None:
    """Send the rest of the buffer of a standard stream to the null device, so that the program ends
    quietly."""
    with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


@contextmanager
def open_output(path: PathLike, text: bool = False, clobber: bool = True) -> Iterator[BinaryIO]:
    """Yield an empty file to write and seek in; the output has its content when the block ends.

    Parameters
    ----------
    path : the output, which appears whole or not at all; `-` is stdout.
    text : whether a terminal can show the content.
    clobber : False refuses an existing file.

    Raises
    ------
    FileError : the output cannot be written, exists, or is a terminal that cannot show the content.
    """
    if path == STREAM:
        with _standard_output(text) as file:
            yield file
    else:
        with atomic_path(path, clobber) as temporary, open(temporary, "w+b") as file:
            yield file
