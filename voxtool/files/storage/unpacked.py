"""Packed data that are not trusted: zip archives and streams of gzip, bzip2 and the like.

Whatever a decompressor raises becomes one FileError. Little data that would unpack to much are
refused before they are unpacked.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO, cast

from voxtool.errors import FileError, MemoryLimitError, VoxtoolError, human, one_line, printable
from voxtool.memory import allowed_memory

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
FLAGS = {0x1: "encrypted", 0x20: "stored as a patch", 0x40: "encrypted", 0x2000: "encrypted"}
MOST_DIRECTORY = 1 << 24  # bytes of a zip file's list of entries, of 46 bytes and a name each
END, END64 = b"PK\5\6", b"PK\6\6"  # begin the ends of that list
COMMENT = 1 << 16  # bytes that may follow an end
MOST_RATIO, ANY_SIZE = 100, 1 << 31  # an array may unpack to this many times its size, or to bytes


@contextmanager
def unpacking(what: str) -> Iterator[None]:
    """Turn what a decompressor raises in this block into a FileError: damaged `what`."""
    try:
        yield
    except (VoxtoolError, MemoryError):
        raise
    except Exception as error:  # each library has errors of its own
        if isinstance(error, OSError) and error.errno is not None:  # of the disk
            raise
        reason = one_line(error) or type(error).__name__
        raise FileError(f"damaged {what}: {reason}: copy it again") from error


class Unpacked(io.RawIOBase):
    """A stream that a decompressor makes; its errors are one line."""

    def __init__(self, stream: Any, what: str) -> None:
        self._stream, self._what = stream, what

    def read(self, size: int = -1, /) -> bytes:
        """Return the next `size` bytes, fewer at the end."""
        with unpacking(self._what):
            return self._stream.read(size)

    def seek(self, place: int, whence: int = os.SEEK_SET, /) -> int:
        """Go on from another byte of the unpacked data."""
        with unpacking(self._what):
            return self._stream.seek(place, whence)

    def tell(self) -> int:
        """Return the place in the unpacked data."""
        return self._stream.tell()

    def close(self) -> None:
        """Close the stream, but not the file below it."""
        self._stream.close()
        super().close()


def check_unpacked(
    needed: int, held: int, what: str = "its array unpacks to", allowed: int | None = None
) -> None:
    """Refuse what takes `needed` bytes of a file of `held` bytes, if it is packed so well that
    reading it would take far longer than its size says, unless --max-memory allows as much."""
    most = allowed_memory() if allowed is None else allowed
    if needed > max(MOST_RATIO * held, ANY_SIZE, most or 0):
        raise MemoryLimitError(
            f"{what} {human(needed)}, {needed // max(held, 1)} times the file's {human(held)}: "
            "allow it by --max-memory, if you trust it"
        )


def open_zip(file: BinaryIO) -> zipfile.ZipFile:
    """Return a zip archive; FileError if it is damaged, or lists far too many entries."""
    with unpacking("zip archive"):
        if _directory_size(file) > MOST_DIRECTORY:
            raise FileError(
                f"a zip archive whose list of entries has more than {human(MOST_DIRECTORY)}: "
                "pack it again"
            )
        file.seek(0)
        return zipfile.ZipFile(file)


def _directory_size(file: BinaryIO) -> int:
    """Return the bytes of the list of entries of a zip file, as zipfile will read it."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - COMMENT - 128, 0))
    data = file.read()
    end, end64 = data.rfind(END), data.rfind(END64)
    if end < 0:
        return 0
    found = struct.unpack_from("<I", data, end + 12)[0] if len(data) >= end + 16 else 0
    if end64 >= 0 and len(data) >= end64 + 48:
        found = max(found, struct.unpack_from("<Q", data, end64 + 40)[0])
    return found


def open_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> BinaryIO:
    """Return an entry of a zip archive as a stream; FileError names what cannot be unpacked."""
    name = printable(entry.filename)[:80]
    for flag, state in FLAGS.items():
        if entry.flag_bits & flag:
            raise FileError(f"{name} is {state}: pack it again, without")
    if entry.compress_type not in METHODS:
        raise FileError(
            f"{name} is packed by method {entry.compress_type}: pack it again by deflate"
        )
    with unpacking(f"entry {name}"):
        return cast("BinaryIO", Unpacked(archive.open(entry), f"entry {name}"))
