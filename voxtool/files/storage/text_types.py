"""Types of the numbers in text formats that meshio reads, which are checked before: beyond its type
a number would wrap around or become infinite without a word."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from voxtool.errors import FileError
from voxtool.files.storage.text_numbers import BeyondError, array_of_text

TYPES = {
    "char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "unsigned_long": "u8",
    "vtktypeint64": "i8",
    "float": "f4",
    "double": "f8",
}
NUMBERS = re.compile(rb"(?:\s*(?:[-+.\d]\S*|(?:nan|inf)\b))*", re.IGNORECASE)
# The words before numbers of a type: the type in legacy VTK files, the element elsewhere.
TYPED = re.compile(
    rb"(?mi)^[ \t]*(?:(?:POINTS|[XYZ]_COORDINATES|SCALARS|VECTORS|NORMALS|TENSORS)[ \t]+\S+|"
    rb"OFFSETS|CONNECTIVITY|\S+[ \t]+\d+[ \t]+\d+)[ \t]+("
    + "|".join(TYPES).encode()
    + rb")(?:[ \t]+\d+)?[ \t]*\r?\n(?:[ \t]*LOOKUP_TABLE[^\n]*\n)?"
)
INDICES = {  # and the type that meshio gives them
    "vtk": (re.compile(rb"(?mi)^[ \t]*CELL(?:S[ \t]+\d+|_TYPES)[ \t]+\d+[ \t]*\r?\n"), "i4"),
    "gmsh": (re.compile(rb"(?m)^[ \t]*\$Elements[ \t]*\r?\n"), "i4"),
    "medit": (
        re.compile(
            rb"(?m)^[ \t]*(?:Edges|Triangles|Quadrilaterals|Tetrahedra|Hexahedra|Hexaedra|Prisms|"
            rb"Pyramids)[ \t]*\r?\n"
        ),
        "i8",
    ),
}
IS_TEXT = {
    "vtk": re.compile(rb"(?i)\A[^\n]*\n[^\n]*\n[ \t]*ASCII"),
    "gmsh": re.compile(rb"\$MeshFormat[ \t]*\r?\n[ \t]*\S+[ \t]+0[ \t]"),
    "medit": re.compile(rb"MeshVersionFormatted"),
}


def check_types(name: str, data: bytes, kind: str) -> None:
    """Raise FileError if a number of a text is beyond the type that meshio gives it.

    Parameters
    ----------
    kind : str
        meshio's name of the format; others than those of IS_TEXT pass.
    """
    if kind not in IS_TEXT or not IS_TEXT[kind].search(data[: 1 << 12]):
        return
    for start, dtype in _typed(data, kind):
        words = NUMBERS.match(data, start)
        try:
            array_of_text(words[0] if words else b"", dtype)
        except BeyondError as error:
            line = data.count(b"\n", 0, start) + 1
            raise FileError(f"{name}: of the numbers from line {line} on, {error}") from None
        except FileError:
            continue  # what is no number is meshio's matter


def _typed(data: bytes, kind: str) -> Iterator[tuple[int, np.dtype]]:
    """Yield where numbers of one type begin, and the type."""
    heads, dtype = INDICES[kind]
    yield from ((found.end(), np.dtype(dtype)) for found in heads.finditer(data))
    if kind == "vtk":
        for found in TYPED.finditer(data):
            yield found.end(), np.dtype(TYPES[found[1].decode().lower()])
