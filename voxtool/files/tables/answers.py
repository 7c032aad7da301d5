"""Tables of answers, written block by block: a table may be larger than memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.formats import format_of
from voxtool.files.storage.streams import STREAM, PathLike, open_output

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import DTypeLike

CSV_ROWS = 1 << 16  # rows whose text is in memory at once


class Answers(ABC):
    """A table in a file, written block by block."""

    text: bool  # whether a terminal can show it

    def __init__(self, file: BinaryIO, columns: Sequence[tuple[str, DTypeLike]]) -> None:
        self.file = file
        self.columns = [(name, np.dtype(kind)) for name, kind in columns]
        self.count = 0  # rows written so far
        self._begin()

    def write(self, block: Mapping[str, Any] | Sequence[Any]) -> None:
        """Write k rows: (k,) arrays by column name, or a list of arrays in the order of the
        columns, where (k,) is one column and (k, c) is c columns.

        Raises
        ------
        VoxtoolError : the number of columns is wrong, or their lengths differ.
        """
        if isinstance(block, Mapping):
            block = [block[name] for name, _ in self.columns]
        parts = [part if part.ndim == 2 else part[:, None] for part in map(np.asarray, block)]
        values = [column for part in parts for column in part.T]
        if len(values) != len(self.columns) or len({len(column) for column in values}) != 1:
            raise VoxtoolError(
                f"answers of shapes {', '.join(str(part.shape) for part in parts)}: "
                f"{len(self.columns)} columns of one length are expected"
            )
        self._write(values)
        self.count += len(values[0])

    @abstractmethod
    def _begin(self) -> None:
        """Write what comes before the rows."""

    @abstractmethod
    def _write(self, values: list[np.ndarray]) -> None:
        """Write rows, given as columns."""

    def end(self) -> None:  # noqa: B027 (CSV writes nothing here)
        """Write what is known only after the last row."""


class NpyAnswers(Answers):
    """A .npy file: (N,) float64 for one column, else (N, C)."""

    text = False

    def _begin(self) -> None:
        more = (len(self.columns),) if len(self.columns) > 1 else ()
        header = {"descr": "<f8", "fortran_order": False, "shape": (self.count, *more)}
        np.lib.format.write_array_header_1_0(self.file, header)

    def _write(self, values: list[np.ndarray]) -> None:
        self.file.write(np.stack(values, axis=1).astype("<f8", "C").tobytes())

    def end(self) -> None:
        self.file.seek(0)  # N is known now; numpy pads the header to the same size
        self._begin()


class CsvAnswers(Answers):
    """A .csv file: a line of names, then one line a row.

    Floats are the shortest decimals that read back as the same number of the column's type;
    integers and bools are integers.
    """

    text = True

    def _begin(self) -> None:
        self.file.write(",".join(name for name, _ in self.columns).encode() + b"\n")

    def _write(self, values: list[np.ndarray]) -> None:
        for first in range(0, len(values[0]), CSV_ROWS):
            words = [
                _words(column[first : first + CSV_ROWS].astype(kind))
                for column, (_, kind) in zip(values, self.columns, strict=True)
            ]
            rows = map(",".join, zip(*words, strict=True))
            self.file.write("".join(f"{row}\n" for row in rows).encode())


def _words(column: np.ndarray) -> Iterable[str]:
    if column.dtype.kind != "f":
        return map(str, column.astype(np.int64).tolist())
    return map(str, column if column.dtype.itemsize < 8 else column.tolist())


ANSWER_FORMATS: dict[str, type[Answers]] = {"npy": NpyAnswers, "csv": CsvAnswers}


@contextmanager
def open_answers(
    path: PathLike,
    columns: Sequence[tuple[str, DTypeLike]],
    format: str | None = None,
    clobber: bool = True,
) -> Iterator[Answers]:
    """Yield a table of answers; it is a .npy or .csv file when the block ends without an error.

    Parameters
    ----------
    path : `-` is stdout, as .csv unless `format` is given.
    columns : name and type of each column. The type decides the decimals of .csv; .npy is float64.
    format : "npy" or "csv" instead of what the name says.
    clobber : False refuses an existing file.

    Raises
    ------
    FileError : the file cannot be written, or its name says no format.
    """
    if format is None:
        format = "csv" if path == STREAM else format_of(path, ANSWER_FORMATS)
    if format not in ANSWER_FORMATS:
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(ANSWER_FORMATS)}")
    kind = ANSWER_FORMATS[format]
    with open_output(path, kind.text, clobber) as file:
        answers = kind(file, columns)
        yield answers
        answers.end()
