"""Floods in windows: what is outside depends on all of the grid, what is kept on a window.

First each window says which pieces of free space it shares with others (svo/fill/flood.py). They
are united, also across cubes that no face reaches, which are one piece each. Then each window is
made from the roots of its pieces that are outside.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from voxtool.files.windows import Key
from voxtool.job import Cost
from voxtool.svo.fill.flood import window_frame
from voxtool.svo.fill.outside import Outside
from voxtool.svo.fill.pieces import Shared, cubes_of
from voxtool.svo.flood_window import FloodWindowJob
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.links import EMPTY, FULL
from voxtool.svo.plan import CELL, flood_block, flood_steps
from voxtool.svo.voxelize import VoxelizeJob
from voxtool.tiles.merging import MergingJob
from voxtool.tiles.windows import (
    Content,
    Part,
    WindowsJob,
    WindowsPlan,
    shape_of,
    stored_bytes,
)

OUTSIDE = "outside of window"  # as progress says it
ROOT = np.zeros(1, np.uint32)  # of a cube that is one piece
RECORD = 3 * 16  # bytes of a piece that windows share, while they are united
PIECES_OF_SEED = 29  # eight bricks, and leaves beside and above them


@dataclass(frozen=True)
class FloodPlan(WindowsPlan):
    """The windows of a flood."""

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the largest window, and of what all windows share."""
        cost = super().cost
        pieces = 0.0
        for part in self.root.windows():
            if part.plan:
                near = 12 * BRICK_SIDE / part.key[3]  # share of the bricks beside the six faces
                plan = getattr(part.plan, "octree", part.plan)  # without attributes
                pieces += 2 * near * plan.bricks + PIECES_OF_SEED * plan.seeds
        return replace(cost, host=max(self.whole.cost.host, cost.host) + round(RECORD * pieces))

    @property
    def disk(self) -> int:
        """Predicted bytes of the file, and at most of the windows that wait for it."""
        return stored_bytes(self.whole)


class Flooding(WindowsJob):
    """A flood that runs window by window."""

    def __init__(self, whole: VoxelizeJob) -> None:
        gap = whole.plan.gap
        self.least = flood_block(0, gap)
        self._margin = self.least + flood_steps(gap) + CELL
        super().__init__(whole)

    def _faces_of(self, key: Key, faces: np.ndarray) -> np.ndarray:
        return self._faces_near(key, faces, self._margin, rows=False)

    def _job(self, key: Key, faces: np.ndarray) -> FloodWindowJob:
        mesh, memory = self._mesh_of(faces), self.max_memory
        return FloodWindowJob(mesh, self.grid, self.whole.plan, key, self.device, memory)

    def _prepare(self) -> None:
        """Find out what is outside, of all windows and of the cubes between them."""
        found, self._done = Outside(), 0
        boxes, numbers = self._cubes(self.plan.root, found), {}
        low, high = boxes[:, :3], boxes[:, :3] + boxes[:, 3:]
        for i in range(len(boxes)):
            beside = ((low[i + 1 :] <= high[i]) & (low[i] <= high[i + 1 :])).all(axis=1)
            for other in np.flatnonzero(beside).tolist():
                found.link(i, ROOT, i + 1 + other)
        origin = window_frame(self.grid.shape, self.root, self.whole.plan.gap).corner
        for key, shared in self._shares():
            numbers[key] = number = found.add(shared)
            first, side = cubes_of(shared.keys)
            first -= origin
            end = first + side[:, None]
            corner, reach = np.array(key[:3]), 2 * self.least
            beside = ((low <= corner + key[3] + reach) & (corner - reach <= high)).all(axis=1)
            for other in np.flatnonzero(beside).tolist():
                touching = ((first <= high[other]) & (low[other] <= end)).all(axis=1)
                found.link(number, np.unique(shared.roots[touching]), other)
        roots = found.roots()
        self._outside = {key: roots[number] for key, number in numbers.items()}
        states = (EMPTY if len(part) else FULL for part in roots)
        self._states = dict(zip(map(tuple, boxes.tolist()), states, strict=False))

    def _shares(self) -> Iterator[tuple[Key, Shared]]:
        """Yield all windows, with the pieces of free space that they share with others."""
        for key, faces in self._every(self.plan.root, self.all_faces):
            self._report(OUTSIDE)
            with self.device.reporting(lambda _: None):  # not the stages within
                shared = self._job(key, faces).shared()
            yield key, shared

    def _cubes(self, part: Part, found: Outside) -> np.ndarray:
        """Add the cubes that no face reaches as one piece each; return their corners and sides."""
        if part.window or min(shape_of(part.key, self.grid)) <= 0:
            return np.empty((0, 4), np.int64)
        if part.parts:
            return np.concatenate([self._cubes(half, found) for half in part.parts])
        low = np.array(part.key[:3])
        beyond = (low == 0).any() or (low + part.key[3] >= self.grid.shape).any()
        none = np.empty(0, np.uint64), ROOT[:0]
        found.add(Shared(*none, ROOT if beyond else ROOT[:0], 1))
        return np.array([part.key])

    def _every(self, part: Part, faces: np.ndarray) -> Iterator[tuple[Key, np.ndarray]]:
        """Yield all windows, with the faces that reach them."""
        faces = self._faces_of(part.key, faces)
        if part.window:
            yield part.key, faces
        for half in part.parts:
            yield from self._every(half, faces)

    def _content(self, key: Key, faces: np.ndarray) -> Content:
        return filled(self._job(key, faces), self._outside[key])

    def _leaf(self, key: Key) -> int:
        return self._states.get(key, EMPTY)


def filled(job: FloodWindowJob, outside: np.ndarray) -> Content:
    """Return the content of a window, given the roots of its pieces that are outside."""
    levels, bricks = job.fill(outside)
    voxels = int(np.bitwise_count(bricks).sum(dtype=np.int64))
    for number, states in enumerate(levels[::-1], 1):
        voxels += int(np.count_nonzero(states == FULL)) * (BRICK_SIDE << number) ** 3
    return levels, bricks, voxels


class FloodWindowsJob(Flooding):
    """A flood whose windows wait on disk until the octree is written."""

    def _plan(self) -> FloodPlan:
        return FloodPlan(self._whole_plan, self._divide(self.root, self.all_faces))


class FloodMergingJob(Flooding, MergingJob):
    """A flood each window of which is merged at once."""
