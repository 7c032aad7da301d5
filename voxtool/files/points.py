"""Points from files, block by block: a file may be larger than memory.

A file is not trusted: the sizes that it declares are compared with its bytes, pickles are never
loaded, and at most one block is in memory.
"""

from __future__ import annotations

import tempfile
import warnings
import zipfile
import zlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from voxtool.errors import FileError, one_line, printable
from voxtool.files.formats import MESH_EXTENSIONS
from voxtool.files.points_ply import read_ply
from voxtool.files.points_text import cut_short, read_text
from voxtool.files.streams import PathLike, input_name, open_stream, read_error
from voxtool.memory import check_disk

if TYPE_CHECKING:
    from collections.abc import Iterator

POINT_FORMATS = ("npy", "npz", "csv", "xyz", "ply")
POINTS_AT_ONCE = 1 << 18
NPY_MAGIC, ZIP_MAGIC = b"\x93NUMPY", (b"PK\3\4", b"PK\5\6")
NPY_VERSION = (1, 0)  # the only one that numbers need; its header has at most 64 KiB


def read_points(
    path: PathLike, format: str | None = None, block: int = POINTS_AT_ONCE
) -> Iterator[np.ndarray]:
    """Yield the points of a file, in blocks; `-` reads stdin.

    The format is recognised by content; of text by the extension, or by commas:

    - .npy, (N, 3) integers, float32 or float64, and .npz, of which the array `points` or the only
      one; a .npz cannot be a stream, since its contents are listed at its end;
    - .csv: three columns, or those that a header line calls x, y and z;
    - .xyz: white space between columns, of which the first three count;
    - .ply: the vertices.

    In text, # begins a comment, and blank lines do not count. NaN and infinity are numbers.

    Parameters
    ----------
    format : one of POINT_FORMATS instead of what the content says.
    block : the largest number of points in a block.

    Yields
    ------
    (k, 3) float64, 1 <= k <= block.

    Raises
    ------
    FileError : no such file, or it holds no points; the message names the line or the point. It is
        raised at the first block, unless what is wrong is further on.
    """
    name = input_name(path)
    if format not in (None, *POINT_FORMATS):
        raise FileError(f"format {format!r} is unknown: choose one of {', '.join(POINT_FORMATS)}")
    try:
        with open_stream(path) as (file, opening, size):
            if not opening:
                raise FileError(f"{name} is empty")
            try:
                yield from _blocks(file, size, format or _format(name, opening), block)
            except FileError as error:
                raise FileError(f"{name}: {error}") from error
    except OSError as error:
        raise read_error(name, error) from error


def _format(name: str, opening: bytes) -> str:
    """The format of a file by its opening; text by its extension, or else "text"."""
    if opening.startswith(NPY_MAGIC):
        return "npy"
    if opening.startswith(ZIP_MAGIC):
        return "npz"
    if opening.startswith((b"ply\n", b"ply\r")):
        return "ply"
    if b"\0" in opening or opening.startswith((b"\x89", b"\x1f\x8b")):
        raise FileError("holds no points: expected .npy, .npz, .csv, .xyz or .ply")
    extension = name.lower().rpartition(".")[2]
    if f".{extension}" in MESH_EXTENSIONS and extension not in POINT_FORMATS:
        raise FileError("is a mesh: expected points, .npy, .npz, .csv, .xyz or .ply")
    return extension if extension in ("csv", "xyz") else "text"


def _blocks(file: BinaryIO, size: int | None, format: str, block: int) -> Iterator[np.ndarray]:
    if format == "npy":
        return _read_npy(file, size, block)
    if format == "npz":
        return _read_npz(file, size, block)
    if format == "ply":
        return read_ply(file, size, block)
    return read_text(file, format, block)


# --- .npy and .npz -------------------------------------------------------------------------------


def _read_npy(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    count, in_columns, dtype = _npy_header(file)
    row = 3 * dtype.itemsize
    if size is not None and file.tell() + count * row > size:
        raise cut_short(count, (size - file.tell()) // row)
    if in_columns and count:
        with _on_disk(file, count * row) as (whole, there):
            if there < count * row:
                raise cut_short(count, max(there // dtype.itemsize - 2 * count, 0))
            points = np.memmap(whole, dtype, "r", 0, (count, 3), "F")
            for first in range(0, count, block):
                yield np.array(points[first : first + block], np.float64, order="C")
        return
    for first in range(0, count, block):
        rows = min(block, count - first)
        data = file.read(rows * row)
        if len(data) < rows * row:
            raise cut_short(count, first + len(data) // row)
        yield np.frombuffer(data, dtype).reshape(rows, 3).astype(np.float64)


def _npy_header(file: BinaryIO) -> tuple[int, bool, np.dtype]:
    """The number of points, whether all x come first, then all y, and the type of the numbers."""
    try:
        if np.lib.format.read_magic(file) != NPY_VERSION:
            raise ValueError
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of arrays that Python 2 wrote
            shape, in_columns, dtype = np.lib.format.read_array_header_1_0(file)
    except (OSError, zipfile.BadZipFile, zlib.error):
        raise
    except Exception:  # damage shows in many ways
        raise FileError(
            "is no .npy array, or its header is damaged: write it with numpy.save"
        ) from None
    if dtype.kind not in "iuf" or dtype.str[1:] in ("f2", "f12", "f16"):
        raise FileError(f"is an array of type {dtype.str}: points are integers, float32 or float64")
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 0:
        raise FileError(f"is an array of shape {printable(shape)[:60]}: points are (N, 3)")
    return shape[0], in_columns, dtype


@contextmanager
def _on_disk(file: BinaryIO, size: int) -> Iterator[tuple[BinaryIO, int]]:
    """A temporary file of the next `size` bytes of another, and how many there are."""
    check_disk(tempfile.gettempdir(), size, "store the points one after the other (C order)")
    with tempfile.TemporaryFile() as whole:
        left = size
        while left and (data := file.read(min(left, 1 << 16))):
            whole.write(data)
            left -= len(data)
        whole.flush()
        yield whole, size - left  # pyright: ignore[reportReturnType]


def _read_npz(file: BinaryIO, size: int | None, block: int) -> Iterator[np.ndarray]:
    if size is None:
        raise FileError(
            "the contents of a .npz are listed at its end, and a stream is read from its "
            "beginning: save it to a file, or send .npy"
        )
    try:
        with zipfile.ZipFile(file) as packed, packed.open(_points_member(packed)) as member:
            yield from _read_npy(member, None, block)  # pyright: ignore[reportArgumentType]
    except (FileError, OSError):
        raise
    except Exception as error:  # damage shows in any of the library's errors
        raise FileError(f"damaged .npz: {one_line(error)}") from error


def _points_member(packed: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {member.filename.removesuffix(".npy"): member for member in packed.infolist()}
    if "points" not in members and len(members) != 1:
        names = printable(", ".join(members))[:80] or "nothing"
        raise FileError(f"holds {names}: call the array of points `points`")
    member = members.get("points") or next(iter(members.values()))
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FileError(
            f"is packed by method {member.compress_type}: write it with numpy.savez or "
            "numpy.savez_compressed"
        )
    return member
