"""Variables of classic netCDF files (CDF-1, CDF-2 and CDF-5) [Rew 1990].

A file begins with the number of records and three lists: dimensions, attributes and variables.
Each list begins with a tag and its length; names and values are filled up to a multiple of four
bytes. All numbers are big-endian. Variables whose first dimension is that of records, the one of
length 0, are stored record by record.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from math import prod
from typing import BinaryIO, NamedTuple

import numpy as np

from voxtool.errors import FileError

MAGIC = b"CDF"
DIMENSIONS, VARIABLES, ATTRIBUTES = 10, 11, 12  # tags of lists
TYPES = (None, "i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8")
MOST_ITEMS = 100_000  # of a list
MOST_SIDES = 32  # of a variable
MOST_LETTERS = 256  # of a name, and of an attribute that is kept


class Variable(NamedTuple):
    """A variable of a file. Nothing of it has been read yet.

    shape, dtype : those of its numbers.
    piece : the least number of bytes that can be read.
    text : returns an attribute; FileError if there is no such text.
    rows : returns the first n rows, of a given n; FileError if they are not in the file.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    piece: int
    text: Callable[[str], str]
    rows: Callable[[int], np.ndarray]


def read_variables(file: BinaryIO) -> dict[str, Variable]:
    """Return the variables of a file that begins with MAGIC, by name.

    Raises
    ------
    FileError : the header is damaged.
    """
    return _Header(file).variables()


class _Header:
    """The header of a file, read from its start to its end."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.size = file.seek(0, os.SEEK_END)
        file.seek(0)
        version = self._take(4)[3]
        if version not in (1, 2, 5):
            raise FileError(f"version {version} of netCDF is unknown: export it again")
        self.length = 8 if version == 5 else 4  # bytes of a count
        self.offset = 4 if version == 1 else 8  # of a place in the file

    def variables(self) -> dict[str, Variable]:
        records = int.from_bytes(self._take(self.length))
        if records == (1 << 8 * self.length) - 1:  # not known when the file was written
            records = 1
        sides = [(self._name(), self._number())[1] for _ in range(self._count(DIMENSIONS))]
        self._texts()
        return dict(self._variable(sides, records) for _ in range(self._count(VARIABLES)))

    def _variable(self, sides: list[int], records: int) -> tuple[str, Variable]:
        name = self._name()
        count = self._number()
        if count > MOST_SIDES:
            raise FileError(f"{name} has {count} dimensions: it is damaged")
        numbers = [self._number() for _ in range(count)]
        if any(number >= len(sides) for number in numbers):
            raise FileError(f"{name} has a dimension that the file lacks: it is damaged")
        shape = tuple(sides[number] for number in numbers)
        texts = self._texts()
        dtype = self._type()
        self._take(self.length)  # its size, which follows from the rest
        start = int.from_bytes(self._take(self.offset))
        recorded = shape[:1] == (0,)
        shape = (records, *shape[1:]) if recorded else shape

        def rows(count: int) -> np.ndarray:
            size = dtype.itemsize * count * prod(shape[1:])
            if start + size > self.size or (recorded and count > 1):
                raise FileError(f"{name} needs {size} bytes that the file does not have")
            self.file.seek(start)
            return np.frombuffer(self.file.read(size), dtype).reshape(count, *shape[1:])

        def text(key: str) -> str:
            if key not in texts:
                raise FileError(f"attribute {key} is missing, or longer than {MOST_LETTERS}")
            return texts[key]

        return name, Variable(shape, dtype, 0, text, rows)

    def _texts(self) -> dict[str, str]:
        """Return the short texts among a list of attributes."""
        texts = {}
        for _ in range(self._count(ATTRIBUTES)):
            name, dtype, count = self._name(), self._type(), self._number()
            size = -(-count * dtype.itemsize // 4) * 4
            if dtype.kind == "S" and count <= MOST_LETTERS:
                texts[name] = self._take(size)[:count].rstrip(b"\0").decode("utf-8", "replace")
            else:
                self._skip(size)
        return texts

    def _count(self, tag: int) -> int:
        """Return the length of a list, which has this tag unless it is empty."""
        found, count = int.from_bytes(self._take(4)), self._number()
        if count > MOST_ITEMS or (found != tag and (found or count)):
            raise FileError(f"has a list of {count} items with tag {found}: it is damaged")
        return count

    def _type(self) -> np.dtype:
        code = int.from_bytes(self._take(4))
        if not 0 < code < len(TYPES):
            raise FileError(f"has numbers of the unknown type {code}: it is damaged")
        return np.dtype(TYPES[code])

    def _name(self) -> str:
        size = self._number()
        if size > MOST_LETTERS:
            raise FileError(f"has a name of {size} letters: it is damaged")
        return self._take(-(-size // 4) * 4)[:size].decode("utf-8", "replace")

    def _number(self) -> int:
        return int.from_bytes(self._take(self.length))

    def _take(self, size: int) -> bytes:
        start = self._skip(size)
        self.file.seek(start)
        return self.file.read(size)

    def _skip(self, size: int) -> int:
        """Go past some bytes; return where they begin."""
        start = self.file.tell()
        if start + size > self.size:
            raise FileError("ends in its header: it is cut short or damaged")
        self.file.seek(start + size)
        return start
