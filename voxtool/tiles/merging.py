"""Voxelization in windows whose subtrees are merged: a merged octree whose nodes nobody could hold.

Each window is merged as soon as it is made, and the eight parts of a cube as soon as all are there.
Equal subtrees are equal wherever the windows end, so the result does not depend on them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, human
from voxtool.files.windows import Key, Store, Window, Windows
from voxtool.job import Cost
from voxtool.svo.layout import BRICK
from voxtool.svo.merge import CHILDREN, Subtrees, join, merge, no_subtrees
from voxtool.svo.merged import MERGE_BYTES, MergedOctree
from voxtool.svo.plan import VoxelizePlan
from voxtool.svo.voxelize import VoxelizeJob
from voxtool.tiles.subtree import depth_of
from voxtool.tiles.windows import Part, WindowsJob, WindowsPlan

NO_LEAVES = np.empty(0, BRICK)


def merging_fits(job: VoxelizeJob) -> bool:
    """Return whether an octree can be made, and then merged, in the memory of its job."""
    return job.fits and not merging_shortage(job)


def merging_shortage(job: VoxelizeJob) -> str:
    """Return the memory that a job and then merging lack, as messages say it."""
    needed = _merging_bytes(job.plan)
    if job.shortage or needed <= job.limit:
        return job.shortage
    return f"would need {human(needed)} of memory to be merged, of {human(job.limit)} allowed"


def _merging_bytes(plan: VoxelizePlan) -> int:
    """Return the predicted bytes of an octree and of merging it."""
    return plan.cost.host + MERGE_BYTES * plan.bricks


@dataclass(frozen=True)
class MergingPlan(WindowsPlan):
    """The windows of a voxelization that are merged one by one."""

    @property
    def stages(self) -> list[str]:
        return [*super().stages, "merge subtrees"]

    @property
    def cost(self) -> Cost:
        """The predicted bytes of the largest window; those of the merged subtrees are not known."""
        merging = max(map(_merging_bytes, self.plans), default=0)
        return replace(super().cost, host=merging)

    @property
    def disk(self) -> int:
        """Nothing waits on the disk, and the bytes of the file are not known."""
        return 0

    def rows(self) -> list[tuple[str, str]]:
        return [row for row in super().rows() if row[0] != "disk"]

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        """Every window fits, and links of merged subtrees have 32 bits."""


class MergingJob(WindowsJob):
    """A voxelization that runs window by window, each of which is merged at once. With a store
    its distinct subtrees wait on disk, too, so that a run that was killed can go on."""

    store: Windows | None = None  # pyright: ignore[reportIncompatibleVariableOverride]

    @property
    def request(self) -> dict[str, Any]:
        """The content and the rule of the octree that is made, in JSON types."""
        return {**super().request, "merged": True}

    def _plan(self) -> MergingPlan:
        return MergingPlan(self.whole.plan, self._divide(self.root, self.all_faces))

    def _shortage(self, job: VoxelizeJob) -> str:
        return merging_shortage(job)

    def _run(self) -> MergedOctree:  # pyright: ignore[reportIncompatibleMethodOverride]
        self._prepare()
        self._done = 0
        subtrees = self._merged(self.plan.root, self.all_faces)
        mesh, plan = self.mesh, self.whole.plan
        described = (plan.scene(), mesh.source_sha256, mesh.units, mesh.transform)
        return MergedOctree.of_subtrees(subtrees, self.grid, plan.mode, plan.rule, *described)

    def _merged(self, part: Part, faces: np.ndarray) -> Subtrees:
        """Return the distinct subtrees of a cube."""
        faces = self._faces_of(part.key, faces)
        if part.parts:
            joined = join([self._merged(half, faces) for half in part.parts])
            if joined.nbytes > self.whole.limit:
                raise MemoryLimitError(
                    f"the distinct subtrees of {part.key[3]} voxels a side take "
                    f"{human(joined.nbytes)}, of {human(self.whole.limit)} allowed: choose a "
                    "smaller dim (see --max-memory)"
                )
            return joined
        if not part.window:
            return no_subtrees(depth_of(part.key[3]), self._leaf(part.key))
        return self._window(part.key, faces)

    def _window(self, key: Key, faces: np.ndarray) -> Subtrees:
        """Return a merged window."""
        self._report()
        if self.store is not None and key in self.store:
            return _read(self.store, key)
        with self.device.reporting(lambda _: None):  # not the stages within
            levels, bricks, _ = self._content(key, faces)
        merged = merge(levels[::-1], bricks)
        if self.store is not None:
            self.store.put(key, window_of(merged))
        return merged


def window_of(merged: Subtrees) -> Window:
    """Return the distinct subtrees of a window as what waits on disk."""
    tables = [rows.view(np.uint8).ravel() for rows in merged.rows]
    return Window(tables, merged.leaves, merged.root)


def _read(store: Store, key: Key) -> Subtrees:
    """Return the distinct subtrees of a window that waits on disk."""
    tables, _ = store.get(key)
    rows = [table.view(np.uint32).reshape(-1, CHILDREN) for table in tables]
    leaves = np.concatenate([NO_LEAVES, *store.bricks(key)])
    return Subtrees(rows, leaves, store.voxels(key))
