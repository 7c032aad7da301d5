"""Ablation: the same work with one decision of its plan forced, timed in turns with the work as
planned.

Only what the code can do otherwise is forced. The result must be the same, bit for bit.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from voxtool.adf.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.points import Ablation
from voxtool.tets.scene import TRANSPARENT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.adf.field import DistanceField
    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.rendering import RenderJob
    from voxtool.svo.octree import Octree

T = TypeVar("T")
VOXELIZE = {  # what a plan leaves out, and the decisions that take it in
    "128-bit predicates": {"wide": True},
    "64-bit Morton codes": {"code_bits": 64},
    "blocked level-1 volume": {"blocked": True},
    "sharing of triangles among work-items": {"tiled": True, "tiled_nodes": True},
    "state of rows on entry": {"entry": True},
    "directions of crossings": {"fill": "winding"},
}
FIELD = {
    "faces without a side": {"flat": 1},
    "search for jumps of the sign": {"closed": False, "sign": "pseudonormal"},
    "winding numbers": {"sign": "winding"},
}
WIDE = "64-bit identifiers"
W = "w of the hash's offsets"


def of_job(
    job: Job[T],
    decisions: dict[str, dict[str, Any]],
    same: Callable[[T, T], bool],
    bench: Bench,
    about: dict[str, str],
) -> Iterator[Ablation]:
    """One ablation for each thing that a job leaves out and that a decision takes in.

    Parameters
    ----------
    decisions : fields of the plan, by the words of `left_out`.
    same : whether two results are the same.
    about : the fields bench, model and work.
    """
    planned = job.run()
    for what, why in job.left_out.items():
        if what not in decisions:
            continue
        forced = job.with_(**decisions[what])
        equal = same(planned, forced.run())
        runs, others = bench.request.runs.by_turns(
            partial(_time, job.run), partial(_time, forced.run)
        )
        yield Ablation(**about, what=what, why=why, runs=runs, forced=others, same=equal)


def of_voxelize(job: Job[Octree], bench: Bench, about: dict[str, str]) -> Iterator[Ablation]:
    """Ablations of a voxelization."""

    def same(planned: Octree, forced: Octree) -> bool:
        return replace(forced, fill=planned.fill).digest() == planned.digest()

    yield from of_job(job, VOXELIZE, same, bench, about)


def of_field(job: Job[DistanceField], bench: Bench, about: dict[str, str]) -> Iterator[Ablation]:
    """Ablations of the build of a field; of one without signs there are none."""

    def same(planned: DistanceField, forced: DistanceField) -> bool:
        return replace(forced, sign=planned.sign).digest() == planned.digest()

    if job.plan.sign != "none":
        yield from of_job(job, FIELD, same, bench, about)


def of_picture(job: RenderJob, bench: Bench, about: dict[str, str]) -> Iterator[Ablation]:
    """Ablations of a later frame of a volume."""
    scene: Any = job.plan.scene
    every = {"kept": np.ones_like(scene.blocks)}
    yield from of_job(job, {TRANSPARENT: every}, np.array_equal, bench, about)


def of_queries(
    field: DistanceField, points: np.ndarray, bench: Bench, about: dict[str, str]
) -> Iterator[Ablation]:
    """Ablations of distances at points: what the textures of a field do not hold."""
    table, otherwise = field.hash, {}
    if field.cells.shape[-1] == 2:
        high = np.insert(field.cells, 1, 0, axis=-1)
        why = f"leaves end at level {field.depth}"
        otherwise[WIDE] = replace(field, cells=high), why
    if not table.has_w:
        offsets = np.insert(table.offsets, 3, table.m, axis=-1)
        why = "keys that share an offset differ modulo m"
        otherwise[W] = replace(field, hash=replace(table, offsets=offsets)), why
    planned = FieldQuery(field, bench.timed)
    answer = planned(points).distance
    for what, (other, why) in otherwise.items():
        forced = FieldQuery(other, bench.timed)
        same = np.array_equal(forced(points).distance, answer)
        runs, others = bench.request.runs.by_turns(
            partial(_time, partial(planned, points)), partial(_time, partial(forced, points))
        )
        yield Ablation(**about, what=what, why=why, runs=runs, forced=others, same=same)


def _time(work: Callable[[], object]) -> float:
    return timing.times(work, 1)[0]
