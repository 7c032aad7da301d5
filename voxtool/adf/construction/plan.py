"""The plan of a distance field: its decisions, and predictions from its upper levels.

Levels are counted from the root, which has level 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from voxtool.adf.field.field import FAR
from voxtool.adf.field.packing import most_blocks
from voxtool.choices import (
    DEFAULT_MAX_LEVEL,
    DEFAULT_TEXTURE_3D,
    DEFAULT_TOLERANCE,
    FIELD_SIGNS,
    MAX_LEVEL,
    MAX_TEXTURE_3D,
    MIN_TEXTURE_3D,
)
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of, human
from voxtool.job import Cost, Plan

VOXEL_BYTES = 27 * 4  # bytes of a block
BLOCK_BYTES = VOXEL_BYTES + 8 + 8 + 1  # and cell, bounds, and about as much of the hash
HASH_BYTES = 86  # bytes of a block, while the hash is made
NARROW_LEVEL = 11  # leaves up to this level have parents with 32-bit identifiers
WINDOW = 1 << 16  # cells that are sampled and examined at once
LEAST_WINDOW = 1 << 10  # the same where memory is short
PILOT_LEVEL = 5  # a field is built down to this level to predict the rest
GROWTH = 4  # factor from level to level, at most about: refined cells lie along surfaces
CELL_BYTES = 27 * (8 + 3 * 4 + 8) + 8 + 2 * 4 + 16 + 8 * (8 + 3 * 4 + 2)  # bytes of a refined cell
SIDED_BYTES = 27 * 4  # more where triangles without area are left out of signs
LEFT_BYTES = 27 * (8 + 4) + 1 + 2 * 8  # what a cell leaves to its children, and theirs, about
RANK_BYTES = 2 * 8 * 4  # the flags and ranks of its children
ITEM_BYTES = 5  # a triangle in a list, and its mask
BALL_BYTES = 1  # bytes of a triangle in a list while it is sampled, beside CELL_BYTES


@dataclass(frozen=True)
class FieldPlan(Plan):
    """The decisions of a build, and the cells counted so far.

    triangles, flat, crossed, undecided: number of triangles, of those without area, of those that
    intersect others, and of those that may; closed: as of Survey. sign to measure: as requested.
    stored: whether voxels and levels wait on the disk; window: cells that are sampled and
    examined at once. refined: number of refined cells of each
    level counted so far; items: triangles in the lists of the last counted level.
    """

    facts = ("triangles", "crossed_triangles: crossed", "closed")
    predicted = ("blocks", "field_bytes", "disk_bytes: disk")

    triangles: int
    sign: str
    tolerance: float = DEFAULT_TOLERANCE
    max_level: int = DEFAULT_MAX_LEVEL
    band: float = math.inf
    continuous: bool = True
    bounds: bool = True
    guarantee: bool = False
    everywhere: bool = False
    max_bytes: int | None = None
    measure: bool = True
    max_texture: int = DEFAULT_TEXTURE_3D
    flat: int = 0
    crossed: int = 0
    undecided: int = 0
    closed: bool = False
    stored: bool = False
    window: int = WINDOW
    refined: tuple[int, ...] = ()
    items: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.tolerance <= FAR:
            raise VoxtoolError(f"tolerance {self.tolerance:g}: give 0 to {FAR:g} sides of the cube")
        if not 1 <= self.max_level <= MAX_LEVEL:
            raise VoxtoolError(f"max level {self.max_level}: choose 1 to {MAX_LEVEL}")
        if not (0 <= self.band <= FAR or self.band == math.inf):
            raise VoxtoolError(f"band {self.band:g}: give 0 to {FAR:g} sides of the cube, or inf")
        if self.sign and self.sign not in FIELD_SIGNS:
            raise VoxtoolError(f"sign {self.sign!r}: choose one of {', '.join(FIELD_SIGNS)}")
        if self.max_bytes is not None and self.max_bytes < BLOCK_BYTES:
            raise VoxtoolError(f"max bytes {self.max_bytes}: one block takes {BLOCK_BYTES}")
        if not MIN_TEXTURE_3D <= self.max_texture <= MAX_TEXTURE_3D:
            raise VoxtoolError(
                f"max texture {self.max_texture}: choose {MIN_TEXTURE_3D} to {MAX_TEXTURE_3D}"
            )

    @property
    def certain(self) -> bool:
        """True if all signs are certain, so that there is no sign discontinuity."""
        return self.closed and self.sign == "pseudonormal"

    @property
    def stages(self) -> list[str]:
        """The stages that will run, in order; those from sample to refine once a level."""
        return [
            "tree",
            *(["self-intersections"] if self.sign != "none" else []),
            *(["moments"] if self.sign == "winding" else []),
            "sample",
            *(["signs", "winding number"] if self.sign == "winding" else []),
            *(["constrain"] if self.continuous else []),
            "examine",
            "refine",
            "hash",
            *(["errors"] if self.measure else []),
        ]

    @property
    def reasons(self) -> dict[str, str]:
        unsigned = "distances have no sign" if self.sign == "none" else ""
        other_sign = "the sign is by pseudo-normals" if self.sign == "pseudonormal" else ""
        narrow = f"leaves end at level {self.max_level}, of {NARROW_LEVEL} that 32 bits serve"
        return {
            "winding numbers": unsigned or other_sign,
            "pseudo-normals": unsigned,
            "faces without a side": "" if unsigned or self.flat else "every face has an area",
            "search for jumps of the sign": "the mesh is closed" if self.certain else unsigned,
            "neighbours and constraints": "" if self.continuous else "cracks are allowed",
            "bounds texture": "" if self.bounds else "no bounds are requested",
            "64-bit identifiers": narrow if self.max_level <= NARROW_LEVEL else "",
            "error measurement": "" if self.measure else "not requested",
        }

    def refined_cells(self) -> list[int]:
        """Return the refined cells of each level: counted, then predicted by GROWTH."""
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
        """The predicted number of blocks, approximately an upper bound."""
        return sum(self.refined_cells())

    @property
    def cost(self) -> Cost:
        """The peak memory of the build, approximately an upper bound."""
        return self._cost(self.refined_cells())

    def fitting(self, max_memory: int, max_allocation: int) -> FieldPlan:
        """Return the plan that is predicted to fit, as far as stores and smaller windows help."""
        if not self.cost.shortage(max_memory, max_allocation):
            return self
        plan = replace(self, stored=True)
        while plan.cost.shortage(max_memory, max_allocation) and plan.window > LEAST_WINDOW:
            plan = replace(plan, window=plan.window // 2)
        return plan

    def _cost(self, counts: Sequence[int]) -> Cost:
        """Return the memory for these refined cells: that of a window; its lists and those of its
        children, and as long as they are not stored those of two levels, which have about the same
        length; what two levels leave to their children; and twice the field, of which a store
        takes the voxels."""
        last = len(counts) == self.max_level
        above = list(counts[:-1] if last else counts)[-2:]
        most, items = max(counts, default=0), max(self.items, self.triangles)
        window = most if self.max_bytes is not None else min(most, self.window)
        blocks, lists = sum(counts), 2 * ITEM_BYTES + BALL_BYTES
        device = (CELL_BYTES + SIDED_BYTES * (self.flat > 0)) * window + RANK_BYTES * sum(above)
        if self.stored:
            items = int(items * min(1.0, self.window / max(*self.refined, 1)))
            device += LEFT_BYTES * window + lists * items + HASH_BYTES * blocks
            host = (BLOCK_BYTES - VOXEL_BYTES) * blocks
            return Cost(device, host, max(8 * 27 * window, 4 * items))
        device += LEFT_BYTES * sum(above) + lists * items + 2 * BLOCK_BYTES * blocks
        return Cost(device, BLOCK_BYTES * blocks, max(8 * 27 * window, 4 * items))

    @property
    def disk(self) -> int:
        """Bytes of the disk that voxels and levels are predicted to take while they wait."""
        if not self.stored:
            return 0
        counts = self.refined_cells()
        waiting = LEFT_BYTES * sum(counts[-3:-1]) + ITEM_BYTES * max(self.items, self.triangles)
        return VOXEL_BYTES * sum(counts) + waiting

    @property
    def field_bytes(self) -> int:
        """The predicted bytes of the field."""
        return BLOCK_BYTES * self.blocks

    def as_dict(self) -> dict[str, Any]:
        refined = {"refined_cells": list(self.refined)}
        return {**self.decisions(), **refined, **super().as_dict()}

    def rows(self) -> list[tuple[str, str]]:
        counted = ", ".join(f"{count:,}" for count in self.refined)
        decided = f"tolerance {self.tolerance:.3g} sides, levels to {self.max_level}"
        cells = f"{counted} cells are refined, of level 0, 1, ..."
        waits = f"about {human(self.disk)}, of voxels and levels that wait for their turn"
        return [
            ("field", f"{decided}, sign {self.sign}"),
            ("scene", f"{self.triangles:,} triangles; {cells}"),
            ("blocks", f"at most about {self.blocks:,}, {human(self.field_bytes)}"),
            *([("disk", waits)] if self.stored else []),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Raise MemoryLimitError, with the level that fits, if the levels counted so far need more
        bytes on the device in total, or in one buffer, or more texels than a texture may have."""
        cost, level = self._cost(self.refined), len(self.refined) - 1
        fitting = cost.device <= max_memory and cost.largest <= max_allocation
        room, fits = (
            most_blocks(self.max_texture),
            f"--max-level {level} fits, or " if level else "",
        )
        if sum(self.refined) > room:
            raise MemoryLimitError(
                f"{sum(self.refined):,} blocks down to level {level} do not fit a texture of "
                f"{self.max_texture}^3 texels, which has room for {room:,}: {fits}ask for a larger "
                f"--tolerance, a --band or --max-bytes {BLOCK_BYTES * room} (see --max-texture)"
            )
        if fitting and self.items < 1 << 32:
            return
        cells, most = count_of(self.refined[-1], "cell"), human(max_memory)
        raise MemoryLimitError(
            f"{cells} of level {level} would need {human(cost.device)} of memory "
            f"({human(cost.largest)} in one buffer), of {most} ({human(max_allocation)}) allowed: "
            f"{fits}ask for a larger --tolerance, a --band or --max-bytes (see --max-memory)"
        )
