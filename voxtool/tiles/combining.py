"""Combinations of octrees that are larger than memory, window by window."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError
from voxtool.files.octrees.windows import Key
from voxtool.grid import Grid
from voxtool.job import Cost
from voxtool.svo.cells.subtrees import cube
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import CombineJob, CombinePlan, Terms, plan_of
from voxtool.tiles.operations import Operand, OperationJob, fits


class CombineWindowsJob(OperationJob):
    """A combination that runs window by window."""

    whole: CombinePlan

    def __init__(self, job: CombineJob, octrees: Sequence[OctreeContent]) -> None:
        self._job, self._terms = job, Terms.of(job.plan.operation, len(octrees))
        operands = [Operand(*each) for each in zip(octrees, job.lows, strict=True)]
        super().__init__(job.plan, operands, job.device, job.max_memory)

    @property
    def _sources(self) -> Sequence[OctreeContent]:
        return self._job.sources

    @property
    def _described(self) -> dict[str, Any]:
        return self._job.described

    def _cost(self, side: int) -> Cost:
        sizes = [self.sizes(operand, side) for operand in self.operands]
        lows = np.array([operand.low % side for operand in self.operands])
        return plan_of(sizes, lows, cube(side), self.whole.operation).cost

    def _state(self, key: Key) -> int:
        return self._terms.state(np.array([operand.state(key) for operand in self.operands]))

    def _window(self, key: Key, grid: Grid) -> Octree:
        parts, lows = zip(
            *(operand.part(key, 0, self.limit) for operand in self.operands), strict=True
        )
        low = np.array(lows)
        sizes = [np.diff(part.offsets.astype(np.int64))[:0:-1] // 8 for part in parts]
        plan = plan_of(sizes, low, grid, self.whole.operation)
        return self._made_by(CombineJob(list(parts), low, plan, self.device, self.max_memory), grid)


def combine_windows(job: CombineJob, octrees: Sequence[OctreeContent]) -> CombineWindowsJob | None:
    """Return the job of a combination in windows, or None if it fits in memory, or if
    windows do not fit either."""
    if fits(job.cost, octrees, job.sources, job.device, job.max_memory):
        return None
    with suppress(MemoryLimitError):
        return CombineWindowsJob(job, octrees)
    return None
