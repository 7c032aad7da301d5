"""Building the adaptively sampled distance field of a mesh.

The octree grows level by level, from the root (level 0) to the leaves. A child is refined if its
trilinear interpolation is further from the exact distance than the tolerance [Frisken 2000]. The
stages of a level are in levels.py.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Self

import numpy as np

from voxtool.adf.accuracy import measure_errors
from voxtool.adf.cells import NO_LEAF, cell_of, identifier_type, key_of
from voxtool.adf.field import DistanceField, assemble
from voxtool.adf.hashing import SOURCE as HASHING
from voxtool.adf.hashing import build_hash
from voxtool.adf.levels import (
    Construction,
    Examined,
    Level,
    constrain,
    examine,
    programs,
    refine,
    sample,
    windows_of,
)
from voxtool.adf.plan import BLOCK_BYTES, PILOT_LEVEL, WINDOW, FieldPlan
from voxtool.adf.survey import Survey, cube_of
from voxtool.job import Job
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.mesh.topology import check_topology
from voxtool.opencl import Device, default_device
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import RADIX_SORT
from voxtool.spatial.distance import SOURCE as DISTANCE
from voxtool.spatial.signed_distance import default_sign
from voxtool.spatial.signed_distance import programs as of_distances
from voxtool.spatial.winding_number import SOURCE as WINDING


def build_adf(mesh: Mesh, device: Device | None = None, **request: Any) -> DistanceField:
    """Return the distance field of a mesh: `plan_adf(...).run()`; see voxtool.build_adf."""
    return plan_adf(mesh, device=device, **request).run()


def plan_adf(
    mesh: Mesh,
    *,
    sign: str | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
    **request: Any,
) -> FieldJob:
    """Return the job of building the distance field of a mesh.

    request: tolerance, max_level, band, continuous, bounds, max_bytes, measure and max_texture, as
    in voxtool.build_adf.
    """
    plan = FieldPlan(triangles=len(mesh.faces), sign=sign or "", **request)
    survey = Survey(mesh, device or default_device(), signed=sign != "none")
    plan = replace(
        plan,
        flat=survey.flat,
        crossed=int(np.count_nonzero(survey.crossed)) - survey.undecided,
        undecided=survey.undecided,
        closed=survey.closed,
        sign=sign or ("pseudonormal" if survey.closed else "winding"),
    )
    return FieldJob(survey, plan, max_memory)


class FieldJob(Job["DistanceField"]):
    """A planned build of a distance field; see voxtool.plan_adf.

    `plan` and `describe()` build the upper levels to predict the others; `run()` continues there.
    """

    def __init__(self, survey: Survey, plan: FieldPlan, max_memory: int | None) -> None:
        self.device, self.max_memory = survey.device, max_memory
        self._survey, self._plan = survey, plan
        self._build: _Build | None = None  # the upper levels, once they are built

    @property
    def plan(self) -> FieldPlan:
        """The decisions, and the number of cells of each level that has been built."""
        if not self._plan.refined:
            self._build = _Build(self._survey, self._plan, self._memory)
            self._build.run(PILOT_LEVEL - 1)
            self._plan = self._build.plan
        return self._plan

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that will run, in order; this builds nothing."""
        return tuple(self._plan.stages)

    @property
    def left_out(self) -> dict[str, str]:
        """The stages and data that are not needed, with reasons; this builds nothing."""
        return self._plan.left_out

    def with_(self, **decisions: Any) -> Self:
        """Return the same job with decisions of its plan forced; see Job.with_."""
        job = copy.copy(self)
        job._plan = replace(self._plan, refined=(), items=0, **decisions)
        job._build = None
        signed = job._plan.sign != "none"
        if signed != self._survey.signed:
            job._survey = Survey(self._survey.mesh, self._survey.device, signed)
        return job

    def refuse(self) -> None:
        """Raise MemoryLimitError if the levels counted so far take more memory than allowed."""
        if self._plan.refined:
            self._plan.refuse_beyond(*self._memory)

    @property
    def _memory(self) -> tuple[int, int]:
        device = self._survey.device
        most = device.max_memory if self.max_memory is None else self.max_memory
        return most, device.info.max_allocation

    def _run(self) -> DistanceField:
        build = self._build or _Build(self._survey, self._plan, self._memory)
        self._build = None
        build.run()
        self._plan = build.plan
        field = build.field()
        if not self._plan.measure:
            return field
        with self.stage("errors"):
            errors = measure_errors(field, self._survey.mesh, self._survey.device)
        return replace(field, reached={**field.reached, "errors": errors})

    def findings(self, result: DistanceField) -> Iterator[str]:
        """Yield warnings about a field: uncertain signs, or no inside."""
        name = self._survey.mesh.name or "mesh"
        if uncertain := self.sign_finding():
            yield uncertain
        if result.sign != "none" and not (result.voxels < 0).any():
            yield (
                f"{name}: the field has no inside: it is negative nowhere, so the mesh encloses "
                f"nothing, or nothing as wide as a leaf of level {result.depth}"
            )

    def sign_finding(self) -> str:
        """Return why signs by pseudo-normals are uncertain, and what is done; "" if certain."""
        plan, mesh = self._plan, self._survey.mesh
        if plan.sign == "none" or plan.closed:
            return ""
        wrong = []
        if default_sign(mesh) != "pseudonormal":
            wrong.append(f"is {once(check_topology)(mesh).summary()}")
        if plan.crossed:
            wrong.append(f"intersects itself in {plan.crossed:,} faces")
        if plan.undecided:
            wrong.append(f"may intersect itself in {plan.undecided:,} faces, near many others")
        if not wrong:
            shells = "has nested shells with the same winding"
            wrong.append("is treated as open" if self._survey.closed else shells)
        done = (
            "signs by pseudo-normals may be wrong: choose --sign winding"
            if plan.sign == "pseudonormal"
            else "inside is where its winding number is over 1/2"
        )
        return f"{mesh.name or 'mesh'} {' and '.join(wrong)}; {done}"


def _programs(survey: Survey, plan: FieldPlan) -> list[Request]:
    """Return the programs that a build uses beyond those of its survey, in order."""
    found: list[Request] = []
    if plan.sign == "winding":
        found += [(WINDING, {}), (DISTANCE, {"BOX": "float"})]
    found += [*programs(plan), (HASHING, {})]
    if plan.max_level > 1:  # one block needs no sort
        found.append((RADIX_SORT, {"KEY": "uint"}))
    if plan.measure:
        found += of_distances(survey.device, plan.sign)
    return found


class _Build:
    """A field under construction: the blocks of the levels built so far, and the next level."""

    def __init__(self, survey: Survey, plan: FieldPlan, memory: tuple[int, int]) -> None:
        survey.device.prepare(*_programs(survey, plan))
        self.work, self.memory = Construction(survey, plan), memory
        self.level = self.work.root()
        self.more = True
        self.plan = replace(plan, refined=(1,), items=self.level.arrays["items"].size)
        self.plan.refuse_beyond(*memory)
        self.identifiers: list[np.ndarray] = []
        self.voxels: list[np.ndarray] = []
        self.codes: list[np.ndarray] = []
        self.missed = self.jumps = 0
        self.worst: tuple[float, int, int] | None = None  # error, level, identifier

    def run(self, last: int | None = None) -> None:
        """Build the levels down to `last`, or all."""
        while self.more and (last is None or self.level.number <= last):
            work, level = self.work, self.level
            ends = level.number + 1 == self.plan.max_level
            windows = windows_of(level, WINDOW) if ends else (level,)
            found = Examined.of([self._examined(window) for window in windows])
            if self.plan.max_bytes is not None and not ends:
                self._limit(found, self.plan.max_bytes)
                work.device.write(level.arrays["ranks"], found.refined)
            self._add_blocks(found)
            refined = found.refined != 0
            self.more = bool(refined.any())
            if self.more:
                counts = *self.plan.refined, int(np.count_nonzero(refined))
                items = int(level.arrays["needed"].get()[refined].sum(dtype=np.int64))
                self.plan = replace(self.plan, refined=counts, items=items)
                self.plan.refuse_beyond(*self.memory)
                self.level = refine(work, level, items)

    def _examined(self, level: Level) -> Examined:
        """Return the children of cells of a level, whose blocks are sampled."""
        sample(self.work, level)
        if self.plan.continuous:
            constrain(self.work, level)
        return examine(self.work, level)

    def _limit(self, found: Examined, max_bytes: int) -> None:
        """Limit refinement to max_bytes: the children with the largest errors come first."""
        left = max_bytes // BLOCK_BYTES - sum(map(len, self.identifiers)) - len(found.voxels) // 27
        candidates = np.flatnonzero(found.refined)
        worst_first = np.argsort(-found.errors[candidates], kind="stable")
        found.refined[candidates[worst_first[max(left, 0) :]]] = 0

    def _add_blocks(self, found: Examined) -> None:
        """Add the blocks of the level, and count its leaves that miss the tolerance."""
        identifiers, errors = self.level.arrays["identifiers"].get(), found.errors
        self.identifiers.append(identifiers)
        self.voxels.append(found.voxels)
        leaves = found.refined == 0
        self.codes.append(np.where(leaves, found.codes, np.uint8(NO_LEAF)))
        self.jumps += int(np.count_nonzero((errors < 0) & leaves))
        over = np.flatnonzero((errors > np.float32(self.plan.tolerance)) & leaves)
        self.missed += len(over)
        if len(over):
            worst = over[np.argmax(errors[over])]
            if self.worst is None or errors[worst] > self.worst[0]:
                identifier = int(identifiers[worst // 8]) << 3 | int(worst % 8)
                self.worst = (float(errors[worst]), self.level.number + 1, identifier)

    def field(self) -> DistanceField:
        """Return the field that consists of the blocks."""
        work, plan, mesh = self.work, self.plan, self.work.survey.mesh
        origin, side = cube_of(mesh)
        identifiers = np.concatenate(self.identifiers)
        levels, ijk = cell_of(identifiers)
        with work.device.stage("hash"):
            table = build_hash(key_of(levels, ijk), work.device)
        reached: dict[str, Any] = {
            "leaves": 7 * len(identifiers) + 1,
            "missed": self.missed,
            "jumps": self.jumps,
        }
        if self.worst:
            error, level, identifier = self.worst
            cell = cell_of(np.array([identifier], np.uint64))[1][0]
            where = origin + side * np.ldexp(cell + 0.5, -level)
            reached["worst"] = {"error": error, "level": level, "where": where.tolist()}
        if plan.continuous:
            reached["balanced"] = not work.unbalanced.get()[0]
        return assemble(
            identifiers.astype(identifier_type(int(levels[-1]))),
            np.concatenate(self.voxels).reshape(-1, 3, 3, 3),
            np.concatenate(self.codes).reshape(-1, 2, 2, 2) if plan.bounds else None,
            table,
            origin=tuple(origin.tolist()),
            side=side,
            sign=plan.sign,
            tolerance=float(plan.tolerance),
            max_level=plan.max_level,
            band=float(plan.band),
            continuous=plan.continuous,
            lipschitz=float(work.steepest.get().view(np.float32)[0]),
            reached=reached,
            plan=plan.scene(),
            source_sha256=mesh.source_sha256,
            units=mesh.units,
            transform=mesh.transform,
        )
