"""Distance fields: error against run time."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from voxtool.adf.accuracy import measure_errors
from voxtool.adf.build import build_adf
from voxtool.adf.query import FieldQuery
from voxtool.adf.survey import cube_of
from voxtool.bench import ablation as forced
from voxtool.bench import adf, peers, timing
from voxtool.bench.points import MEASURES, Point
from voxtool.bench.sweep.request import command
from voxtool.files.mesh import load_mesh
from voxtool.spatial.signed_distance import SignedDistance

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from voxtool.bench.points import Saving
    from voxtool.bench.sweep.request import Sweep
    from voxtool.opencl import Device


def of_fields(
    model: str, asked: Sweep, timed: Device, profiled: Device
) -> Iterator[Point | Saving]:
    """Distance fields, and what they say at points of the cube, beside exact distances."""
    mesh = load_mesh(model)
    name, side = Path(model).name, cube_of(mesh)[1]
    many, few = adf.points_of(mesh, asked.queries, max(asked.levels))
    points = (few if asked.queries >= adf.FEW else many)["random"][: asked.queries]
    exact = SignedDistance(mesh, asked.sign, timed)
    distances = exact(points)
    work, finest = f"distances at {len(points):,} points", None
    for level, tolerance in product(asked.levels, asked.tolerances):
        build = partial(
            build_adf, mesh, tolerance=tolerance, max_level=level, band=asked.band,
            sign=asked.sign, measure=False,
        )  # fmt: skip
        profiled.stage_times()
        field = build(profiled)
        stages = profiled.stage_times()
        runs = timing.times(partial(build, timed), asked.repeat + 1)
        request = {"tolerances": tolerance, "max-level": level, "points": asked.queries,
                   "band": None if math.isinf(asked.band) else asked.band,
                   "sign": asked.sign}  # fmt: skip
        point = Point(
            "adf", name, "mesh to field", f"levels to {level}", f"tolerance {tolerance:g}",
            setting={"tolerance": tolerance, "max_level": level, "sign": field.sign},
            runs=runs[1:],  # kernels are compiled in the first
            command=command("adf", model, asked, **request),
            size=field.reached["leaves"], size_of="leaves",
            errors=field_errors(measure_errors(field, mesh, timed)),
            stages=stages,
            left_out=field.plan["left_out"],
            bytes=sum(field.sizes().values()),
        )  # fmt: skip
        yield point
        if finest is None or field.reached["leaves"] >= finest.reached["leaves"]:
            finest = field
        ask = FieldQuery(field, timed)
        answer = ask(points).distance
        profiled_ask = FieldQuery(field, profiled)
        profiled.stage_times()
        yield replace(
            point,
            work=work,
            method=f"field, {point.method}",
            setting={**point.setting, "points": len(points)},
            runs=asked.runs.times(partial(ask, points)),
            stages=timing.stage_times(partial(profiled_ask, points), profiled, 1)[0],
            errors=query_errors(answer, distances, side),
        )
    alone = partial(
        Point, "adf", name, work, label="", setting={"points": len(points)}, size=None
    )  # of what has no field
    again = command("adf", model, replace(asked, peers=True), points=asked.queries)
    yield alone(
        method="exact distances",
        runs=asked.runs.times(partial(exact, points)),
        command=again,
        absent=dict.fromkeys(MEASURES["adf"], "errors are measured against it"),
    )
    if asked.peers:
        others = timing.Peers(asked.repeat)
        for peer in peers.of_distance(mesh):
            distance = peer.build()
            runs, found = others.times(peer.name, partial(distance, points))
            method = f"{peer.name}, building its trees" if peer.builds_each_time else peer.name
            yield alone(
                method=method, runs=runs, command=again, peer=True,
                errors=query_errors(found, distances, side),
            )  # fmt: skip
    if asked.forced and finest is not None:
        level, tolerance = asked.levels[0], asked.tolerances[-1]
        about = {
            "bench": "adf", "model": name,
            "work": f"mesh to field, levels to {level}, tolerance {tolerance:g}",
        }  # fmt: skip
        yield from forced.of_field(
            mesh, timed, asked.runs, about, tolerance=tolerance, max_level=level, band=asked.band,
            sign=asked.sign,
        )  # fmt: skip
        about["work"] = f"{work}, levels to {finest.max_level}, tolerance {finest.tolerance:g}"
        yield from forced.of_queries(finest, points, timed, asked.runs, about)


def field_errors(reached: dict[str, Any]) -> dict[str, float]:
    """The errors that a build measured, as MEASURES names them."""
    return {
        f"{name}{where}": reached[place][name]
        for place, where in (("in the cube", ""), ("near the surface", " near the surface"))
        if reached.get(place, {}).get("points")
        for name in ("rms", "p99", "max")
    }


def query_errors(found: np.ndarray, exact: np.ndarray, side: float) -> dict[str, float]:
    """Likewise of distances at points."""
    errors = adf.errors_at(found, exact, side)
    return {name: errors[name] for name in ("rms", "p99", "max")}
