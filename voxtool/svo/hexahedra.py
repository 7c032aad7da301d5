"""The set cells of an image as hexahedra that share nodes, layer by layer.

Nodes are numbered plane by plane along x, and hexahedra layer by layer, both in lexicographic order
of x, y and z. A layer needs its neighbours alone: three layers of cells and two planes of nodes are
held at once, so the numbers are the same however the image is read.

The boundary is every face between a hexahedron and what is none, in six surfaces by the direction
that a face looks to.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.svo.image import VoxelImage

# The corners of a cell, x, y and z, in the order of VTK, Gmsh and Abaqus.
CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
MATERIAL = "solid"
BOUNDARY = "boundary"  # all six surfaces
TABLE = 1 << 24  # places of a plane, up to which a table finds keys
SPARSE = 256  # times as many places as keys make a search faster than a table
CELL_BYTES = 512  # of memory for a cell of the largest layer, and for its nodes and faces


class Side(NamedTuple):
    """A surface: the faces that look to one direction."""

    name: str
    corners: tuple[int, int, int, int]  # of the cell; seen from outside, counter-clockwise


SIDES = (
    Side("x_low", (0, 4, 7, 3)),
    Side("x_high", (1, 2, 6, 5)),
    Side("y_low", (0, 1, 5, 4)),
    Side("y_high", (3, 7, 6, 2)),
    Side("z_low", (0, 3, 2, 1)),
    Side("z_high", (4, 5, 6, 7)),
)


class Places:
    """Ascending keys of places in a plane, which can be found.

    Parameters
    ----------
    keys : (n,) int
    size : int
        The number that all keys are below.
    """

    def __init__(self, keys: np.ndarray, size: int) -> None:
        self.keys = keys
        self._table = None
        if len(keys) and size <= min(TABLE, SPARSE * len(keys)):
            self._table = np.full(size, -1, np.int32)
            self._table[keys] = np.arange(len(keys), dtype=np.int32)

    @classmethod
    def united(cls, parts: list[np.ndarray], size: int) -> Places:
        """Return the places of the keys of several lists."""
        dtype = parts[0].dtype
        if size > min(TABLE, SPARSE * sum(map(len, parts))):
            return cls(np.unique(np.concatenate(parts)), size)
        held = np.zeros(size, bool)
        for keys in parts:
            held[keys] = True
        return cls(np.flatnonzero(held).astype(dtype), size)

    def __len__(self) -> int:
        return len(self.keys)

    def find(self, keys: np.ndarray) -> np.ndarray:
        """Return where keys are in the list, (m,) int; -1 if one is not."""
        if self._table is not None:
            return self._table[keys]
        if not len(self.keys):
            return np.full(len(keys), -1)
        found = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[found] == keys, found, -1)


class Plane(NamedTuple):
    """The nodes of a plane."""

    x: int
    first: int  # number of its first node
    nodes: Places


@dataclass(frozen=True)
class Layer:
    """The cells of a layer, and what lies beside them."""

    x: int
    first: int  # number of the first cell
    width: int  # keys from one row to the next
    cells: Places
    low: Plane
    high: Plane
    new: tuple[Plane, ...]  # those of the two that no layer before it has
    below: Places  # cells of the layers at both sides
    above: Places

    def corners(self, dtype: Any) -> np.ndarray:
        """Return the nodes of the hexahedra, counted from 0, (n, 8)."""
        planes = (self.low, self.high)
        numbers = [np.arange(p.first, p.first + len(p.nodes), dtype=dtype) for p in planes]
        return np.stack(self.at_corners(*numbers), axis=1)

    def at_corners(self, low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
        """Return at each of CORNERS what the nodes of the two planes have there, (n,)."""
        found = dict[tuple[int, int, int], np.ndarray]()
        for x, (plane, values) in enumerate(((self.low, low), (self.high, high))):
            for y in (0, 1):
                places = plane.nodes.find(self.cells.keys + y * self.width)
                for z in (0, 1):  # the next key is the next node
                    found[x, y, z] = values[places + z]
        return [found[corner] for corner in CORNERS]

    @cached_property
    def faces(self) -> list[np.ndarray]:
        """The places of the cells that have a face in each of SIDES."""
        keys, own = self.cells.keys, self.cells
        neighbours = (
            self.below.find(keys),
            self.above.find(keys),
            own.find(keys - self.width),
            own.find(keys + self.width),
            own.find(keys - 1),
            own.find(keys + 1),
        )
        return [np.flatnonzero(found < 0) for found in neighbours]

    def nodes(self) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """Yield of each new plane its x, the number of its first node, and the y and z of its nodes
        in cells, counted from the low corner."""
        for x, first, places in self.new:
            y, z = np.divmod(places.keys, self.width)
            yield x, first, y - 1, z - 1


class Sizes(NamedTuple):
    """How many nodes and cells there are, how many faces in each of SIDES, and the cells of the
    largest layer."""

    nodes: int
    cells: int
    faces: tuple[int, ...]
    largest: int


@dataclass(frozen=True, eq=False)
class Hexahedra:
    """The hexahedra of an image's cells whose value is not zero."""

    smaller: ClassVar[str] = VoxelImage.smaller

    image: VoxelImage

    @classmethod
    def of(cls, image: VoxelImage) -> Hexahedra:
        """Return the hexahedra of an image; VoxtoolError if no cell is set."""
        found = cls(image.with_dtype(bool))
        if not found.sizes.cells:
            raise VoxtoolError("no cell is set, so there is no hexahedron: choose another part")
        return found

    @cached_property
    def sizes(self) -> Sizes:
        """The counts, by one pass over the cells."""
        nodes = cells = largest = 0
        faces = np.zeros(len(SIDES), np.int64)
        for layer in replace(self, image=replace(self.image, progress=lambda share: None)).layers():
            nodes = layer.high.first + len(layer.high.nodes)
            cells += len(layer.cells)
            largest = max(largest, len(layer.cells))
            faces += [len(found) for found in layer.faces]
        return Sizes(nodes, cells, tuple(faces.tolist()), largest)

    @property
    def host_bytes(self) -> int:
        """A bound of the memory: that of the image, and of some layers and their tables."""
        tables = 6 * 4 * min(TABLE, self._plane)
        return self.image.host_bytes + tables + CELL_BYTES * self.sizes.largest

    @property
    def _width(self) -> int:
        """Keys from one row to the next: cells and nodes of a row, and one beyond each end."""
        return self.image.shape[2] + 2

    @property
    def _plane(self) -> int:
        """The number that all keys are below."""
        return self._width * (self.image.shape[1] + 2)

    @property
    def facts(self) -> dict[str, Any]:
        """The counts, in JSON types."""
        nodes, cells, faces, _ = self.sizes
        surfaces = {side.name: count for side, count in zip(SIDES, faces, strict=True)}
        return {
            "hexahedra": cells,
            "nodes": nodes,
            "materials": {MATERIAL: cells},
            "surfaces": {**surfaces, BOUNDARY: sum(faces)},
        }

    @property
    def text(self) -> str:
        """The counts, for people."""
        nodes, cells, faces, _ = self.sizes
        return f"{cells:,} hexahedra, {nodes:,} nodes, {sum(faces):,} faces of the boundary"

    def coordinates(self) -> list[np.ndarray]:
        """Return the world coordinates of the nodes along each axis, by their cell."""
        image = self.image
        return [
            origin + pitch * np.arange(n + 1)
            for origin, pitch, n in zip(image.origin, image.pitch, image.shape, strict=True)
        ]

    def layers(self) -> Iterator[Layer]:
        """Yield the layers along x that have cells."""
        none = Places(np.empty(0, np.int64), 0)
        before, high = (-2, none), Plane(-2, 0, none)
        first = 0
        for here, after in pairwise(chain(self._cells(), [(-2, none)])):
            x, cells = here
            below = before[1] if before[0] == x - 1 else none
            above = after[1] if after[0] == x + 1 else none
            end = high.first + len(high.nodes)
            low = high if high.x == x else self._nodes(x, end, cells)
            if low is not high:
                end += len(low.nodes)
            new, high = (() if low is high else (low,)), self._nodes(x + 1, end, cells, above)
            yield Layer(x, first, self._width, cells, low, high, (*new, high), below, above)
            before = here
            first += len(cells)

    def _nodes(self, x: int, first: int, *cells: Places) -> Plane:
        """Return the plane of nodes between layers."""
        steps = (0, 1, self._width, self._width + 1)
        parts = [part.keys + step for part in cells if len(part) for step in steps]
        return Plane(x, first, Places.united(parts, self._plane))

    def _cells(self) -> Iterator[tuple[int, Places]]:
        """Yield each layer that has cells: its x and the keys of its cells."""
        dtype = np.int32 if self._plane < 1 << 31 else np.int64
        for cells in self.image.coordinates():
            x = cells[:, 0]
            keys = (cells[:, 1].astype(dtype) + 1) * self._width + cells[:, 2] + 1
            starts = np.flatnonzero(np.diff(x, prepend=-1))
            for start, end in pairwise([*starts.tolist(), len(x)]):
                yield int(x[start]), Places(keys[start:end].astype(dtype), self._plane)
