"""The content of a page: facts in JSON types, and arrays that the browser makes textures of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from voxtool.arrays import digest_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np


@dataclass(frozen=True, eq=False)
class PageContent:
    """The kind, facts and arrays of what a page shows, and the shaders that draw them.

    kind : "octree", "field" or "volume".
    facts : what the scripts need to know, in JSON types.
    arrays : little-endian arrays by name, of uint8, uint16, uint32, int32 or float32.
    smaller_by : returns what makes a content fit of which only this share does, for messages.
    shaders : files of assets that the fragment shader begins with.
    defines : what these find defined: names, with a value or without.
    kernel : a header of the kernels that the fragment shader begins with, translated.
    """

    kind: str
    facts: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]
    smaller_by: Callable[[float], str]
    shaders: tuple[str, ...] = ()
    defines: tuple[str, ...] = ()
    kernel: str = ""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in self.arrays.values())

    def digest(self) -> str:
        """Return the SHA-256 of kind, facts and arrays, which is the same on every machine."""
        names = sorted(self.arrays)
        head = {"kind": self.kind, "facts": self.facts, "arrays": names}
        return digest_of(head, *(self.arrays[name] for name in names))
