"""One level of a field under construction: its refined cells, on the device.

The list of a cell contains the nearest triangle to every point of the cell. Children inherit the
part of the list that they need, so lists shrink with the cells, and no tree is searched.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.bounds import JUMP, bound_values
from voxtool.opencl import program

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.adf.plan import FieldPlan
    from voxtool.adf.survey import Survey
    from voxtool.opencl import Array, Device

KEPT = 32  # triangles of a cell that are combined in pairs, at most
NO_TRIANGLE = OUT_OF_CUBE = 0xFFFFFFFF
COARSE = OUT_OF_CUBE - 1  # a neighbour that is a leaf, or lies within one
UNKNOWN, OUTSIDE, INSIDE = 0, 1, 2  # sides of the mesh

HEADERS = {
    "adf/levels/level.h": program.c_constants(
        JUMP=JUMP,
        KEPT=KEPT,
        NO_TRIANGLE=NO_TRIANGLE,
        OUT_OF_CUBE=OUT_OF_CUBE,
        COARSE=COARSE,
        UNKNOWN=UNKNOWN,
        OUTSIDE=OUTSIDE,
        INSIDE=INSIDE,
    )
}


@dataclass
class Parents:
    """The arrays that a level reads of the level above.

    values : float64, 27 a cell; states : uint8, or None; neighbours : uint32, 27 a cell, or None;
    ranks : uint32, for each child the number of refined children before it.
    """

    values: Array | None
    states: Array | None
    neighbours: Array | None
    ranks: Array | None


@dataclass
class Level:
    """The refined cells of a level, on the device.

    number : of the level; the root has level 0.
    count : cells.
    identifiers : uint64, rising; sources : uint32, which child of the level above each cell is.
    begins, items : uint32, where the list of each cell begins, and the triangles of all lists.
    values : float64, 27 a cell, the distances of its block.
    masks, needed : uint8 an item, the children that need it; uint32 a child, its number of items.
    states : uint8, the side of the mesh of each cell; doubts : uint32, the vertices of each block
        whose signs are unknown.
    neighbours : uint32, 27 a cell, see find_neighbours.
    ranks : uint32, a child: whether it is refined, then the number of refined children before it.
    """

    number: int
    count: int
    identifiers: Array
    sources: Array
    begins: Array
    items: Array
    above: Parents | None = None
    values: Array | None = None
    masks: Array | None = None
    needed: Array | None = None
    states: Array | None = None
    doubts: Array | None = None
    neighbours: Array | None = None
    ranks: Array | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Kernel arguments by name: the cells and their lists."""
        return {
            "identifiers": self.identifiers,
            "level": self.number,
            "sources": self.sources,
            "begins": self.begins,
            "items": self.items,
        }


@dataclass
class Construction:
    """The data that the stages of all levels share.

    arguments : of kernels, by name: the triangles and the data that separate inside from outside.
    options : -D options of the kernels.
    bound_values : float64, of each code; steepest : uint32, the bits of the steepest slope of a
        leaf; unbalanced : uint32, whether a leaf has a neighbour coarser by two levels.
    """

    survey: Survey
    plan: FieldPlan
    arguments: dict[str, Any] = field(init=False)
    options: dict[str, int] = field(init=False)
    bound_values: Array = field(init=False)
    steepest: Array = field(init=False)
    unbalanced: Array = field(init=False)

    def __post_init__(self) -> None:
        self.arguments = dict(self.survey.arguments)
        self.options = {}
        if self.plan.sign != "none":
            self.options["SIGNED"] = 1
            self.options["CLOSED" if self.plan.certain else "JUMPS"] = 1
            if self.plan.flat:
                self.options["FLAT"] = 1
        if self.plan.sign == "winding":
            self.options["WINDING"] = 1
            self.arguments |= self.survey.winding_arguments
        self.bound_values = self.device.put(bound_values())
        self.steepest = self.device.zeros(1, np.uint32)
        self.unbalanced = self.device.zeros(1, np.uint32)

    @property
    def device(self) -> Device:
        return self.survey.device

    @property
    def side(self) -> float:
        """The cube's side, in the frame."""
        return 2 * self.survey.extent

    def kernel(self, source: str, name: str) -> Callable[..., None]:
        """Return a kernel with the options of this construction."""
        return self.device.kernel(source, name, **self.options)

    def root(self) -> Level:
        """Return the root, whose list contains every triangle without duplicates."""
        put, triangles = self.device.put, self.survey.distinct_triangles()
        level = Level(
            0, 1, put(np.ones(1, np.uint64)), put(np.zeros(1, np.uint32)),
            put(np.array([0, len(triangles)], np.uint32)), put(triangles),
        )  # fmt: skip
        alone = np.full(27, OUT_OF_CUBE, np.uint32)
        alone[13] = 0
        level.neighbours = put(alone)
        return level
