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
from typing import Any, ClassVar, NamedTuple

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.svo.image import VoxelImage
from voxtool.svo.rows import Places, Rows, layers_of

# The corners of a cell, x, y and z, in the order of VTK, Gmsh and Abaqus.
CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
MATERIAL = "solid"
BOUNDARY = "boundary"  # all six surfaces
TABLES = 6  # of keys, at once
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
        return self.image.host_bytes + TABLES * self._rows.bytes + CELL_BYTES * self.sizes.largest

    @property
    def _rows(self) -> Rows:
        return Rows.of(self.image)

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
        rows, high, first = self._rows, Plane(-2, 0, Places(np.empty(0, np.int64), 0)), 0
        for x, below, cells, above in layers_of(self.image):
            if not len(cells):
                continue
            end = high.first + len(high.nodes)
            low = high if high.x == x else self._nodes(x, end, cells)
            if low is not high:
                end += len(low.nodes)
            new, high = (() if low is high else (low,)), self._nodes(x + 1, end, cells, above)
            yield Layer(x, first, rows.width, cells, low, high, (*new, high), below, above)
            first += len(cells)

    def _nodes(self, x: int, first: int, *cells: Places) -> Plane:
        """Return the plane of nodes between layers."""
        rows = self._rows
        steps = (0, 1, rows.width, rows.width + 1)
        parts = [part.keys + step for part in cells if len(part) for step in steps]
        return Plane(x, first, Places.united(parts, rows.size))
