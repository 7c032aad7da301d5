"""Distance fields: their error against the time of building them and of asking them, beside exact
distances at the same points.

A field costs its build and saves time at each point: the figure "break-even" is the number of
points from which the field, its build and its upload take less time than exact distances.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.accuracy import measure_errors
from voxtool.adf.build import plan_adf
from voxtool.adf.cells import cell_of, key_of
from voxtool.adf.hashing import build_hash
from voxtool.adf.query import FieldQuery
from voxtool.adf.survey import cube_of
from voxtool.bench import ablation, timing
from voxtool.bench.points import MEASURES, Point
from voxtool.bench.references import distance_errors, sign_figures
from voxtool.files.mesh import load_mesh
from voxtool.spatial.sampling import sample_cube
from voxtool.spatial.signed_distance import SignedDistance

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field import DistanceField
    from voxtool.bench.points import Ablation
    from voxtool.bench.request import Request
    from voxtool.bench.timing import Bench
    from voxtool.mesh.mesh import Mesh

DIRECTION = np.array([2.0, 3.0, 6.0]) / 7  # of rays: a unit vector along no plane of the lattice
SPHERE_RADIUS = 0.195  # a million cells of levels 0 to 10 meet its surface
NO_ERROR = "a hash has no error"
HASH = "keys of cells to perfect hash"
WORK = {  # by kind of points
    "random": "distances at {:,} random points",
    "rays": "distances at {:,} points along rays",
}


def measure(model: str, bench: Bench) -> Iterator[Point | Ablation]:
    """The points and ablations of a model."""
    asked, mesh = bench.request, load_mesh(model)
    distances = list(_exact_distances(mesh, model, bench))
    built: list[tuple[Point, DistanceField]] = []
    for level, tolerance in product(asked.levels, asked.tolerances):
        point, field = _build(mesh, model, level, tolerance, bench)
        built.append((point, field))
        yield point
        keys = key_of(*cell_of(field.blocks))
        yield _hash(f"field, {point.method}", point.label, keys, model, bench)
        for exact in distances:
            yield from _queries(point, field, exact, bench)
    for exact in distances:
        yield from exact.points
    sphere = sphere_keys(asked.sphere_level)
    yield _hash("sphere", f"levels to {asked.sphere_level}", sphere, model, bench)
    if asked.ablations:
        level, tolerance = asked.levels[0], asked.tolerances[-1]
        about = {"bench": "adf", "model": Path(model).name,
                 "work": f"mesh to field, levels to {level}, tolerance {tolerance:g}"}  # fmt: skip
        job = plan_adf(
            mesh, tolerance=tolerance, max_level=level, band=asked.band, sign=asked.sign,
            measure=False, device=bench.timed,
        )  # fmt: skip
        yield from ablation.of_field(job, bench, about)
        finest = max((field for _, field in built), key=lambda field: field.reached["leaves"])
        about["work"] = (
            f"{distances[0].work}, levels to {finest.max_level}, tolerance {finest.tolerance:g}"
        )
        yield from ablation.of_queries(finest, distances[0].places, bench, about)


# --- build and hash ------------------------------------------------------------------------------


def _build(
    mesh: Mesh, model: str, level: int, tolerance: float, bench: Bench
) -> tuple[Point, DistanceField]:
    """A field, and the point of its build."""
    asked = bench.request
    plan = partial(
        plan_adf, tolerance=tolerance, max_level=level, band=asked.band, sign=asked.sign,
        measure=False,
    )  # fmt: skip
    job = plan(mesh, device=bench.timed)
    field = job.run()
    reached, errors = field.reached, measure_errors(field, mesh, bench.timed)
    upload = timing.times(lambda: FieldQuery(replace(field), bench.timed), asked.repeat)
    # of copies, of which nothing is on the device
    measured = bench.measured(lambda device: plan(replace(mesh), device=device).run())
    figures: dict[str, float | None] = {
        "triangles": len(mesh.faces), "depth": field.depth, "blocks": len(field.voxels),
        "over tolerance": reached["missed"], "lipschitz": field.lipschitz,
        "upload": statistics.median(upload),
    }  # fmt: skip
    found = {}
    for place, where in (("in the cube", ""), ("near the surface", " near the surface")):
        if errors.get(place, {}).get("points"):
            found |= {f"{name}{where}": errors[place][name] for name in ("rms", "p99", "max")}
            figures[f"within{where}"] = errors[place]["within"]
    setting = {"tolerances": tolerance, "levels": level}
    point = Point(
        "adf", Path(model).name, "mesh to field", f"levels to {level}", f"tolerance {tolerance:g}",
        setting={**setting, "sign": field.sign,
                 "band": None if math.isinf(asked.band) else asked.band},
        command=asked.command("adf", model, **setting),
        size=reached["leaves"], size_of="leaves",
        errors=found, left_out=job.with_(measure=True).left_out, bytes=sum(field.sizes().values()),
        **measured,
    )  # fmt: skip
    absent = {} if "rms" in found else {"rms": "no point of the cube lies within the band"}
    return replace(point, figures={**figures, **point.figures}, absent=absent), field


def _hash(method: str, label: str, keys: np.ndarray, model: str, bench: Bench) -> Point:
    """The point of a perfect hash of (n, 3) keys."""
    n = len(keys)
    table = build_hash(keys, bench.timed)
    return Point(
        "adf", Path(model).name, HASH, method, label,
        setting={"keys": n},
        runs=bench.request.runs.times(partial(build_hash, keys, bench.timed)),
        command=bench.request.command("adf", model),
        size=n, size_of="keys",
        absent=dict.fromkeys(MEASURES["adf"], NO_ERROR),
        figures={"load": table.load(n), "bits a key": table.bits_a_key(n),
                 "side of slots": table.m, "side of offsets": table.r, "w": int(table.has_w)},
    )  # fmt: skip


def sphere_keys(last: int) -> np.ndarray:
    """(n, 3) int64: the keys of the cells of levels 0 to `last` that meet the surface of a
    sphere."""
    octants = np.indices((2, 2, 2)).reshape(3, 8).T
    centre = np.array([0.5, 0.48, 0.51])  # symmetric to no cell
    cells, keys = np.zeros((1, 3), np.int64), []
    for level in range(last + 1):
        low = cells * 0.5**level - centre
        high = low + 0.5**level
        nearest, farthest = np.maximum(np.maximum(low, -high), 0), np.maximum(-low, high)
        met = (nearest * nearest).sum(axis=1) <= SPHERE_RADIUS**2
        met &= (farthest * farthest).sum(axis=1) >= SPHERE_RADIUS**2
        cells = cells[met]
        keys.append(key_of(level, cells))
        cells = (2 * cells[:, None] + octants).reshape(-1, 3)
    return np.concatenate(keys)


# --- distances at points -------------------------------------------------------------------------


@dataclass(frozen=True)
class _Exact:
    """Exact distances at points of one kind.

    work : what is timed; places : (n, 3) float64, world points; distances : (n,) float64; side : of
    the cube. build, seconds : of the tree, and of asking at all points. points : what was measured
    without a field.
    """

    work: str
    places: np.ndarray
    distances: np.ndarray
    side: float
    build: float
    seconds: float
    points: list[Point]


def _exact_distances(mesh: Mesh, model: str, bench: Bench) -> Iterator[_Exact]:
    """The exact distances, and other tools, at the points of each kind."""
    asked = bench.request
    exact, side = SignedDistance(mesh, asked.sign, bench.timed), cube_of(mesh)[1]

    def make() -> SignedDistance:
        """Build the tree of a copy of the mesh, of which nothing is on the device."""
        return SignedDistance(replace(mesh), asked.sign, bench.timed)

    build = statistics.median(timing.times(make, asked.repeat))
    others = timing.Peers(asked.repeat)
    for kind, places in points_of(mesh, asked).items():
        distances, work = exact(places), WORK[kind].format(len(places))
        runs = asked.runs.times(partial(exact, places))
        row = partial(
            Point, "adf", Path(model).name, work, label="", setting={"points": len(places)},
            command=replace(asked, peers=True).command("adf", model, kinds=kind),
        )  # fmt: skip
        points = [
            row(
                method="exact distances", runs=runs,
                absent=dict.fromkeys(MEASURES["adf"], "errors are measured against it"),
                figures={"build": build, **_a_point(runs, places)},
            )
        ]  # fmt: skip
        for peer in bench.tools.of_distance(mesh) if asked.peers else ():
            start = time.perf_counter()
            distance = peer.build()
            ready = time.perf_counter() - start
            runs, found = others.times(peer.name, partial(distance, places))
            if not runs:
                continue
            name = f"{peer.name}, building its trees" if peer.builds_each_time else peer.name
            points.append(
                row(
                    method=name, runs=runs, peer=True,
                    errors=distance_errors(found, distances, side),
                    figures={"build": ready, **_a_point(runs, places),
                             **sign_figures(found, distances, side)},
                )
            )  # fmt: skip
        seconds = points[0].seconds
        yield _Exact(work, places, distances, side, build, seconds, points)


def _queries(built: Point, field: DistanceField, exact: _Exact, bench: Bench) -> Iterator[Point]:
    """A point for each search of a field."""
    places = exact.places
    upload, ready = built.figures["upload"] or 0.0, FieldQuery(field, bench.timed)
    asks = {bench.timed: ready, bench.profiled: FieldQuery(field, bench.profiled)}
    for search in bench.request.searches:
        found = ready(places, search=search).distance
        measured = bench.measured(lambda device, search=search: asks[device](places, search=search))
        point = replace(
            built,
            work=exact.work,
            method=f"field, {built.method}, {search} search",
            setting={**built.setting, "points": len(places), "search": search},
            errors=distance_errors(found, exact.distances, exact.side),
            absent={},
            left_out={},
            **measured,
        )
        even = break_even(built.seconds + upload - exact.build, exact.seconds - point.seconds)
        figures = {
            **_a_point(point.runs, places),
            **sign_figures(found, exact.distances, exact.side),
            "break-even": None if even is None else math.ceil(even * len(places)),
        }
        yield replace(point, figures={**figures, **point.figures})


def break_even(spent: float, saved: float) -> float | None:
    """The number of runs after which the seconds saved in each make up for the seconds spent; None
    if nothing is saved."""
    return None if saved <= 0 else max(0.0, spent / saved)


def _a_point(runs: list[float], places: np.ndarray) -> dict[str, float]:
    return {"ns a point": 1e9 * statistics.median(runs) / len(places)}


def points_of(mesh: Mesh, request: Request) -> dict[str, np.ndarray]:
    """(n, 3) float64 world points in the cube of a mesh, by kind: "random" are quasi-random, as
    many as the request asks for; "rays" follow each other along rays, up to a whole ray more."""
    origin, side = cube_of(mesh)
    step = 0.5 ** (max(request.levels) + 1)
    makers = {
        "random": lambda: sample_cube(request.points),
        "rays": lambda: rays_through_cube(request.points, step).reshape(-1, 3),
    }
    return {kind: origin + side * makers[kind]() for kind in request.kinds}


def rays_through_cube(count: int, step: float) -> np.ndarray:
    """(rays, n, 3) float64: points of the unit cube, `step` apart along parallel rays, at least
    `count` together; row by row, like the pixels of a picture.

    The rays run along DIRECTION, from z = 0 to z = 1, and none leaves the cube before.
    """
    length = 1 / DIRECTION[2]
    along = np.arange(step / 2, length, step)
    rays = -(-count // len(along))
    columns = math.isqrt(rays - 1) + 1
    row, column = np.divmod(np.arange(rays), columns)
    rows = int(row[-1]) + 1
    starts = np.zeros((rays, 3))
    starts[:, 0] = (column + 0.5) / columns * (1 - length * DIRECTION[0])
    starts[:, 1] = (row + 0.5) / rows * (1 - length * DIRECTION[1])
    return starts[:, None] + along[:, None] * DIRECTION
