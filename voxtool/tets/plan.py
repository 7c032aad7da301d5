"""The plan of the textures of a mesh of volume cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from voxtool.errors import MemoryLimitError, human
from voxtool.job import Cost
from voxtool.tets.merge import MAX_PAIRS

PIECES = {"tetra": 1, "pyramid": 2, "wedge": 3, "hexahedron": 6}  # tetrahedra of a cell, at most
CELL_BYTES = {"raycast": 116, "projection": 104, "hexahedra": 186}  # of its textures, with vertices
WORK_BYTES = {"raycast": 560, "projection": 560, "hexahedra": 2400}  # at most about: measured
POINT_BYTES = 150  # of a point, while coincident ones are merged


@dataclass(frozen=True)
class VolumePlan:
    """The plan of a volume.

    layout, merge_distance : as asked.
    cells : of the mesh, by kind; ignored : cells that are no volumes, by kind.
    points : of the mesh.
    constant : whether the scalar is one a cell.
    max_pairs : pairs of points, compared for merging, beyond which the work is refused.
    """

    layout: str
    merge_distance: float
    cells: dict[str, int]
    ignored: dict[str, int]
    points: int
    constant: bool
    max_pairs: int = MAX_PAIRS

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order."""
        cells = "hexahedra" if self.layout == "hexahedra" else "tetrahedra"
        return [cells, "order", "planes", "gradients"]

    @property
    def left_out(self) -> dict[str, str]:
        """What is not done or stored, and why."""
        out = {}
        if self.cells.keys() == {"tetra"}:
            out["splitting"] = "every cell is a tetrahedron"
        elif self.layout == "hexahedra":
            out["splitting"] = "hexahedra stay whole"
        if not self.merge_distance:
            out["merging by distance"] = "only points at the same position are merged"
        if self.constant:
            out["non-zero gradients"] = "each cell has one scalar"
        if self.layout == "projection":
            out["offsets of planes and scalar terms"] = "anchors serve, as in table 4 of [TetVol]"
        else:
            out["anchors"] = "planes have offsets, as in table 5 of [TetVol]"
        return out

    @property
    def predicted_cells(self) -> int:
        """The largest possible number of cells."""
        if self.layout == "hexahedra":
            return sum(self.cells.values())
        return sum(PIECES[kind] * count for kind, count in self.cells.items())

    @property
    def volume_bytes(self) -> int:
        """The approximate largest size of the textures in bytes."""
        return CELL_BYTES[self.layout] * self.predicted_cells

    @property
    def work_bytes(self) -> int:
        """Predicted peak of memory, at most about."""
        return WORK_BYTES[self.layout] * self.predicted_cells + POINT_BYTES * self.points

    def scene(self) -> dict[str, Any]:
        """What the plan says of the mesh, to be stored with the output: JSON types only."""
        return {
            "cells": self.cells,
            "ignored": self.ignored,
            "points": self.points,
            "stages": self.stages,
            "left_out": self.left_out,
        }

    def as_dict(self) -> dict[str, Any]:
        """All of it, the costs included: JSON types only."""
        return {
            "layout": self.layout,
            "merge_distance": self.merge_distance,
            **self.scene(),
            "predicted_cells": self.predicted_cells,
            "predicted_volume_bytes": self.volume_bytes,
            "predicted_work_bytes": self.work_bytes,
        }

    @property
    def cost(self) -> Cost:
        """The memory that the work will take at most, about."""
        return Cost(0, host=self.work_bytes)

    def rows(self) -> list[tuple[str, str]]:
        """What `--plan` prints before the stages."""
        read = ", ".join(f"{count:,} {kind}" for kind, count in self.cells.items())
        return [
            ("volume", f"layout {self.layout}, merge distance {self.merge_distance:g}"),
            ("mesh", f"{read}, {self.points:,} points"),
            ("cells", f"at most {self.predicted_cells:,}, {human(self.volume_bytes)}"),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError if the work needs more bytes of memory; the message says what
        would fit."""
        del max_allocation  # it runs on the host
        if self.work_bytes <= max_memory:
            return
        fits = self.predicted_cells * max_memory // self.work_bytes
        raise MemoryLimitError(
            f"{self.predicted_cells:,} cells would need {human(self.work_bytes)} of memory, of "
            f"{human(max_memory)} allowed: about {fits:,} fit; cut the mesh into parts, or see "
            "--max-memory"
        )
