"""Two octrees compared: what is set only in one, only in the other, and in both; and rows of voxels
filled beyond the mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.errors import GridError
from voxtool.job import Job, one_call
from voxtool.memory import check_memory
from voxtool.opencl import Device
from voxtool.svo.cells.voxel_layers import OUTSIDE, paint, sorted_leaves
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, BRICK_VOXELS
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import (
    PROGRAMS,
    CombineJob,
    CombinePlan,
    Terms,
    combined,
    plan_combine,
)
from voxtool.svo.sets.placing import EMPTY, FULL, first_children, masks_of

COMPARE = "compare"  # in place of an operation, in plans


@dataclass(frozen=True, eq=False)
class Comparison:
    """The voxels of only one octree, only the other, and both, on the grid that holds both.

    Attributes
    ----------
    first, second, both : Octree
        The voxels that are set only in the first, only in the second, and in both.
    """

    first: Octree
    second: Octree
    both: Octree

    @property
    def equal(self) -> bool:
        """True if no voxel is set in only one of the octrees."""
        return not (self.first.count or self.second.count)

    def summary(self) -> dict[str, Any]:
        """Return counts, volumes and bounding boxes in JSON types, in world units. `jaccard` is the
        share of the voxels of the union that are in both; 1 if none is set."""
        parts = {"only_first": self.first, "only_second": self.second, "both": self.both}
        union = sum(part.count for part in parts.values())
        grid = self.both.grid
        return {
            "equal": self.equal,
            **{name: list(getattr(grid, name)) for name in ("shape", "origin", "pitch")},
            "jaccard": self.both.count / union if union else 1.0,
            **{name: _summary(part) for name, part in parts.items()},
        }


def _summary(octree: Octree) -> dict[str, Any]:
    box = bounding_box(octree)
    return {
        "voxels": octree.count,
        "volume": octree.count * octree.grid.voxel_volume,
        "box": None if box is None else box.tolist(),
        "bounds": None if box is None else octree.grid.to_world(box).tolist(),
    }


def bounding_box(octree: Octree) -> np.ndarray | None:
    """Return the lowest set voxel along each axis and the end of the highest one, (2, 3) int64, or
    None if no voxel is set."""
    lows, highs = [], []
    *coarse, level = octree.levels()
    for above in coarse:
        lows.append(above.cells[above.inside])
        highs.append(lows[-1] + above.side)
    held = octree.bricks != 0
    masks, cells = octree.bricks[held], level.cells[held]
    if len(masks):
        # the voxels of the outermost bricks along each axis
        sides = (_ends(masks, cells[:, axis], axis) for axis in range(3))
        low, high = np.array(list(sides)).T
        lows.append(low[None])
        highs.append(high[None])
    low, high = np.concatenate(lows), np.concatenate(highs)
    return np.stack([low.min(axis=0), high.max(axis=0)]) if len(low) else None


def _ends(masks: np.ndarray, cells: np.ndarray, axis: int) -> tuple[int, int]:
    """Return where the voxels of bricks begin and end along an axis."""
    bits = np.arange(BRICK_SIDE**3, dtype=np.uint64)
    first, last = (
        cell
        + BRICK_VOXELS[
            np.bitwise_or.reduce(masks[cells == cell]) >> bits & BRICK.type(1) != 0, axis
        ]
        for cell in (cells.min(), cells.max())
    )
    return int(first.min()), int(last.max()) + 1


@dataclass
class CompareJob(Job[Comparison]):
    """The planned comparison of two octrees.

    Attributes
    ----------
    combination : CombineJob
        The octrees, placed in one grid.
    plan : CombinePlan
        The decisions.
    """

    combination: CombineJob
    plan: CombinePlan
    device: Device
    max_memory: int | None = None

    def _run(self) -> Comparison:
        self.device.prepare(*PROGRAMS)
        with self.stage("place"):
            operands = self.combination.upload()
        terms = (
            Terms.of("difference", 2),
            Terms(np.array([0, 1], np.uint32), complement=True),  # the second without the first
            Terms.of("intersection", 2),
        )
        return Comparison(*(self.combination.octree(*combined(operands, part)) for part in terms))


def plan_compare(
    one: Octree, other: Octree, *, device: Device | None = None, max_memory: int | None = None
) -> CompareJob:
    """Return the planned job of `compare`; see `voxtool.compare`."""
    combination = plan_combine([one, other], device=device)
    plan = replace(combination.plan, operation=COMPARE)
    return CompareJob(combination, plan, combination.device, max_memory)


compare = one_call(plan_compare, "compare", Comparison)


def count_differences(one: Octree, other: Octree) -> tuple[int, int]:
    """Return how many voxels are set only in the first octree, and only in the second.

    The octrees are traversed together, root first; a leaf of one octree is paired with all
    descendants of the other octree's node.
    """
    if one.grid != other.grid:
        raise GridError(
            "octrees of different grids cannot be compared: voxelize both on one grid, with --like"
        )
    first = second = 0
    nodes = np.zeros(1, np.int64), np.zeros(1, np.int64)
    for d in range(one.depth - 1):
        a, b = (
            first_children(octree.child_words(d), node)
            for octree, node in zip((one, other), nodes, strict=True)
        )
        leaves = (a < 0) & (b < 0)
        volume = (BRICK_SIDE << (one.depth - 1 - d)) ** 3
        first += volume * int(np.count_nonzero(leaves & (a == FULL) & (b == EMPTY)))
        second += volume * int(np.count_nonzero(leaves & (a == EMPTY) & (b == FULL)))
        nodes = tuple(
            np.where(child < 0, child, child + np.arange(8)[:, None])[:, ~leaves].T.ravel()
            for child in (a, b)
        )
    a, b = (masks_of(octree.bricks, node) for octree, node in zip((one, other), nodes, strict=True))
    first += int(np.bitwise_count(a & ~b).sum(dtype=np.int64))
    second += int(np.bitwise_count(b & ~a).sum(dtype=np.int64))
    return first, second


def leaking_rows(octree: Octree) -> np.ndarray:
    """Return the rows along x whose last voxel is set, (n, 2) int64 y, z in ascending order.

    If the mesh ends before that voxel, the rows cross it an odd number of times, and the parity
    rule fills them beyond the mesh.
    """
    nx, ny, nz = octree.grid.shape
    check_memory(2 * BRICK_SIDE * (ny + 3) * (nz + 3), "the last four layers of voxels")
    first = (nx - 1) // BRICK_SIDE * BRICK_SIDE
    slab = paint(sorted_leaves(octree, (0, 1, 2)), first, (0, 1, 2), octree.grid.shape)
    return np.argwhere(slab[nx - 1 - first, :ny, :nz] != OUTSIDE)
