"""Errors against time of surfaces of distance fields, beside those that other tools extract from
samples of the field at the edges of its deepest leaves."""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.construction.build import build_adf
from voxtool.adf.queries.query import query_adf
from voxtool.adf.surface.extract import plan_field_surface
from voxtool.bench import timing
from voxtool.bench.references import Reference, capped, surface_of_peer
from voxtool.choices import SHARP
from voxtool.files.meshes.mesh import load_mesh

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.field import DistanceField
    from voxtool.bench.points import Point
    from voxtool.bench.timing import Bench

WORK = "field to surface"
ROUND = "dual contouring"
MOST_SAMPLES = 9  # deepest level of a field that is sampled densely, for other tools


def measure(bench: Bench) -> Iterator[Point]:
    """Yield the points of extracting surfaces from fields of a model."""
    asked, mesh, others = bench.request, load_mesh(bench.model), timing.Peers(bench.request.repeat)
    against = Reference(*capped(mesh), asked.samples, bench.timed)
    for level, tolerance in product(asked.levels, asked.tolerances):
        field = build_adf(mesh, bench.timed, tolerance=tolerance, max_level=level, measure=False)
        row = partial(
            bench.point, WORK, label=f"levels to {level}, tolerance {tolerance:g}",
            size=sum(field.leaves_by_level()), size_of="leaves",
            asked={"levels": level, "tolerances": tolerance, "samples": asked.samples},
            setting={"against": against.words},
        )  # fmt: skip
        for method, source in ((ROUND, None), (SHARP, mesh)):
            plan = partial(plan_field_surface, field, source=source)
            job = plan(device=bench.timed)
            made = job.run()
            found = against.errors_of(made.mesh())
            yield row(
                method=method,
                run=lambda device, plan=plan: plan(device=device).run(),
                figures={
                    "vertices": float(len(made.vertices)),
                    "triangles": float(len(made.faces)),
                    **against.in_voxels(found, made.pitch),
                },
                left_out=job.plan.left_out,
                bytes=made.vertices.nbytes + made.faces.nbytes,
                **found,
            )  # fmt: skip
        if not asked.peers or field.depth > MOST_SAMPLES:
            continue
        step = field.side / (1 << field.depth)
        for peer, run in bench.tools.of_grid(partial(samples_of, field), 0.0).items():
            runs, result = others.times(peer, run)
            if runs:
                surface = surface_of_peer(result, np.array(field.origin), step)
                found = against.errors_of(surface)
                figures = against.in_voxels(found, step)
                yield row(method=peer, runs=runs, peer=True, figures=figures, **found)


def samples_of(field: DistanceField) -> np.ndarray:
    """Return (n, n, n) float32: distances at the corners of the deepest leaves, [z, y, x]."""
    ticks = np.arange((1 << field.depth) + 1) * (field.side / (1 << field.depth))
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) + np.array(field.origin)
    return query_adf(field, points).distance.reshape(z.shape).astype(np.float32)
