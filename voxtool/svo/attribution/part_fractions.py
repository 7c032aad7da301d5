"""Voxels that know their part, and how much of them lies inside.

Each part has fractions of its own, by its own fill rule. A voxel has their sum, at most 1, and
belongs to the part that has the greatest share of it, of equal ones to the first by priority. The
sum is exact if the parts do not overlap; if they do, it lies between the greatest share and that of
their union.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.choices import FRACTION_TYPES
from voxtool.errors import count_of
from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.job import Cost
from voxtool.mesh.appearance import Parts
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device, default_device
from voxtool.svo.attribution.fraction import (
    LATTICE_BITS,
    MODE,
    check_type,
    lattice_row,
    plan_fractions,
    values_of,
)
from voxtool.svo.attribution.labels import UNITE, PartLabelsJob, PartLabelsPlan, dtype_of_labels
from voxtool.svo.octree.attributes import BITS, BRICKS, Attribute
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.stored_volume import WHOLE
from voxtool.svo.sets.priority_union import NONE, Union, unite
from voxtool.svo.voxelization.mesh_parts import PartMesh, parts_of, ranks_of

WHY = "each part has fractions of its own"
SHARE_BYTES = 64 * (8 + 4 + 4)  # bytes of a brick: sums, greatest shares and their parts


@dataclass(frozen=True)
class PartFractionsPlan(PartLabelsPlan):
    """The plan of a voxelization with labels and fractions.

    kind : the type of fractions
    bits : vertices of all parts are rounded to 2**-bits voxel
    """

    kind: str = FRACTION_TYPES[0]
    bits: int = FIXED_POINT_BITS

    @property
    def cost(self) -> Cost:
        cost, bricks = super().cost, sum(plan.bricks for plan in self.inner)
        return replace(cost, host=cost.host + SHARE_BYTES * bricks)

    @property
    def reasons(self) -> dict[str, str]:
        return {"values of whole voxels": "only cut voxels store a fraction"}

    def as_dict(self) -> dict[str, Any]:
        return {**super().as_dict(), "fraction_type": self.kind, LATTICE_BITS: self.bits}

    def scene(self) -> dict[str, Any]:
        return {**super().scene(), LATTICE_BITS: self.bits}

    def rows(self) -> list[tuple[str, str]]:
        return [*super().rows(), ("fractions", f"of type {self.kind}"), lattice_row(self.bits)]


def plan_part_fractions(
    mesh: Mesh,
    grid: Grid,
    *,
    labels: str | Parts,
    priority: str | Sequence[str] = "first",
    fill: str = "auto",
    kind: str = FRACTION_TYPES[0],
    device: Device | None = None,
    max_memory: int | None = None,
) -> PartFractionsJob:
    """Return the planned voxelization of a mesh whose voxels are labelled by its parts and have
    fractions; see `voxtool.voxelize`."""
    check_type(kind)
    parts = parts_of(mesh, labels)
    ranks = ranks_of(parts.names, priority)
    device = device or default_device()
    own = PartMesh.of_mesh(mesh, parts.labels)
    bits = grid.finest_bits(mesh.bounds)  # of all parts: what two of them share stays common
    options: dict[str, Any] = {"fill": fill, "bits": bits}
    options |= {"device": device, "max_memory": max_memory}
    jobs: list[Any] = [
        plan_fractions(own.alone(part, mesh), grid, **options) for part in own.parts.tolist()
    ]
    plan = PartFractionsPlan(
        MODE, parts.names, 0, tuple((part, WHY) for part in own.parts.tolist()),
        dtype_of_labels(len(parts.names)), 0, tuple(job.plan for job in jobs), kind,
        bits,
    )  # fmt: skip
    return PartFractionsJob(mesh, grid, own, ranks, None, jobs, plan, device, max_memory)


class PartFractionsJob(PartLabelsJob):
    """A planned voxelization with labels and fractions; jobs : those of the parts."""

    plan: PartFractionsPlan
    jobs: Any

    def _run(self) -> Octree:
        octrees = self._voxelized()
        with self.stage(UNITE):
            union = unite(self.device, self._nodes(octrees))
            shares = PartShares(union)
            for (part, _), octree in zip(self.plan.alone, octrees, strict=True):
                shares.add(octree, int(self.ranks[part]))
            label_of = np.argsort(self.ranks).astype(self.plan.dtype)  # of each rank
            made = self._octree(
                union, label_of[shares.ranks], label_of[union.leaves],
                {octree.fill for octree in octrees},
            )  # fmt: skip
            fraction = shares.fraction(self.plan.kind)
        return replace(made, attributes=(*made.attributes, fraction))

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield warnings: parts set no voxel, or their surfaces do not bound what is filled."""
        yield from super().findings(result)
        for job in self.jobs:
            yield from job.wrong()

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield what was decided to be inside, and how many holes of parts are closed by caps."""
        yield from self.doubts(result)
        holes, caps = (sum(job.plan.caps[i] for job in self.jobs) for i in range(2))
        if caps:
            closed = f"{count_of(holes, 'hole')} of parts closed"
            yield f"{self.mesh.name or 'mesh'}: {closed} by {count_of(caps, 'cap triangle')}"


class PartShares:
    """The shares of parts in the voxels of a union's bricks.

    Parameters
    ----------
    union : Union
        The voxels; where an inside leaf of a part is refined in another one, the leaf's part has
        all of them.
    """

    def __init__(self, union: Union) -> None:
        self.bricks = union.bricks.get()
        self._codes = (union.codes[:, None] << np.uint64(3) | np.arange(8, dtype=np.uint64)).ravel()
        behind = union.entries["behind"].get()[:, None]
        shape = (len(self.bricks), len(BITS))
        self._sums = np.where(behind != NONE, 1.0, np.zeros(shape))
        self._greatest = self._sums.astype(np.float32)
        self._ranks = np.broadcast_to(behind, shape).copy()

    def add(self, octree: Octree, rank: int) -> None:
        """Add the fractions of a part of this rank."""
        codes, values = octree.levels()[-1].codes, octree.values("fraction")
        for first in range(0, len(codes), BRICKS):
            part = slice(first, first + BRICKS)
            at, own = np.searchsorted(self._codes, codes[part]), values.of_bricks(part)
            greatest, ranks = self._greatest[at], self._ranks[at]
            better = (own > greatest) | ((own == greatest) & (own > 0) & (rank < ranks))
            self._sums[at] += own
            self._greatest[at] = np.where(better, own, greatest)
            self._ranks[at] = np.where(better, np.uint32(rank), ranks)

    @property
    def _set(self) -> np.ndarray:
        return (self.bricks[:, None] & BITS) != 0

    @property
    def ranks(self) -> np.ndarray:
        """The rank of the part with the greatest share of each set voxel."""
        return self._ranks[self._set]

    def fraction(self, kind: str) -> Attribute:
        """Return the sums of the shares as fractions of a type."""
        shares = np.rint(np.minimum(self._sums, 1.0) * WHOLE).astype(np.uint32)
        cut = self._set & (shares < WHOLE)
        values = values_of(shares[cut], kind)
        masks = np.packbits(cut, axis=1, bitorder="little").view(np.uint64).ravel()
        whole = values_of(np.array([WHOLE], np.uint32), kind)[0].item()
        return Attribute("fraction", values, values[:0], masks, whole)
