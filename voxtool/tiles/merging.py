"""Windows whose subtrees are merged: a merged octree whose nodes nobody could hold.

Each window is merged as soon as it is made, and the eight parts of a cube as soon as all are there.
Equal subtrees are equal wherever the windows end, so the result does not depend on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from voxtool.errors import human
from voxtool.files.octrees.windows import Window
from voxtool.svo.dag.merge import CHILDREN, Subtrees
from voxtool.svo.dag.merged import MERGE_BYTES
from voxtool.svo.octree.layout import BRICK
from voxtool.svo.voxelization.plan import VoxelizePlan
from voxtool.svo.voxelization.voxelize import VoxelizeJob


def merging_fits(job: VoxelizeJob) -> bool:
    """Return whether an octree can be made, and then merged, in the memory of its job."""
    return job.fits and not merging_shortage(job)


def merging_shortage(job: VoxelizeJob) -> str:
    """Return the memory that a job and then merging lack, as messages say it."""
    needed = merging_bytes(job.plan)
    if job.shortage or needed <= job.limit:
        return job.shortage
    return f"would need {human(needed)} of memory to be merged, of {human(job.limit)} allowed"


def merging_bytes(plan: VoxelizePlan) -> int:
    """Return the predicted bytes of an octree and of merging it."""
    return plan.cost.host + MERGE_BYTES * plan.bricks


def window_of(merged: Subtrees) -> Window:
    """Return the distinct subtrees of a window as what waits on disk."""
    tables = [rows.view(np.uint8).ravel() for rows in merged.rows]
    return Window(tables, merged.leaves, merged.root)


def subtrees_of(tables: Sequence[np.ndarray], leaves: Iterable[np.ndarray], root: int) -> Subtrees:
    """Return the distinct subtrees of a window, given what waits on disk; its leaves in blocks."""
    rows = [table.view(np.uint32).reshape(-1, CHILDREN) for table in tables]
    return Subtrees(rows, np.concatenate([np.empty(0, BRICK), *leaves]), root)
