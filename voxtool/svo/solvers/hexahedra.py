"""The set cells of an image as hexahedra that share nodes, layer by layer.

Nodes are numbered plane by plane along x, and hexahedra layer by layer, both in lexicographic order
of x, y and z. A layer needs its neighbours alone: three layers of cells and two planes of nodes are
held at once, so the numbers are the same however the image is read.

The labels of the cells are their materials. The boundary is every face between a hexahedron and
what is none, in six surfaces by the direction that a face looks to. The faces between two materials
are a surface, too; they belong to the hexahedra of the lower label.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.svo.images.attribute_image import AttributeImage, listed_with
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.images.neighbour_layers import Places, Rows, layers_of

# The corners of a cell, x, y and z, in the order of VTK, Gmsh and Abaqus.
CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
MATERIAL = "solid"  # of hexahedra without labels; its number is 1
BOUNDARY = "boundary"  # all six surfaces
LETTERS, MORE_LETTERS = 32, 70  # of names of materials and of surfaces, at most
TABLES = 6  # of keys, at once
CELL_BYTES = 512  # bytes of memory for a cell of the largest layer, and for its nodes and faces


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


class Key(NamedTuple):
    """A part of a surface: the faces between two materials, by their numbers, the lower one first,
    that look to a side; 0 and 0 for the boundary."""

    low: int
    high: int
    side: int


class Surface(NamedTuple):
    """A named surface: its parts, by the directions to which their faces look."""

    name: str
    parts: tuple[Key, ...]


def between(side: int, own: np.ndarray, beyond: np.ndarray) -> list[tuple[Key, np.ndarray]]:
    """Return the places of hexahedra with a face to one of a higher material, by the two.

    own, beyond : materials of the hexahedra and of those that they touch at a side, 0 for none.
    """
    cells = np.flatnonzero(beyond > own)
    pairs = own[cells].astype(np.int64) << 32 | beyond[cells]
    order = np.argsort(pairs, kind="stable")
    cells, pairs = cells[order], pairs[order]
    starts = np.flatnonzero(np.diff(pairs, prepend=-1))
    ends = [*starts[1:].tolist(), len(pairs)][: len(starts)]
    return [
        (Key(pair >> 32, pair & 0xFFFFFFFF, side), cells[start:end])
        for pair, start, end in zip(pairs[starts].tolist(), starts.tolist(), ends, strict=True)
    ]


class Part(ABC):
    """Some hexahedra that follow one another, and the nodes that none before them has."""

    count: int
    values: np.ndarray | None  # (count,) the numbers of their materials; None: all are 1

    @abstractmethod
    def at_corners(self, numbered: Callable[[int, int], np.ndarray]) -> list[np.ndarray]:
        """Return at each of CORNERS what the nodes have there, (count,).

        Parameters
        ----------
        numbered : callable
            Returns what nodes have, given the number of the first one, from 0, and their count.
        """

    @abstractmethod
    def nodes(self) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """Yield of each plane with new nodes its x, the number of its first new node, and the y and
        z of its new nodes, in cells from the low corner."""

    @property
    @abstractmethod
    def faces(self) -> list[tuple[Key, np.ndarray]]:
        """The parts of surfaces that are not empty, and the places of the hexahedra that have a
        face in each."""

    def corners(self, dtype: Any) -> np.ndarray:
        """Return the nodes of the hexahedra, counted from 0, (count, 8)."""
        return np.stack(
            self.at_corners(lambda first, count: np.arange(first, first + count, dtype=dtype)),
            axis=1,
        )

    def materials(self) -> list[tuple[int, Any]]:
        """Return the number of each material, and the places of its hexahedra."""
        values = self.values
        if values is None:
            return [(1, slice(None))]
        return [(number, values == number) for number in np.unique(values).tolist()]


@dataclass(frozen=True)
class Layer(Part):
    """The cells of a layer, and what lies beside them."""

    x: int
    width: int  # keys from one row to the next
    cells: Places
    low: Plane
    high: Plane
    new: tuple[Plane, ...]  # those of the two that no layer before it has
    below: Places  # cells of the layers at both sides
    above: Places

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.cells)

    @property
    def values(self) -> np.ndarray | None:
        """The materials of the cells."""
        return self.cells.values

    def at_corners(self, numbered: Callable[[int, int], np.ndarray]) -> list[np.ndarray]:
        """See Part."""
        found = dict[tuple[int, int, int], np.ndarray]()
        for x, plane in enumerate((self.low, self.high)):
            values = numbered(plane.first, len(plane.nodes))
            for y in (0, 1):
                places = plane.nodes.find(self.cells.keys + y * self.width)
                for z in (0, 1):  # the next key is the next node
                    found[x, y, z] = values[places + z]
        return [found[corner] for corner in CORNERS]

    @cached_property
    def faces(self) -> list[tuple[Key, np.ndarray]]:
        """See Part."""
        keys, own = self.cells.keys, self.cells
        neighbours = (
            (self.below, keys),
            (self.above, keys),
            (own, keys - self.width),
            (own, keys + self.width),
            (own, keys - 1),
            (own, keys + 1),
        )
        parts: list[tuple[Key, np.ndarray]] = []
        for side, (others, places) in enumerate(neighbours):
            found = others.find(places)
            parts.append((Key(0, 0, side), np.flatnonzero(found < 0)))
            if own.values is not None and others.values is not None:
                beyond = np.where(found >= 0, others.values[found], 0)
                parts += between(side, own.values, beyond)
        return [(key, cells) for key, cells in parts if len(cells)]

    def nodes(self) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """See Part."""
        for x, first, places in self.new:
            y, z = np.divmod(places.keys, self.width)
            yield x, first, y - 1, z - 1


class Sizes(NamedTuple):
    """The number of nodes, the cells by the number of their material, the faces by the parts
    of surfaces, and the cells of the largest layer."""

    nodes: int
    materials: dict[int, int]
    faces: dict[Key, int]
    largest: int

    @property
    def cells(self) -> int:
        """Number of hexahedra."""
        return sum(self.materials.values())

    @property
    def quads(self) -> int:
        """Number of faces of the surfaces."""
        return sum(self.faces.values())


@dataclass(frozen=True, eq=False)
class Hexahedra:
    """The hexahedra of an image's cells whose value is not zero.

    Attributes
    ----------
    image : VoxelImage
        The cells.
    labels : AttributeImage, optional
        Their labels, which are the materials.
    """

    smaller: ClassVar[str] = VoxelImage.smaller

    image: VoxelImage
    labels: AttributeImage | None = None

    @classmethod
    def of(cls, image: VoxelImage, **more: Any) -> Self:
        """Return the hexahedra of an image; VoxtoolError if no cell is set."""
        image = image.with_dtype(bool)
        there = [attribute.name for attribute in image.octree.attributes]
        labelled = "label" in there and not image.invert
        found = cls(image, AttributeImage(image, "label") if labelled else None, **more)
        if not found.sizes.cells:
            raise VoxtoolError("no cell is set, so there is no hexahedron: choose another part")
        return found

    @cached_property
    def sizes(self) -> Sizes:
        """The counts, by one pass over the cells."""
        quiet = replace(self, image=replace(self.image, progress=lambda share: None))
        return sizes_of(quiet.layers())

    @cached_property
    def _names(self) -> tuple[dict[int, str], list[Surface]]:
        """The names of the materials by their numbers, and the surfaces."""
        used = {BOUNDARY, *(side.name for side in SIDES)}
        materials = {}
        for number in self.sizes.materials:
            text = self.labels.names[number] if self.labels else MATERIAL
            materials[number] = name_of(text or f"label_{number}", used, LETTERS)
        surfaces = [Surface(side.name, (Key(0, 0, n),)) for n, side in enumerate(SIDES)]
        inner = [key for key in self.sizes.faces if key.low]
        for (low, high), parts in groupby(inner, lambda key: key[:2]):
            name = name_of(f"{materials[low]}-{materials[high]}", used, MORE_LETTERS)
            surfaces.append(Surface(name, tuple(parts)))
        return materials, surfaces

    @property
    def materials(self) -> dict[int, str]:
        """The names of the materials by their numbers, which are those of labels in exports."""
        return self._names[0]

    @property
    def surfaces(self) -> list[Surface]:
        """The six surfaces of the boundary, then those between materials."""
        return self._names[1]

    @property
    def host_bytes(self) -> int:
        """A bound of the memory: that of the image, and of some layers and their tables."""
        return self.image.host_bytes + self.own_bytes

    @property
    def own_bytes(self) -> int:
        """A bound of the memory beside that of the image."""
        labels = self.labels.own_bytes if self.labels else 0
        return labels + TABLES * self._rows.bytes + CELL_BYTES * self.sizes.largest

    @property
    def _rows(self) -> Rows:
        return Rows.of(self.image)

    @property
    def facts(self) -> dict[str, Any]:
        """The counts, in JSON types."""
        sizes = self.sizes
        surfaces = {
            surface.name: sum(sizes.faces[part] for part in surface.parts)
            for surface in self.surfaces
        }
        return {
            "hexahedra": sizes.cells,
            "nodes": sizes.nodes,
            "materials": {self.materials[n]: count for n, count in sizes.materials.items()},
            "surfaces": {**surfaces, BOUNDARY: self.boundary},
        }

    @property
    def boundary(self) -> int:
        """Number of faces of the boundary."""
        return sum(count for key, count in self.sizes.faces.items() if not key.low)

    @property
    def text(self) -> str:
        """The counts, for people."""
        sizes, count = self.sizes, len(self.sizes.materials)
        materials = f" of {count:,} materials" if count > 1 else ""
        return (
            f"{sizes.cells:,} hexahedra{materials}, {sizes.nodes:,} nodes, {self.boundary:,} faces "
            "of the boundary"
        )

    def coordinates(self) -> list[np.ndarray]:
        """Return the world coordinates of the nodes along each axis, by their cell."""
        image = self.image
        return [
            origin + pitch * np.arange(n + 1)
            for origin, pitch, n in zip(image.origin, image.pitch, image.shape, strict=True)
        ]

    def layers(self) -> Iterator[Part]:
        """Yield the layers along x that have cells."""
        rows, high = self._rows, Plane(-2, 0, Places(np.empty(0, np.int64), 0))
        labels = listed_with(self.image, ("label",)) if self.labels else None
        listed = ((cells, own) for cells, _, (own,) in labels) if labels else None
        for x, below, cells, above in layers_of(self.image, listed):
            if not len(cells):
                continue
            end = high.first + len(high.nodes)
            low = high if high.x == x else self._nodes(x, end, cells)
            if low is not high:
                end += len(low.nodes)
            new, high = (() if low is high else (low,)), self._nodes(x + 1, end, cells, above)
            yield Layer(x, rows.width, cells, low, high, (*new, high), below, above)

    def _nodes(self, x: int, first: int, *cells: Places) -> Plane:
        """Return the plane of nodes between layers."""
        rows = self._rows
        steps = (0, 1, rows.width, rows.width + 1)
        parts = [part.keys + step for part in cells if len(part) for step in steps]
        return Plane(x, first, Places.united(parts, rows.size))


def sizes_of(parts: Iterable[Part]) -> Sizes:
    """Return the counts of parts that make a mesh."""
    nodes = largest = 0
    materials, faces = Counter[int](), Counter[Key]()
    for part in parts:
        nodes += sum(len(y) for _, _, y, _ in part.nodes())
        largest = max(largest, part.count)
        for number, cells in part.materials():
            materials[number] += part.count if isinstance(cells, slice) else int(cells.sum())
        for key, cells in part.faces:
            faces[key] += len(cells)
    return Sizes(nodes, dict(sorted(materials.items())), dict(sorted(faces.items())), largest)


class Numbering:
    """The numbers of hexahedra that follow one another by their materials.

    Parameters
    ----------
    sizes : Sizes
        The hexahedra of each material.
    first : int
        The number of the first one.
    """

    def __init__(self, sizes: Sizes, first: int) -> None:
        self._next = {}
        for number, count in sizes.materials.items():
            self._next[number] = first
            first += count

    def of(self, part: Part) -> np.ndarray:
        """Return the numbers of the next part, (count,) int64."""
        found = np.empty(part.count, np.int64)
        for number, cells in part.materials():
            count = len(found[cells])
            found[cells] = np.arange(self._next[number], self._next[number] + count)
            self._next[number] += count
        return found


def name_of(text: str, used: set[str], letters: int) -> str:
    """Return a name that all solvers take, and add it to those used, without regard to case.

    It has letters, digits, _ and -, and no ending such as _S6, which sets of faces have.
    """
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", text)[:letters]
    plain = re.sub(r"_([Ss][1-6])$", r"-\1", plain)
    if not plain[0].isalpha():
        plain = f"m_{plain}"
    name, more = plain, 1
    while name.lower() in used:
        more += 1
        name = f"{plain}-{more}"
    used.add(name.lower())
    return name
