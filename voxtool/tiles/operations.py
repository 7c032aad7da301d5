"""Operations on octrees that are larger than the memory that they may take, window by window.

A window is a cube of the result's grid (subtree.py). Only those parts of each octree that can
change a window are read (svo/cells/subtrees.py), and the operation is that of octrees in memory. A
cube that is wholly empty or full is not read at all; a window that does not fit after all is
divided in eight.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, count_of, human
from voxtool.files.octrees.windows import Key, Window, Windows
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.memory import available_memory
from voxtool.opencl import Device
from voxtool.svo.cells.subtrees import Cells, cube
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.attribute_transfer import kept_bytes, kept_of, lost
from voxtool.tiles.octree import BlockOctree
from voxtool.tiles.subtree import (
    Subtree,
    disk_row,
    halves_of,
    joined,
    leaf_subtree,
    refuse_smallest,
    shape_of,
    subtree_of,
)

LEAST = 64  # voxels along a side of a window
MOST = 256  # windows along a side of the grid
AREA = 2  # times the mean number of nodes that a window is predicted to have


class Operand:
    """An octree that is read in parts.

    Parameters
    ----------
    octree : in memory or in a file.
    low : (3,) its low corner in the grid of the result, in voxels.
    """

    def __init__(self, octree: OctreeContent, low: np.ndarray) -> None:
        self.octree, self.low = octree, low
        self._cells: dict[int, Cells] = {}

    def cells(self, side: int) -> Cells:
        """Return its cells of `side` voxels, or of its own if these are fewer; of more if MOST of
        them do not reach along it."""
        side = min(max(side, self.octree.grid.side // MOST), self.octree.grid.side)
        if side not in self._cells:
            self._cells[side] = Cells(self.octree, side)
        return self._cells[side]

    def _reached(self, key: Key, margin: int) -> tuple[Cells, np.ndarray, np.ndarray]:
        """Return the cells, and the first and the last of them that a cube and `margin` voxels
        around it reach; these may lie beyond the octree."""
        cells = self.cells(key[3])
        low = key[:3] - self.low - margin
        return cells, low // cells.side, (low + key[3] + 2 * margin - 1) // cells.side

    def state(self, key: Key, margin: int = 0) -> int:
        """Return EMPTY or FULL if all of a cube and of `margin` voxels around it is so; otherwise
        REFINED."""
        cells, first, last = self._reached(key, margin)
        begin, end = np.maximum(first, 0), np.minimum(last, cells.along - 1)
        if (begin > end).any():
            return EMPTY
        found = {int(state) for state in np.unique(cells.states_of(begin, end))}
        if (begin != first).any() or (end != last).any():
            found.add(EMPTY)
        return found.pop() if len(found) == 1 else REFINED

    def part(self, key: Key, margin: int, most: float) -> tuple[Octree, np.ndarray]:
        """Return a part of the octree that holds a cube and `margin` voxels around it, and its low
        corner, counted from the cube's. MemoryLimitError if it takes more than `most` bytes."""
        cells, *reached = self._reached(key, margin)
        begin, end = (np.clip(cell, 0, cells.along - 1) for cell in reached)
        along = 1 << int((end - begin).max()).bit_length()
        low = key[:3] - self.low - begin * cells.side  # of the cube, in the part
        octree = cells.cut(begin, along, low - margin, low + key[3] + margin, most)
        return octree, -low


@dataclass(frozen=True)
class OperationPlan(Plan):
    """The windows of an operation on octrees."""

    whole: Any  # the plan of the operation in one piece
    window: Cost  # as predicted
    side: int  # voxels along a side of a window
    count: int  # predicted
    disk: int  # predicted bytes of the file, and of windows that wait for it

    @property
    def stages(self) -> Sequence[str]:
        return self.whole.stages

    @property
    def reasons(self) -> dict[str, str]:
        return {**self.whole.left_out, "cubes that are empty or full": "they are not read"}

    @property
    def cost(self) -> Cost:
        """The predicted bytes of a window."""
        return self.window

    def as_dict(self) -> dict[str, Any]:
        facts = {"windows": self.count, "window_side": self.side}
        costs = {"predicted_device_bytes": self.cost.device, "predicted_disk_bytes": self.disk}
        return {**self.whole.as_dict(), **facts, **costs}

    def rows(self) -> list[tuple[str, str]]:
        text = f"about {count_of(self.count, 'window')} of {self.side} voxels a side"
        return [
            *self.whole.rows(),
            ("windows", f"{text}, one after the other"),
            disk_row(self.disk),
        ]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Windows that do not fit are divided when they run."""


def fits(
    cost: Cost,
    octrees: Sequence[OctreeContent],
    sources: Sequence[OctreeContent],
    device: Device,
    max_memory: int | None,
) -> bool:
    """Return whether an operation of this cost fits in memory in one piece, with what it reads and
    makes, and with the attributes of the octrees that voxels of the result are from."""
    limit = device.max_memory if max_memory is None else max_memory
    kept = kept_bytes(sources)
    if cost.shortage(limit, device.info.max_allocation) or kept > limit:
        return False
    read = 2 * sum(octree.nbytes for octree in octrees) + kept
    return max(cost.host, read) <= available_memory()


class OperationJob(Job[BlockOctree]):
    """An operation on octrees that runs window by window.

    Attributes
    ----------
    whole : Plan
        The operation on all of the octrees, with the grid of the result.
    operands : list of Operand
        What is read.
    grid : Grid
        The grid of the result.
    store : Windows
        Where windows wait; to be set before it runs.
    """

    plan: OperationPlan
    device: Device
    store: Windows

    def __init__(
        self, whole: Any, operands: list[Operand], device: Device, max_memory: int | None
    ) -> None:
        self.whole, self.operands, self.grid = whole, operands, whole.grid
        self.device, self.max_memory = device, max_memory
        self.least = max(LEAST, self.grid.side // MOST)
        self.plan = self._plan()

    @cached_property
    def request(self) -> dict[str, Any]:
        """The content of what is read, and the operation, in JSON types."""
        digests = [operand.octree.digest() for operand in self.operands]
        return {"content": digests, **self.whole.as_dict()}

    def _plan(self) -> OperationPlan:
        """Return the plan of the largest windows that are predicted to fit."""
        side = self.grid.side
        while shortage := self._shortage(cost := self._cost(side), side):
            refuse_smallest((0, 0, 0, side), shortage, self.least)
            side //= 2
        count = max(operand.cells(side).refined for operand in self.operands)
        disk = sum(operand.octree.nbytes for operand in self.operands)
        return OperationPlan(self.whole, cost, side, count, disk)

    def _shortage(self, cost: Cost, side: int) -> str:
        """Return the memory that a window of this cost lacks, as messages say it; "" if it lacks
        none. What the host holds beside the device counts too, as the memory of processors is one,
        but it never makes a window too small."""
        host = cost.host if side > self.least else 0
        both = replace(cost, device=cost.device + host)
        return both.shortage(self.limit, self.device.info.max_allocation)

    def notes(self, result: BlockOctree) -> Iterator[str]:
        """Yield which attributes are not kept, and which would be in one piece."""
        yield from lost([operand.octree for operand in self.operands])
        if names := kept_of(self._sources):
            yield f"windows keep no attributes: more --max-memory would keep {', '.join(names)}"

    def sizes(self, operand: Operand, side: int) -> np.ndarray:
        """Return the predicted refined nodes of an operand in a cube of `side` voxels, by level
        from level 1 up."""
        sizes = np.diff(operand.octree.offsets.astype(np.int64))[:0:-1] // 8
        cells = operand.cells(side)
        return np.minimum(sizes, AREA * sizes // max(cells.refined, 1) + 1)[: cells.level]

    @property
    @abstractmethod
    def _sources(self) -> Sequence[OctreeContent]:
        """The octrees that voxels of the result are from."""

    @property
    @abstractmethod
    def _described(self) -> dict[str, Any]:
        """The plan, units and transform of the result."""

    @abstractmethod
    def _cost(self, side: int) -> Cost:
        """Return the predicted bytes of a window of `side` voxels."""

    @abstractmethod
    def _state(self, key: Key) -> int:
        """Return EMPTY or FULL if a cube of the result is known to be so; otherwise REFINED."""

    @abstractmethod
    def _window(self, key: Key, grid: Grid) -> Octree:
        """Return the pruned octree of a window, whose own grid is given."""

    # ---- the work

    def _run(self) -> BlockOctree:
        self._used: list[Key] = []
        self._done = self._full = 0
        tree = self._made((0, 0, 0, self.grid.side))
        count = self._full + sum(map(self.store.voxels, self._used))
        content = (self.grid, "solid", "none", tree, count, self._bricks)
        return BlockOctree(*content, source_sha256="", **self._described)

    def _made(self, key: Key) -> Subtree:
        """Return the subtree of a cube; its bricks wait on disk."""
        beyond = min(shape_of(key, self.grid)) <= 0
        state = EMPTY if beyond else self._state(key)
        if state != REFINED:
            self._full += key[3] ** 3 * (state == FULL)
            return leaf_subtree(key[3], state)
        if key[3] > self.plan.side:
            return self._joined(key)
        if key not in self.store:
            try:
                self._make(key)
            except MemoryLimitError as error:
                if key[3] <= self.least:
                    raise MemoryLimitError(
                        f"a window of {key[3]} voxels a side does not fit in {human(self.limit)}: "
                        "allow more (see --max-memory)"
                    ) from error
                return self._joined(key)
        self._used.append(key)
        return Subtree(*self.store.get(key))

    def _joined(self, key: Key) -> Subtree:
        """Return the subtree of a cube that is divided."""
        return joined([self._made(half) for half in halves_of(key)])

    def _make(self, key: Key) -> None:
        """Make a window; it waits on disk."""
        self._done += 1
        if self._progress:
            self._progress(f"window {self._done} of about {self.plan.count}")
        side = key[3]
        with self.device.reporting(lambda _: None):  # not the stages within
            octree = self._window(key, cube(side))
        levels = subtree_of(octree, side).levels
        self.store.put(key, Window(levels, octree.bricks, octree.count))

    def _made_by(self, job: Job[Octree], grid: Grid) -> Octree:
        """Return the octree of a window's job; MemoryLimitError if the window does not fit."""
        if shortage := self._shortage(job.cost, grid.side):
            raise MemoryLimitError(f"a window of {grid.side} voxels a side {shortage}")
        return job._run()

    def _bricks(self) -> Iterator[np.ndarray]:
        """Yield the bricks of all windows, which are then removed from the disk."""
        for key in self._used:
            yield from self.store.take(key)
