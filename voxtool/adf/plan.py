"""How the distance field of a mesh will be built, and what its upper levels foretell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from voxtool.errors import MemoryLimitError, count_of, human

if TYPE_CHECKING:
    from collections.abc import Sequence

BLOCK_BYTES = 27 * 4 + 8 + 8 + 1  # voxels, cell, bounds, and about as much of the hash
NARROW_LEVEL = 11  # of leaves up to which identifiers of their parents fit 32 bits
PILOT_LEVEL = 5  # of cells, down to which a field is built to foretell the rest
GROWTH = 4  # of refined cells from level to level, at most about: they lie along surfaces
CELL_BYTES = 27 * (8 + 4 + 4 + 8) + 8 + 2 * 4 + 8 * (4 + 4 + 1 + 4)  # of a refined cell's arrays
ITEM_BYTES = 5  # of a triangle in a list, and of what is known of it


@dataclass(frozen=True)
class FieldPlan:
    """How a field will be built.

    triangles : of the mesh; flat : of these, without area; crossed : that others meet; closed : the
    mesh is, is wound consistently, does not meet itself, and its shells agree on what is inside.
    sign, tolerance, max_level, band, continuous, bounds, max_bytes : as asked.
    refined : cells that are refined, of each level from 0 on, as far as was counted.
    items : triangles in the lists of the last of these.
    """

    triangles: int
    flat: int
    crossed: int
    closed: bool
    sign: str
    tolerance: float
    max_level: int
    band: float
    continuous: bool
    bounds: bool
    max_bytes: int | None
    refined: tuple[int, ...] = ()
    items: int = 0

    @property
    def certain(self) -> bool:
        """Whether signs are, so that none jumps."""
        return self.closed and self.sign == "pseudonormal"

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order; those from sample to hand down once a level."""
        return [
            "tree",
            *(["self-intersections"] if self.sign != "none" else []),
            *(["moments"] if self.sign == "winding" else []),
            "sample",
            *(["signs", "winding number"] if self.sign == "winding" else []),
            *(["constrain"] if self.continuous else []),
            "examine",
            "hand down",
            "hash",
            "errors",
        ]

    def left_out(self) -> dict[str, str]:
        """What is not compiled, allocated or run, and why."""
        out = {}
        if self.sign != "winding":
            out["winding numbers"] = (
                "distances have no sign" if self.sign == "none" else "the sign is by pseudo-normals"
            )
        if self.sign == "none":
            out["pseudo-normals"] = "distances have no sign"
        elif not self.flat:
            out["faces without a side"] = "every face has an area"
        if self.certain or self.sign == "none":
            out["search for jumps of the sign"] = (
                "the mesh is closed" if self.certain else "distances have no sign"
            )
        if not self.continuous:
            out["neighbours and constraints"] = "cracks are allowed"
        if not self.bounds:
            out["bounds texture"] = "no bounds are asked for"
        if self.max_level <= NARROW_LEVEL:
            out["64-bit identifiers"] = (
                f"leaves end at level {self.max_level}, of {NARROW_LEVEL} that 32 bits serve"
            )
        return out

    def predicted(self) -> list[int]:
        """Refined cells of each level: counted, then GROWTH times as many, at most about."""
        counts = list(self.refined)
        while counts and counts[-1] and len(counts) < self.max_level:
            counts.append(GROWTH * counts[-1])
        if self.max_bytes is not None:
            left = self.max_bytes // BLOCK_BYTES
            for level, count in enumerate(counts):
                counts[level] = min(count, left)
                left -= counts[level]
        return counts

    @property
    def blocks(self) -> int:
        """Predicted, at most about."""
        return sum(self.predicted())

    @property
    def field_bytes(self) -> int:
        return BLOCK_BYTES * self.blocks

    @property
    def device_bytes(self) -> int:
        """Predicted peak of memory, at most about."""
        return self._bytes(self.predicted(), max(self.items, self.triangles))

    def _bytes(self, counts: Sequence[int], items: int) -> int:
        """Of so many cells, level by level, and a level's lists: twice the field, two levels in
        work, and two levels' lists, which have about as many triangles in all."""
        return (
            2 * BLOCK_BYTES * sum(counts) + CELL_BYTES * sum(counts[-2:]) + 2 * ITEM_BYTES * items
        )

    def scene(self) -> dict[str, Any]:
        """What the plan says of the scene, to be stored with the output: JSON types only."""
        return {
            "triangles": self.triangles,
            "crossed_triangles": self.crossed,
            "closed": self.closed,
            "stages": self.stages,
            "left_out": self.left_out(),
        }

    def as_dict(self) -> dict[str, Any]:
        """All of it, the costs included: JSON types only."""
        return {
            **self.scene(),
            "refined_cells": list(self.refined),
            "predicted_blocks": self.blocks,
            "predicted_field_bytes": self.field_bytes,
            "predicted_device_bytes": self.device_bytes,
        }

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Refuse what has been counted, and needs more.

        Parameters
        ----------
        max_memory, max_allocation : bytes that the device may use in all, and in one buffer.

        Raises
        ------
        MemoryLimitError : with the level that fits.
        """
        counts, level = self.refined, len(self.refined) - 1
        needed = self._bytes(counts, self.items)
        largest = max(8 * 27 * counts[-1], 4 * self.items)
        if needed <= max_memory and largest <= max_allocation and self.items < 1 << 32:
            return
        fits = f"--max-level {level} fits, or " if level else ""
        raise MemoryLimitError(
            f"{count_of(counts[-1], 'cell')} of level {level} would need {human(needed)} of memory "
            f"({human(largest)} in one buffer), of {human(max_memory)} ({human(max_allocation)}) "
            f"allowed: {fits}ask for a larger --tolerance, a --band or "
            "--max-bytes (see --max-memory)"
        )
