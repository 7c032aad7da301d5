"""Files whose sections have known sizes, and are written side by side in one pass."""

from __future__ import annotations

from collections.abc import Hashable
from typing import BinaryIO, TypeAlias

import numpy as np

Part: TypeAlias = bytes | tuple[Hashable, int]


class Section:
    """A section of a file, which is written from its start on."""

    def __init__(self, file: BinaryIO, start: int) -> None:
        self._file, self._at = file, start

    def write(self, array: np.ndarray) -> None:
        """Append an array."""
        self._file.seek(self._at)
        self._file.write(np.ascontiguousarray(array).view(np.uint8).data)
        self._at += array.nbytes


def size_of(parts: list[Part]) -> int:
    """Return the bytes of a file of these parts: bytes, or the name and the size of a section."""
    return sum(len(part) if isinstance(part, bytes) else part[1] for part in parts)


def begin(file: BinaryIO, parts: list[Part]) -> dict[Hashable, Section]:
    """Write the parts that are bytes into an empty file; return the sections by name."""
    sections, at = {}, 0
    for part in parts:
        if isinstance(part, bytes):
            file.seek(at)
            file.write(part)
            at += len(part)
        else:
            sections[part[0]] = Section(file, at)
            at += part[1]
    return sections
