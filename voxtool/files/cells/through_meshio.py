"""meshio, with files that are not trusted.

Before meshio reads a file, the sizes that it declares are compared with its bytes, and what names
another file is refused. While meshio reads, the process can map no more memory than the declared
content needs (on Linux). What meshio raises, prints or exits with becomes one line.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import threading
import warnings
from importlib import import_module
from math import prod
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np

from voxtool.errors import FileError, MemoryLimitError, MeshWarning, human, printable
from voxtool.files.grids.vtk_xml import DEEPEST, MOST_TOKEN, dtype_of
from voxtool.files.storage.streams import PACKED
from voxtool.files.storage.text_numbers import array_of_text
from voxtool.files.storage.text_types import check_types
from voxtool.limits import bounded_memory
from voxtool.memory import available_memory

SCAN = 1 << 20  # bytes of XML at a time
MOST_ARRAYS = 1000  # of a .vtu
MOST_ENDS = 100  # reads at the end of a file, after which a reader is taken to go on for ever
NODES = 12  # of a cell of a .vtu, on average
# Memory that meshio may take: a fixed part, and bytes for each byte of the file and of the content
# that it declares. Measured on files of 10 to 70 MB in every format: at most half of these.
FIXED = 64 << 20
PER_BYTE = 6
PER_BYTE_OF_TEXT = 64  # a number of two letters becomes an object of Python

# The counts that follow a keyword, by format.
COUNTS = {
    "gmsh": rb"(?m)^[ \t]*\$(?:PhysicalNames|Entities|Nodes|Elements|Periodic|NodeData|ElementData)"
    rb"[ \t]*\r?\n(?=[ \t]*(\S+)(?:[ \t]+(\S+))?)",
    "medit": rb"(?m)^[ \t]*[A-Za-z]+[ \t]*\r?\n(?=[ \t]*(\S+)[ \t]*\r?$)",
    "avsucd": rb"\A(?:[ \t]*(?:#[^\n]*)?\n)*[ \t]*(\S+)[ \t]+(\S+)",
    "vtk": rb"(?mi)^[ \t]*(?:POINTS|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA|[XYZ]_COORDINATES|"
    rb"(?:FIELD|LOOKUP_TABLE)[ \t]+\S+)[ \t]+(\S+)(?:[ \t]+(\d+))?",
}
DIMENSIONS = re.compile(rb"(?mi)^[ \t]*DIMENSIONS[ \t]+(\d+)[ \t]+(\d+)[ \t]+(\d+)")
POINTS_PER_BYTE = 8  # of a structured grid one cell thick, with one byte a cell
ROWS = {
    "Points": "NumberOfPoints",
    "PointData": "NumberOfPoints",
    "Cells": "NumberOfCells",
    "CellData": "NumberOfCells",
}


def read_mesh(name: str, path: str, kind: str, max_memory: int | None) -> Any:
    """Return the mesh as meshio reads it; its messages become warnings."""
    try:
        import_module("meshio")
    except ImportError:
        raise FileError(
            f"{name}: meshio reads it, which is not installed: pip install 'voxtool[tets]'"
        ) from None
    size = os.stat(path).st_size
    declared = (_scan_xml if kind == "vtu" else _scan_counts)(name, path, size, kind)
    free = available_memory() if max_memory is None else min(max_memory, available_memory())
    needed = FIXED + (PER_BYTE if kind == "vtu" else PER_BYTE_OF_TEXT) * (size + declared)
    printed, warned = _OwnText(sys.stdout), _OwnText(sys.stderr)
    try:
        with (
            bounded_memory(min(needed, free)),  # one thread at a time: streams are shared, too
            np.errstate(all="ignore"),  # meshio converts numbers that may be anything
            warnings.catch_warnings(),  # of meshio alone: another thread may open the device
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(warned),
        ):
            warnings.filterwarnings("ignore", module="meshio")
            read = _read(path, kind)
    except KeyboardInterrupt:
        raise
    except FileError as error:
        raise FileError(f"{name}: {error}") from None
    except MemoryError:
        if free < needed:
            raise MemoryLimitError(
                f"{name}: meshio needs more than the {human(free)} that are free or allowed: raise "
                "--max-memory, or free some memory"
            ) from None
        raise FileError(
            f"{name}: meshio takes more than {human(needed)} to read it as {kind}, which its size "
            "and declared content do not need: it is damaged"
        ) from None
    except BaseException as error:  # it prints why, and exits
        reason = printed.getvalue() if isinstance(error, SystemExit) else f"{error}"
        reason = printable(" ".join(reason.split()))[:200]
        raise FileError(
            f"{name}: meshio cannot read it as {kind}{reason and ': '}{reason}: it may be damaged, "
            "or have cells that meshio does not know: export it again"
        ) from None
    for line in filter(None, warned.getvalue().split("\n\n")):
        text = printable(" ".join(line.split()))[:200]
        warnings.warn(f"{name}: {text}", MeshWarning, stacklevel=5)
    return read


class _OwnText(io.StringIO):
    """Text that the thread which made it writes; other threads write to the given stream."""

    def __init__(self, stream: Any) -> None:
        super().__init__()
        self._stream, self._thread = stream, threading.get_ident()

    def write(self, text: str, /) -> int:
        """Write text; return its length."""
        own = threading.get_ident() == self._thread
        return super().write(text) if own else self._stream.write(text)


def _read(path: str, kind: str) -> Any:
    if kind in ("gmsh", "vtk"):
        module = {"gmsh": "meshio.gmsh.main", "vtk": "meshio.vtk._main"}[kind]
        with _Bytes(io.FileIO(path)) as file:
            return import_module(module).read_buffer(file)
    meshio: Any = import_module("meshio")
    if kind == "vtu":
        return meshio.read(path, kind)
    with (_Abaqus if kind == "abaqus" else _Text)(open(path, "rb"), "utf-8", "replace") as file:
        return meshio.read(file, kind)


class _Ending:
    """A file that fails if it is read on and on at its end, as by loops over a wrong count."""

    ends = 0

    def readline(self, *args: Any) -> Any:
        """Return the next line."""
        line = super().readline(*args)  # pyright: ignore[reportAttributeAccessIssue]
        self.ends += not line
        if self.ends > MOST_ENDS:
            raise FileError("ends before the counts that it declares: it is cut short or damaged")
        return line


class _Bytes(_Ending, io.BufferedReader):
    """A binary file that ends."""


class _Text(_Ending, io.TextIOWrapper):
    """A text file that ends."""


class _Abaqus(_Text):
    """An Abaqus file that fails where it names another file, without its sets, for each of which
    meshio would go through all elements."""

    def readline(self, *args: Any) -> Any:
        """Return the next line."""
        line = super().readline(*args)
        if line.startswith("*") and not line.startswith("**"):
            keyword, *words = line.split(",")
            if keyword.strip().upper() in ("*NSET", "*ELSET"):
                return "**\n"
            kept = (word for word in words if not word.strip().upper().startswith("ELSET"))
            line = ",".join((keyword, *kept)).rstrip("\r\n") + "\n"
        if not line.startswith("**"):
            words = "".join(line.upper().split()).replace("*", "")
            if words.partition(",")[0] == "INCLUDE" or "INPUT=" in words:
                raise FileError(
                    "names another file (INCLUDE or INPUT=), and other files are not read: put its "
                    "lines in its place"
                )
        return line


# ---- declared sizes


def _scan_counts(name: str, path: str, size: int, kind: str) -> int:
    """Refuse counts of text formats that the file cannot hold; return bytes of generated points."""
    if kind == "abaqus":  # has none
        return 0
    with open(path, "rb") as file:
        data = file.read()
    for match in re.finditer(COUNTS[kind], data):
        for word in match.groups():
            with contextlib.suppress(ValueError, TypeError):  # what is no number is meshio's matter
                _check_count(name, match[0].split()[0].decode("ascii", "replace"), int(word), size)
    check_types(name, data, kind)
    grids = [prod(map(int, m.groups())) for m in DIMENSIONS.finditer(data)] if kind == "vtk" else []
    for points in grids:
        _check_count(name, "DIMENSIONS", points, POINTS_PER_BYTE * size)
    return 4 * max(grids, default=0)


def _check_count(name: str, what: str, count: int, most: int) -> None:
    if not 0 <= count <= most:
        raise FileError(
            f"{name}: {printable(what)[:40]} {count} is no number of items that the file can hold: "
            "it is damaged"
        )


# ---- XML


class _Scanned(Exception):
    """Raised when the needed part of an XML file has been parsed."""


class _Declared:
    """The sizes that the elements of a .vtu declare, gathered by the XML parser."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.packed = False
        self.pieces: list[dict[str, str]] = []
        self.arrays: list[tuple[str, dict[str, str]]] = []  # what their number of rows is called
        self.rows = ""
        self.depth = 0
        self.text: list[str] | None = None  # of an array of text
        self.dtype = np.dtype(np.uint8)  # of its numbers

    def doctype(self, *_: object) -> NoReturn:
        raise FileError(f"{self.name}: declares a document type or entities, which no .vtu needs")

    def end(self, tag: str) -> None:
        self.depth -= 1
        if self.text is not None:
            text, self.text = "".join(self.text).encode(), None
            try:
                array_of_text(text, self.dtype)
            except FileError as error:
                what = printable(self.arrays[-1][1].get("Name", ""))[:40]
                raise FileError(f"{self.name}: array {what}: {error}") from None

    def characters(self, text: str) -> None:
        if self.text is not None:
            self.text.append(text)

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise FileError(f"{self.name}: elements inside more than {DEEPEST} others: damaged")
        if tag == "AppendedData":  # what follows may be no XML
            if not self.pieces:
                raise FileError(f"{self.name}: has no piece before the appended data")
            raise _Scanned
        if tag == "VTKFile":
            self.packed = "compressor" in attributes
            if attributes.get("compressor") == "vtkLZ4DataCompressor":
                raise FileError(f"{self.name}: is packed by LZ4: save it with zlib or LZMA")
        elif tag == "Piece":
            self.pieces.append(attributes)
        elif tag == "DataArray":
            self.arrays.append((self.rows, attributes))
            if attributes.get("format") == "ascii":  # what has another type is meshio's matter
                with contextlib.suppress(FileError):
                    self.dtype = dtype_of(attributes.get("type", ""), "<")
                    self.text = []
            if len(self.arrays) > MOST_ARRAYS:
                raise FileError(f"{self.name}: has more than {MOST_ARRAYS} arrays")
            if self.rows == "NumberOfCells" and attributes.get("Name") == "faces":
                raise FileError(f"{self.name}: has polyhedra: split them into tetrahedra")
        else:
            self.rows = ROWS.get(tag, "")

    def size(self) -> int:
        """Return the bytes of the arrays of checked pieces."""
        total = 0
        for rows, attributes in self.arrays:
            bits = re.search("[0-9]+$", attributes.get("type", ""))
            components = attributes.get("NumberOfComponents", "")
            width = int(components) if re.fullmatch("[0-9]{1,15}", components) else 1
            width *= NODES if attributes.get("Name") == "connectivity" else 1
            count = int(self.pieces[0][rows]) if rows and self.pieces else 0
            total += count * width * (int(bits[0][:3]) // 8 if bits else 8)
        return total


def _scan_xml(name: str, path: str, size: int, kind: str) -> int:
    """Refuse a .vtu with a document type, entities, more points or cells than its bytes can hold,
    or several pieces, of which meshio would read one; return the bytes of its arrays."""
    found = _Declared(name)
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = found.doctype
    parser.EntityDeclHandler = found.doctype
    parser.StartElementHandler = found.start
    parser.EndElementHandler = found.end
    parser.CharacterDataHandler = found.characters
    parser.buffer_text = True
    try:
        with open(path, "rb") as file:
            for chunk in iter(lambda: file.read(SCAN), b""):
                parser.Parse(chunk)
                if file.tell() - max(parser.CurrentByteIndex, 0) > SCAN + MOST_TOKEN:
                    raise FileError(f"{name}: a tag of more than {MOST_TOKEN >> 20} MiB: damaged")
        parser.Parse(b"", True)
    except _Scanned:
        pass
    except expat.ExpatError as error:
        raise FileError(f"{name}: damaged XML: {error}: export it again") from None
    if len(found.pieces) > 1:
        raise FileError(
            f"{name}: has {len(found.pieces)} pieces, of which meshio would read the cells of one: "
            "merge them"
        )
    for piece in found.pieces:
        for what in ("NumberOfPoints", "NumberOfCells"):
            count = piece.get(what, "")
            if not count.isdecimal() or int(count) > size * (PACKED if found.packed else 1):
                raise FileError(
                    f"{name}: {what}={printable(count)[:40]!r} is no number that {size} bytes "
                    "hold: the file is damaged"
                )
    return found.size()
