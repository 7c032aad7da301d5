"""A distance field whose blocks stay in a file: for queries of fields that are larger than memory.

The cells and the hash, a fifth of it, are in memory. The textures of the blocks are read in layers
of blocks, each once for all points that ask for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from voxtool.adf.field.cells import identifiers_in
from voxtool.adf.field.host_query import CORNERS, QueryResult, query_on_host
from voxtool.adf.field.packing import CHILDREN, POINTER_BITS, VERTICES
from voxtool.adf.field.spatial_hash import SpatialHash
from voxtool.arrays import Slices
from voxtool.errors import FileError

LAYERS = 16  # of blocks, that are read at once


@dataclass(frozen=True, eq=False)
class StoredField:
    """A field in a file.

    Attributes
    ----------
    voxels, bounds : Slices
        Rows along z of the textures of a file, which is open; bounds may be None.
    places : (3,) int
        Blocks along x, y and z of the texture.
    cells, hash, origin, side : as in DistanceField, but the numbers of blocks are pointers.
    """

    voxels: Slices
    bounds: Slices | None
    places: tuple[int, int, int]
    cells: np.ndarray
    hash: SpatialHash
    origin: tuple[float, float, float]
    side: float

    def validate(self) -> None:
        """Raise FileError if a pointer leads beyond the textures."""
        taken = self.identifiers.ravel() != 0
        if (self._places_of(self.cells[..., -1].ravel()[taken]) >= self.places).any():
            raise FileError("field cells: a pointer leads beyond the voxels")

    @cached_property
    def identifiers(self) -> np.ndarray:
        """(m, m, m) uint32 or uint64: the identifier of the cell in each slot, 0 in a free one."""
        return identifiers_in(self.cells)

    @cached_property
    def depth(self) -> int:
        """The deepest level of a leaf; the root has level 0."""
        return (int(self.identifiers.max()).bit_length() - 1) // 3 + 1

    def query(
        self, points: np.ndarray, *, gradient: bool = False, bounds: bool = False,
        cell: bool = False, search: str = "",
    ) -> QueryResult:  # fmt: skip
        """Return the values at points; see DistanceField.query, whose values they are, and to
        which the search makes no difference."""
        return query_on_host(self, points, gradient=gradient, bounds=bounds, cell=cell)

    def corners(self, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
        """Return the distances at the corners of children of blocks, (N, 2, 2, 2) float32."""
        z, y, x = CORNERS // 9, CORNERS // 3 % 3, CORNERS % 3
        found = np.empty((len(block), len(CORNERS)), np.float32)
        for some, places, texture in self._layers(self.voxels, block, VERTICES):
            at = VERTICES * places + octant[some]
            found[some] = texture[at[:, 2, None] + z, at[:, 1, None] + y, at[:, 0, None] + x]
        return found.reshape(-1, 2, 2, 2)

    def bound_codes(self, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
        """Return the codes of the bounds of children of blocks, (N,) uint8."""
        found = np.empty(len(block), np.uint8)
        assert self.bounds is not None
        for some, places, texture in self._layers(self.bounds, block, CHILDREN):
            x, y, z = (CHILDREN * places + octant[some]).T
            found[some] = texture[z, y, x]
        return found

    def _layers(
        self, rows: Slices, block: np.ndarray, texels: int
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield, for up to LAYERS layers of blocks at a time: the numbers of the points whose
        blocks lie there, (k,) int64; the places of these blocks from the first layer on, (k, 3)
        int64; and the rows of the texture."""
        places = self._places_of(block)
        layer = places[:, 2] // LAYERS
        for number in np.unique(layer).tolist():
            some, first = np.flatnonzero(layer == number), LAYERS * number
            last = min(first + LAYERS, self.places[2])
            yield some, places[some] - (0, 0, first), rows[texels * first : texels * last]

    def _places_of(self, pointers: np.ndarray) -> np.ndarray:
        """Return the places along x, y and z to which pointers lead, (n, 3) int64."""
        axes = pointers.astype(np.int64)[:, None] >> (POINTER_BITS * np.arange(3))
        axes[:, :2] &= (1 << POINTER_BITS) - 1
        return axes
