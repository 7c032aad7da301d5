"""Ablation: the same work with one decision of its plan forced, timed in turns with the work as
planned: what the plan leaves out, or another method of [voCCeL].

Only decisions that the code can take otherwise are forced. The results must be the same, bit for
bit.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from voxtool.adf.queries.query import FieldQuery
from voxtool.bench import timing
from voxtool.bench.points import Ablation
from voxtool.svo.surface.plan import COMPACTIONS
from voxtool.tets.pictures.scene import TRANSPARENT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from voxtool.adf.field.field import DistanceField
    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.pictures.rendering import RenderJob
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.surface.extract import ExtractJob
    from voxtool.svo.surface.isosurface import Isosurface

T = TypeVar("T")
VOXELIZE = {  # names in `left_out`, and the decisions that undo them
    "128-bit predicates": {"wide": True},
    "64-bit Morton codes": {"code_bits": 64},
    "blocked level-1 volume": {"blocked": True},
    "sharing of triangles among work-items": {"tiled": True, "tiled_nodes": True},
    "state of rows on entry": {"entry": True},
    "directions of crossings": {"fill": "winding"},
}
LEVELS, JUMPS = "propagation by levels", "jumps to the common ancestor"
METHODS = {  # other methods of voxelization: the decision, and what the plan takes instead
    LEVELS: (
        {"propagation": "levels"}, "rows of solids walk the octree, which needs no neighbours"
    ),
    "tiles of 4 x 4 columns": (
        {"plane_tiles": True}, "the columns of a row that a triangle meets are contiguous"
    ),
    JUMPS: (
        {"addressing": "jumps"}, "the rank of a voxel's node among the active nodes gives its brick"
    ),
    "tests of every box": (
        {"overlap": "base"}, "boxes of a column beyond the triangle's plane are passed over"
    ),
    "Morton codes by table": (
        {"morton": "table"}, "bits are spread by shifts, without a table in memory"
    ),
}  # fmt: skip
FIELD = {
    "faces without a side": {"flat": 1},
    "search for jumps of the sign": {"closed": False, "sign": "pseudonormal"},
    "winding numbers": {"sign": "winding"},
}
EXTRACT = {"cubes away from nodes": {"naive": True}}
PYRAMIDS = {f"histogram pyramid, {arity}:1": name for name, arity in COMPACTIONS.items() if arity}
SCANNED = "a work-item writes all outputs of a tile, from the scan of their numbers"
WIDE = "64-bit identifiers"
W = "w of the hash's offsets"


def compare(
    bench: Bench,
    work: str,
    reasons: dict[str, str],
    planned: Callable[[], T],
    forced: Mapping[str, Callable[[], T]],
    same: Callable[[T, T], bool],
    sizes: Mapping[str, int] | None = None,
) -> Iterator[Ablation]:
    """Yield an ablation for each entry of `forced`.

    Parameters
    ----------
    reasons : why the plan left something out, by its name.
    planned, forced : the work as planned, and with a decision forced.
    same : compares two results.
    sizes : the bytes that leaving something out saves, by its name; by default 0.
    """
    expected = planned()
    for what, run in forced.items():
        equal = same(expected, run())
        runs, others = timing.by_turns(bench.request, planned, run)
        saved = (sizes or {}).get(what, 0)
        yield Ablation(*bench.names, work, what, reasons[what], runs, others, equal, saved)


def of_job(
    job: Job[T],
    decisions: dict[str, dict[str, Any]],
    same: Callable[[T, T], bool],
    bench: Bench,
    work: str,
) -> Iterator[Ablation]:
    """Yield an ablation for each name in the job's `left_out` that `decisions` can undo."""
    others = {what: job.with_(**decisions[what]) for what in job.left_out if what in decisions}
    own = job.plan.cost.device
    sizes = {what: other.plan.cost.device - own for what, other in others.items()}
    forced = {what: other.run for what, other in others.items()}
    yield from compare(bench, work, job.left_out, job.run, forced, same, sizes)


def _same_voxels(planned: Octree, forced: Octree) -> bool:
    return replace(forced, fill=planned.fill).digest() == planned.digest()


def of_left_out_voxels(job: Job[Octree], bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield ablations of what the plan of a voxelization leaves out."""
    yield from of_job(job, VOXELIZE, _same_voxels, bench, work)


def of_voxelize(job: Job[Octree], bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield ablations of a voxelization: what its plan leaves out, and other methods."""
    yield from of_left_out_voxels(job, bench, work)
    others = {what: job.with_(**decision) for what, (decision, _) in METHODS.items()}
    if not job.plan.by_rows:
        del others[LEVELS]
    if job.plan.fill == "flood":
        del others[JUMPS]
    reasons = {what: why for what, (_, why) in METHODS.items()}
    forced = {what: other.run for what, other in others.items()}
    yield from compare(bench, work, reasons, job.run, forced, _same_voxels)


def of_extract(job: ExtractJob, bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield ablations of an extraction by marching cubes: its cubes away from nodes, and histogram
    pyramids in place of the scan, each where it fits in memory."""
    yield from of_cubes(job, bench, work)
    others = {what: job.with_(compaction=name) for what, name in PYRAMIDS.items()}
    forced = {what: other.run for what, other in others.items() if _fits(other, bench)}
    reasons = dict.fromkeys(PYRAMIDS, SCANNED)
    yield from compare(bench, work, reasons, job.run, forced, _same_surface)


def of_cubes(job: ExtractJob, bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield the ablation of an extraction's cubes away from nodes, if all cubes fit in memory."""
    if _fits(job.with_(naive=True), bench):
        yield from of_job(job, EXTRACT, _same_surface, bench, work)


def _same_surface(planned: Isosurface, forced: Isosurface) -> bool:
    return forced.digest() == planned.digest()


def _fits(job: ExtractJob, bench: Bench) -> bool:
    return job.plan.fits(job.limit, bench.timed.info.max_allocation)


def of_field(job: Job[DistanceField], bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield ablations of the build of a field; a field without signs has none."""

    def same(planned: DistanceField, forced: DistanceField) -> bool:
        return replace(forced, sign=planned.sign).digest() == planned.digest()

    if job.plan.sign != "none":
        yield from of_job(job, FIELD, same, bench, work)


def of_picture(job: RenderJob, bench: Bench, work: str) -> Iterator[Ablation]:
    """Yield ablations of a later frame of a volume."""
    scene: Any = job.plan.scene
    every = {"kept": np.ones_like(scene.blocks)}
    yield from of_job(job, {TRANSPARENT: every}, np.array_equal, bench, work)


def of_queries(
    field: DistanceField, points: np.ndarray, bench: Bench, work: str
) -> Iterator[Ablation]:
    """Yield ablations of distances at points: the parts that the textures of a field do not
    hold."""
    table, reasons, fields = field.hash, {}, {}
    if field.cells.shape[-1] == 2:
        reasons[WIDE] = f"leaves end at level {field.depth}"
        fields[WIDE] = replace(field, cells=np.insert(field.cells, 1, 0, axis=-1))
    if not table.has_w:
        reasons[W] = "keys that share an offset differ modulo m"
        offsets = np.insert(table.offsets, 3, table.m, axis=-1)
        fields[W] = replace(field, hash=replace(table, offsets=offsets))

    def distances(query: FieldQuery) -> np.ndarray:
        return query(points).distance

    planned = partial(distances, FieldQuery(field, bench.timed))
    forced = {
        what: partial(distances, FieldQuery(other, bench.timed)) for what, other in fields.items()
    }
    own = sum(field.sizes().values())
    sizes = {what: sum(other.sizes().values()) - own for what, other in fields.items()}
    yield from compare(bench, work, reasons, planned, forced, np.array_equal, sizes)
