"""Arrays that wait on disk until a file is written from them."""

from __future__ import annotations

import os
import tempfile
from typing import NamedTuple, Self

import numpy as np

from voxtool.errors import FileError
from voxtool.files.storage.atomic import write_error
from voxtool.files.storage.streams import STREAM, PathLike


class Piece(NamedTuple):
    """An array in a Spool."""

    start: int
    dtype: np.dtype
    shape: tuple[int, ...]


class Spool:
    """Arrays in a temporary file without a name on the disk of a target, which the system removes
    however the program ends. No other process can open it."""

    def __init__(self, target: PathLike) -> None:
        self._folder = None if target == STREAM else os.path.dirname(os.path.realpath(target))
        self._target = target
        try:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
        except OSError as error:
            raise write_error(target, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def put(self, array: np.ndarray) -> Piece:
        """Add an array; FileError if the disk is full."""
        try:
            start = self._file.seek(0, os.SEEK_END)
            self._file.write(np.ascontiguousarray(array).data)
            self._file.flush()
        except OSError as error:
            raise write_error(self._target, error) from error
        return Piece(start, array.dtype, array.shape)

    def get(self, piece: Piece) -> np.ndarray:
        """Return an array; FileError if the disk does not give it back whole."""
        array = np.empty(piece.shape, piece.dtype)
        try:
            self._file.seek(piece.start)
            read = self._file.readinto(array.reshape(-1).view(np.uint8).data)
        except OSError as error:
            raise write_error(self._target, error) from error
        if read != array.nbytes:
            raise FileError(f"{self._target}: the disk lost what waited there: run it again")
        return array

    def mapped(self, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        """Return all arrays that were added as one, which is read from the disk where it is used,
        also when the spool is closed."""
        return np.memmap(self._file, dtype, "r", shape=shape)

    def clear(self) -> None:
        """Remove all arrays."""
        self._file.seek(0)
        self._file.truncate()
