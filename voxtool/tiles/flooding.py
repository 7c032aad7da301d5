"""Floods in windows: what is outside depends on all of the grid, what is kept on a window.

First each window says which pieces of free space it shares with others
(svo/voxelization/fill/flood.py). They are united, also across cubes that no face reaches, which are
one piece each. Then each window is made from the roots of its pieces that are outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from voxtool.files.octrees.windows import Key
from voxtool.job import Cost
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.links import EMPTY, FULL
from voxtool.svo.voxelization.fill.flood import window_frame
from voxtool.svo.voxelization.fill.flood_pieces import Shared, cubes_of
from voxtool.svo.voxelization.fill.outside import Outside
from voxtool.svo.voxelization.plan import CELL, flood_block, flood_steps
from voxtool.tiles.subtree import shape_of
from voxtool.tiles.windows import Part, Wanted, WindowsJob, WindowsPlan, stored_bytes
from voxtool.tiles.workers import plan_flood, shared_pieces

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
        if self.workers or self.merged:
            return cost
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
        return 0 if self.merged else stored_bytes(self.whole)


class FloodWindowsJob(WindowsJob):
    """A flood that runs window by window. This process plans the windows, and decides which pieces
    of free space are outside."""

    plan_type = FloodPlan
    planner = staticmethod(plan_flood)
    leaves_plans = False

    def _take_over(self) -> None:
        super()._take_over()
        gap = self.whole.plan.gap
        self.least = flood_block(0, gap)
        self._margin = self.least + flood_steps(gap) + CELL

    def _faces_of(self, key: Key, faces: np.ndarray) -> np.ndarray:
        return self._faces_near(key, faces, self._margin, rows=False)

    def _given(self, faces: np.ndarray) -> tuple[Any, ...]:
        return self._mesh_of(faces), self.grid, self.whole.plan

    def _needs_to_share(self, wanted: Wanted) -> tuple[Any, ...]:
        key, faces = wanted
        return self.planner, key, *self._given(faces)

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
        windows = self._windows(self.plan.root, self.all_faces)
        given = self._needs_to_share, windows, partial(self._report, OUTSIDE)
        for (key, _), shared in self.executor.results(shared_pieces, *given):
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

    def _outside_of(self, key: Key) -> np.ndarray:
        return self._outside[key]

    def _leaf(self, key: Key) -> int:
        return self._states.get(key, EMPTY)
