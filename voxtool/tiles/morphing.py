"""Dilation, erosion, opening, closing and shells of octrees that are larger than memory, window by
window. What a window becomes depends on the voxels within the reach of the element, at each pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from voxtool.choices import ELEMENTS
from voxtool.errors import MemoryLimitError
from voxtool.files.octrees.windows import Key
from voxtool.grid import Grid
from voxtool.job import Cost
from voxtool.opencl import Device
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.links import EMPTY, FULL
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.morphology import MorphJob, MorphPlan, batch_of, plan_of, why_empty
from voxtool.svo.sets.tiling import LEVEL, Box, Tiling
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.operations import Operand, OperationJob, fits

BOUNDARY = 2  # times the mixed tiles that the boundary is predicted to have


class MorphWindowsJob(OperationJob):
    """A morphological operation that runs window by window."""

    whole: MorphPlan

    def __init__(
        self, whole: MorphPlan, octree: OctreeContent, device: Device, max_memory: int | None
    ) -> None:
        self.octree = octree
        self.margin = whole.passes * max(whole.element.reach)
        super().__init__(whole, [Operand(octree, -np.array(whole.low))], device, max_memory)

    @property
    def _sources(self) -> list[OctreeContent]:
        return [self.octree]

    @property
    def _described(self) -> dict[str, Any]:
        return {"plan": {}, "units": self.octree.units, "transform": self.octree.transform}

    def findings(self, result: BlockOctree) -> Iterator[str]:
        """Yield why the result is empty."""
        return why_empty(self.whole, self.octree.count, result.count)

    def _cost(self, side: int) -> Cost:
        mixed = int(self.sizes(self.operands[0], side)[LEVEL - 1 : LEVEL].sum())
        wide = (1 + 2 * self.margin / side) ** 2
        return self._planned(int(BOUNDARY * wide * mixed)).cost

    def _planned(self, tiles: int) -> MorphPlan:
        """Return the plan for a window, given the number of its tiles. Batches leave room for what
        the host holds, but take a quarter of the memory, as small ones are slow."""
        plan, most = replace(self.whole, tiles=tiles), self.max_memory
        if most is not None:
            most = max(most - plan.cost.host, most // 4)
        return replace(plan, batch=batch_of(plan.element, tiles, most))

    def _state(self, key: Key) -> int:
        state = self.operands[0].state(key, self.margin)
        return EMPTY if state == FULL and self.whole.operation == "shell" else state

    def _window(self, key: Key, grid: Grid) -> Octree:
        part, low = self.operands[0].part(key, self.margin, self.limit)
        element = self.whole.element
        voxels, box = Tiling.of(part, max(element.reach)), Box(-low, grid.side - low)
        tiles = len(voxels.boundary(box.grown(element.reach, self.whole.passes)))
        x, y, z = (-low).tolist()
        plan = replace(self._planned(tiles), grid=grid, low=(x, y, z))
        return self._made_by(MorphJob(part, voxels, plan, self.device, self.max_memory), grid)


def plan_unread(
    octree: OctreeContent,
    operation: str,
    radius: float,
    world: bool,
    shape: str,
    max_memory: int | None,
) -> MorphPlan:
    """Return the plan of an operation in one piece, whose tiles are predicted."""
    above = octree.offsets.astype(np.int64)[-LEVEL - 1 :]
    tiles = BOUNDARY * int(above[1] - above[0]) // 8 if len(above) > LEVEL else 1
    return plan_of(octree, operation, radius, world, shape, tiles, max_memory)


def morph_windows(
    octree: OctreeContent,
    operation: str,
    radius: float,
    *,
    world: bool = False,
    shape: str = ELEMENTS[0],
    device: Device,
    max_memory: int | None = None,
) -> MorphWindowsJob | None:
    """Return the job of an operation in windows, or None if it fits in memory, or if
    windows do not fit either; see `voxtool.morph`."""
    whole = plan_unread(octree, operation, radius, world, shape, max_memory)
    if fits(whole.cost, [octree], [octree], device, max_memory):
        return None
    with suppress(MemoryLimitError):
        return MorphWindowsJob(whole, octree, device, max_memory)
    return None
