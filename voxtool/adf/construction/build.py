"""Building the adaptively sampled distance field of a mesh.

The octree grows level by level, from the root (level 0) to the leaves. A child is refined if its
trilinear interpolation is further from the exact distance than the tolerance [Frisken 2000]. The
stages of a level are in levels.py.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Self

import numpy as np

from voxtool.adf.construction.accuracy import helped_by_depth, measure_errors
from voxtool.adf.construction.plan import BLOCK_BYTES, PILOT_LEVEL, FieldPlan
from voxtool.adf.construction.stages import (
    LEFT_LEAF,
    THIN_LEAF,
    Construction,
    Examined,
    Level,
    constrain,
    examine,
    programs,
    ranks_of,
    refine,
    sample,
    windows_of,
)
from voxtool.adf.construction.survey import UNSEEN, Decide, Survey, cube_of
from voxtool.adf.construction.waiting_levels import Store, Waiting
from voxtool.adf.field.cells import JUMP, NO_LEAF, bound_values, cell_of, identifier_type, key_of
from voxtool.adf.field.field import DistanceField, assemble
from voxtool.adf.field.hashing import SOURCE as HASHING
from voxtool.adf.field.hashing import build_hash
from voxtool.errors import human
from voxtool.job import Job
from voxtool.mesh.counts import PROGRAMS as COUNTING
from voxtool.mesh.counts import check_topology
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.once import once
from voxtool.mesh.topology import shells_of, volume
from voxtool.morton import distinct
from voxtool.opencl import Device, default_device
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import RADIX_SORT
from voxtool.spatial.distance import SOURCE as DISTANCE
from voxtool.spatial.fill_rule import inside_as_wound
from voxtool.spatial.signed_distance import programs as of_distances
from voxtool.spatial.winding_number import SOURCE as WINDING


def build_adf(mesh: Mesh, device: Device | None = None, **request: Any) -> DistanceField:
    """Return the distance field of a mesh: `plan_adf(...).run()`; see voxtool.build_adf."""
    return plan_adf(mesh, device=device, **request).run()


def plan_adf(
    mesh: Mesh,
    *,
    sign: str | None = None,
    decide: Decide = inside_as_wound,
    device: Device | None = None,
    max_memory: int | None = None,
    stores: Callable[[], Store] | None = None,
    **request: Any,
) -> FieldJob:
    """Return the job of building the distance field of a mesh.

    sign: one of voxtool.choices.FIELD_SIGNS, or None for that of what `decide` returns, given mesh
    and device. stores: makes a store where levels and blocks wait that exceed max_memory; without
    it the field is refused. request: tolerance, max_level, band, guarantee, everywhere,
    continuous, bounds, max_bytes, measure and max_texture, as in voxtool.build_adf.
    """
    plan = FieldPlan(triangles=len(mesh.faces), sign=sign or "", **request)
    survey = Survey(mesh, device or default_device(), sign != "none", decide)
    plan = replace(
        plan,
        flat=survey.flat,
        closed=survey.closed,
        sign=sign or ("pseudonormal" if survey.closed else "winding"),
    )
    return FieldJob(survey, plan, max_memory, stores)


class FieldJob(Job["DistanceField"]):
    """A planned build of a distance field; see voxtool.plan_adf.

    `plan` and `describe()` build the upper levels to predict the others; `run()` continues there.
    """

    def __init__(
        self,
        survey: Survey,
        plan: FieldPlan,
        max_memory: int | None,
        stores: Callable[[], Store] | None,
    ) -> None:
        self.device, self.max_memory, self.stores = survey.device, max_memory, stores
        self._survey, self._plan = survey, plan
        self._build: _Build | None = None  # the upper levels, once they are built

    @property
    def plan(self) -> FieldPlan:
        """The decisions, and the number of cells of each level that has been built."""
        if not self._plan.refined:
            self._build = _Build(self._survey, self._plan, self._memory, self.stores)
            self._build.run(PILOT_LEVEL - 1)
            self._build.make_room()
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
            survey = self._survey
            job._survey = Survey(survey.mesh, survey.device, signed, survey.decide)
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
        build = self._build or _Build(self._survey, self._plan, self._memory, self.stores)
        self._build = None
        build.run()
        survey = self._survey
        build.plan = replace(build.plan, crossed=survey.crossed, undecided=survey.undecided)
        self._plan = build.plan
        field = build.field()
        if not self._plan.measure:
            return field
        with self.stage("errors"):
            errors = measure_errors(field, survey.mesh, survey.device, normals=survey.normals)
        return replace(field, reached={**field.reached, "errors": errors})

    def findings(self, result: DistanceField) -> Iterator[str]:
        """Yield warnings about a field: uncertain signs, no inside, or too thin a mesh."""
        name = self._survey.mesh.name or "mesh"
        if uncertain := self.sign_finding():
            yield uncertain
        if result.sign != "none" and not (result.voxels < 0).any():
            yield (
                f"{name}: the field has no inside: it is negative nowhere, so the mesh encloses "
                f"nothing, or nothing as wide as a leaf of level {result.depth}"
            )
        elif thin := result.reached.get("thin"):
            ends = result.depth == self._plan.max_level
            finer = "higher --max-level" if ends else "smaller --tolerance"
            yield (
                f"{name}: the mesh is thinner than the leaves in {thin['leaves']:,} of them, of "
                f"level {result.depth} at most; surfaces of the field are thicker there, or have "
                f"holes: choose a {finer}"
            )

    def notes(self, result: DistanceField) -> list[str]:
        """Return what was decided to be inside, if there is something to say."""
        return self.doubts(result)

    def details(self, result: DistanceField) -> Iterator[str]:
        """Yield a remark if voxels and levels waited on the disk."""
        if self._plan.stored:
            most = human(self._memory[0])
            yield f"built in windows: what does not fit in {most} waited on the disk"

    def doubts(self, result: DistanceField) -> list[str]:
        """Return a line on what was decided to be inside, if there is something to say."""
        survey = self._survey
        automatic = survey.inside and self._plan.sign == survey.inside.sign
        return survey.inside.note(survey.mesh) if survey.inside and automatic else []

    def sign_finding(self) -> str:
        """Return why signs are uncertain, and what is done; "" if they are certain, or parts of a
        closed mesh are united."""
        plan, survey, mesh = self._plan, self._survey, self._survey.mesh
        if plan.sign == "none" or plan.closed or (survey.inside and survey.inside.parts):
            return ""
        wrong = []
        if _is_warned(survey, plan):
            wrong.append(f"is {once(check_topology)(mesh, survey.device).summary()}")
        if plan.crossed:
            least = "at least " * bool((survey.found == UNSEEN).any())
            wrong.append(f"intersects itself in {least}{plan.crossed:,} faces")
        if plan.undecided:
            wrong.append(f"may intersect itself in {plan.undecided:,} faces, near many others")
        if not wrong:
            wrong.append("is treated as open")
        done = (
            "signs by pseudo-normals may be wrong: choose fill winding"
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
    if _is_warned(survey, plan):
        found += COUNTING
    return found


def _is_warned(survey: Survey, plan: FieldPlan) -> bool:
    """Return whether a warning says how the mesh's edges make signs uncertain."""
    if plan.sign == "none" or plan.closed or not survey.inside:
        return False
    return survey.inside.meeting is None or survey.flat > 0


class _Build:
    """A field under construction: the blocks of the levels built so far, and the next level.

    parts : the refined children of one window each, in the next level; ranks : those of the level
    above. stores : makes a store, or None; waiting : the store of the level that is made; stored :
    that of all voxels, or None while they are in memory.
    """

    def __init__(
        self,
        survey: Survey,
        plan: FieldPlan,
        memory: tuple[int, int],
        stores: Callable[[], Store] | None,
    ) -> None:
        survey.device.prepare(*_programs(survey, plan))
        self.work, self.memory = Construction(survey, plan), memory
        self.stores = stores if plan.max_bytes is None else None  # errors of whole levels compare
        root = self.work.root()
        self.number, self.ranks = 0, np.zeros(0, np.uint32)
        self.parts: list[Level | Waiting] = [root]
        self.plan = replace(plan, refined=(1,), items=root.arrays["items"].size)
        self.waiting: Store | None = None
        self.stored: Store | None = None
        self.identifiers: list[np.ndarray] = []
        self.voxels = np.empty(0, np.float32)  # grows in place, so that it is never there twice
        self.codes: list[np.ndarray] = []
        self.missed = self.jumps = self.thin = self.unproved = 0
        self.medial = self.left = 0
        self.worst: dict[bool, tuple[float, int, int]] = {}  # error, level, identifier; if medial

    def run(self, last: int | None = None) -> None:
        """Build the levels down to `last`, or all."""
        while self.parts and (last is None or self.number <= last):
            self.make_room()
            self.plan.refuse_beyond(*self.memory)
            flags: list[np.ndarray] = []
            finer: list[Level | Waiting] = []
            for level in self._windows():
                refined, children = self._built(level)
                flags.append(refined)
                if children:
                    finer.append(Waiting.of(children, self.waiting) if self.waiting else children)
            self.number, self.parts = self.number + 1, finer
            if finer:
                self.ranks = ranks_of(flags)

    def make_room(self) -> None:
        """Begin to keep levels and voxels in stores, if they will exceed memory."""
        if not self.stores:
            return
        self.plan = self.plan.fitting(*self.memory)
        if not self.plan.stored:
            return
        self.waiting = self.stores()
        if self.stored is None:
            self.stored = self.stores()
            self.stored.put(self.voxels)
            self.voxels.resize(0, refcheck=False)

    def _windows(self) -> Iterator[Level]:
        """Yield the cells of the level in windows, on the device."""
        ranks = self.work.device.put(self.ranks)
        size = self.plan.window if self.plan.max_bytes is None else math.inf
        while self.parts:
            part = self.parts.pop(0)
            level = part.level(self.work.device) if isinstance(part, Waiting) else part
            level.arrays["parent_ranks"] = ranks
            yield from windows_of(level, size)

    def _built(self, level: Level) -> tuple[np.ndarray, Level | None]:
        """Return which children of a level's cells are refined, uint32, and these, if there are
        any."""
        found = self._examined(level)
        ends = level.number + 1 == self.plan.max_level
        if self.plan.max_bytes is not None and not ends:
            self._limit(found, self.plan.max_bytes)
            self.work.device.write(level.arrays["ranks"], found.refined)
        self._add_blocks(level, found)
        refined = found.refined != 0
        if not refined.any():
            return found.refined, None
        items = int(level.arrays["needed"].get()[refined].sum(dtype=np.int64))
        self._count(level.number + 1, int(np.count_nonzero(refined)), items)
        return found.refined, refine(self.work, level, items)

    def _count(self, level: int, cells: int, items: int) -> None:
        """Count cells of a level, and the triangles of their lists; refuse what does not fit."""
        counts = list(self.plan.refined)
        if len(counts) == level:
            counts.append(0)
            self.plan = replace(self.plan, items=0)
        counts[level] += cells
        self.plan = replace(self.plan, refined=tuple(counts), items=self.plan.items + items)
        if not self.stores:
            self.plan.refuse_beyond(*self.memory)

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

    def _add_blocks(self, level: Level, found: Examined) -> None:
        """Add the blocks of a level's cells, and count their leaves that miss the tolerance."""
        identifiers, errors = level.arrays["identifiers"].get(), found.errors
        self.identifiers.append(identifiers)
        if self.stored:
            self.stored.put(found.voxels)
        else:
            before = self.voxels.size
            self.voxels.resize(before + found.voxels.size, refcheck=False)
            self.voxels[before:] = found.voxels
        leaves = found.refined == 0
        if self.plan.guarantee:
            least = np.searchsorted(bound_values()[:JUMP], self.plan.tolerance)
            self.unproved += int(np.count_nonzero((found.codes > least) & leaves))
        self.codes.append(np.where(leaves, found.codes, np.uint8(NO_LEAF)))
        self.jumps += int(np.count_nonzero((errors < 0) & leaves))
        self.thin += int(np.count_nonzero(found.kinds == THIN_LEAF))
        over = np.flatnonzero((errors > np.float32(self.plan.tolerance)) & leaves)
        if not len(over):
            return
        left = found.kinds[over] == LEFT_LEAF
        helped = helped_by_depth(found.voxels, over, errors[over], level.number + 1) & ~left
        self.missed += int(np.count_nonzero(helped))
        self.medial += int(np.count_nonzero(~helped))
        self.left += int(np.count_nonzero(left))
        for medial in (False, True):
            if len(those := over[helped != medial]):
                worst = those[np.argmax(errors[those])]
                if errors[worst] > self.worst.get(medial, (0,))[0]:
                    identifier = int(identifiers[worst // 8]) << 3 | int(worst % 8)
                    self.worst[medial] = (float(errors[worst]), level.number + 1, identifier)

    def field(self) -> DistanceField:
        """Return the field that consists of the blocks."""
        work, plan, mesh = self.work, self.plan, self.work.survey.mesh
        origin, side = cube_of(mesh)
        identifiers = np.concatenate(self.identifiers)
        shape = len(identifiers), 3, 3, 3
        voxels = (
            self.stored.mapped(np.float32, shape) if self.stored else self.voxels.reshape(shape)
        )
        levels, ijk = cell_of(identifiers)
        with work.device.stage("hash"):
            keys = key_of(levels, ijk)
            table = build_hash(keys, work.device)
        reached: dict[str, Any] = {
            "leaves": 7 * len(identifiers) + 1,
            "missed": self.missed,
            "jumps": self.jumps,
        }
        if self.thin:
            of = shells_of(mesh)
            shells = len(distinct(of[of >= 0]))
            reached["thin"] = {"leaves": self.thin, "shells": shells, "volume": volume(mesh)}
        if plan.guarantee:
            reached["unproved"] = self.unproved
        for medial, (error, level, identifier) in self.worst.items():
            cell = cell_of(np.array([identifier], np.uint64))[1][0]
            where = origin + side * np.ldexp(cell + 0.5, -level)
            worst = {"error": error, "level": level, "where": where.tolist()}
            counts = {"leaves": self.medial, "left": self.left}
            reached |= {"medial": {**counts, **worst}} if medial else {"worst": worst}
        if plan.continuous:
            reached["balanced"] = not work.unbalanced.get()[0]
            reached["kept"] = int(work.kept.get()[0])
        return assemble(
            identifiers.astype(identifier_type(int(levels[-1]))),
            keys,
            voxels,
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
            plan=plan.decisions(),
            source_sha256=mesh.source_sha256,
            units=mesh.units,
            transform=mesh.transform,
        )
