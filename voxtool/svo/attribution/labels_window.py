"""Labels of a window of a grid: those of the whole grid.

What a part sets in a window follows from its faces near the window, those before it along x, and
its fill rule, which is chosen once for the whole part. Parts that lie in the window wholly are
voxelized at once, as in the whole grid; others alone, in the window.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.svo.attribution.labels import PartLabelsJob, PartLabelsPlan
from voxtool.svo.voxelization.mesh_parts import PartMesh
from voxtool.svo.voxelization.part_octrees import atlas_of, voxels_of
from voxtool.svo.voxelization.voxelize import Window, plan_voxelize

BEYOND = "reaches beyond the window"
Rule = tuple[str, int]  # a fill, and the gap that a flood closes


@dataclass(frozen=True, eq=False)
class PartsOfWindows:
    """The parts of a labelled voxelization, from which windows are planned.

    mesh, grid, plan, ranks : those of the voxelization in one piece
    own : its parts, with faces as the fill rules turned them
    rules : fill rule of each part
    together : the parts that may be voxelized at once
    low, high : (n, 3) int64, the first and last voxels that each of own.parts may change
    """

    mesh: Mesh
    grid: Grid
    plan: PartLabelsPlan
    ranks: np.ndarray
    own: PartMesh
    rules: dict[int, Rule]
    together: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, whole: PartLabelsJob) -> PartsOfWindows:
        """Return the parts of a planned voxelization."""
        own, rest, rules = whole.own, list(whole.jobs), {}
        together = whole.atlas.parts if whole.atlas else own.parts[:0]
        faces = own.faces.copy()
        if whole.atlas:
            job = rest.pop(0)
            job.settle()
            rules = dict.fromkeys(together.tolist(), (job.plan.fill, job.plan.gap))
            faces[np.isin(own.of, together)] = job.mesh.faces
        for (part, _), job in zip(whole.plan.alone, rest, strict=True):
            solid = getattr(job, "solid", job)  # of fractions
            solid.settle()
            plan = solid.plan
            rules[part] = plan.fill, plan.gap
            first = np.int32(np.searchsorted(own.part_of, part))
            faces[own.of == part] = job.mesh.faces + first
        boxes = voxels_of(own, whole.grid.to_fixed(own.points), 0)
        about = whole.mesh, whole.grid, whole.plan, whole.ranks
        return cls(*about, replace(own, faces=faces), rules, together, *boxes)

    def sent(self, faces: np.ndarray) -> PartsOfWindows:
        """Return what windows need of the parts of some faces, to be sent to another process: the
        mesh without its faces."""
        own = self.own.some(faces)
        place = np.searchsorted(self.own.parts, own.parts)
        none = {"vertices": own.points[:0], "faces": own.faces[:0]}
        mesh = replace(self.mesh, **none, parts={}, appearance=None)
        plan = replace(self.plan, together=0, alone=(), inner=())
        rules = {part: self.rules[part] for part in own.parts.tolist()}
        boxes = {"low": self.low[place], "high": self.high[place]}
        return replace(self, mesh=mesh, plan=plan, own=own, rules=rules, **boxes)

    def with_rule(self, fill: str) -> np.ndarray:
        """Return which faces are of parts that a rule fills, (F,) bool."""
        parts = [part for part, (own, _) in self.rules.items() if own == fill]
        return np.isin(self.own.of, parts)

    def job(
        self, faces: np.ndarray, window: Window, device: Device, max_memory: int | None
    ) -> PartLabelsJob:
        """Return the job of a window, given the faces that can change it; it has no jobs of parts
        if nothing is set there."""
        own, grid = self.own.some(faces), self.grid
        low, shape = np.asarray(window[0]), window[1]
        fixed = grid.to_fixed(own.points) - (low.astype(np.int32) << FIXED_POINT_BITS)
        place = np.searchsorted(self.own.parts, own.parts)
        within = ((self.low[place] >= low) & (self.high[place] < low + shape)).all(axis=1)
        within &= np.isin(own.parts, self.together)
        mode, _, added = self.plan.mode.partition("+")
        options: dict[str, Any] = {"device": device, "max_memory": max_memory}
        options["with_surface"] = bool(added)
        atlas, jobs, alone = atlas_of(own, fixed, within, 0), [], []
        if atlas:
            mesh, fill = atlas.mesh(fixed, own.faces, own.of), self._fill(int(atlas.parts[0]))
            jobs.append(plan_voxelize(mesh, atlas.grid, mode, fill=fill, **options))
        for part in own.parts[~within].tolist():
            mesh, fill = own.alone(part, self.mesh), self._fill(part)
            job = plan_voxelize(mesh, grid, mode, fill=fill, window=window, **options)
            survey = job.plan.survey
            if survey.triangles > survey.outside or job.plan.entry:
                jobs.append(job)
                alone.append((part, BEYOND))
        plan = replace(
            self.plan, together=len(atlas.parts) if atlas else 0, alone=tuple(alone),
            side=atlas.side if atlas else 0, inner=tuple(job.plan for job in jobs),
        )  # fmt: skip
        return PartLabelsJob(
            self.mesh, grid.window(*window), own, self.ranks, atlas, jobs, plan, device,
            max_memory, window, grid,
        )  # fmt: skip

    def _fill(self, part: int) -> str:
        """Return the fill of a part, as plan_voxelize takes it."""
        fill, _ = self.rules[part]
        return "auto" if fill == "none" else fill
