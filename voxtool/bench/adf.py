"""Distance fields: their error against the time of building and querying them, beside exact
distances at the same points.

A field takes time to build and saves time at each point: the figure "break-even" is the number of
points from which the field, its build and its upload take less time than exact distances.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.construction.accuracy import measure_errors
from voxtool.adf.construction.survey import cube_of
from voxtool.adf.field.cells import cell_of, key_of
from voxtool.adf.field.hashing import build_hash
from voxtool.adf.queries.query import FieldQuery
from voxtool.bench import ablation, timing
from voxtool.bench.distance import build_seconds
from voxtool.bench.points import MEASURES
from voxtool.bench.references import distances_compared
from voxtool.distances import plan_distance, plan_field
from voxtool.files.meshes.mesh import load_mesh
from voxtool.spatial.sampling import sample_cube

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.field import DistanceField
    from voxtool.bench.points import Ablation, Point
    from voxtool.bench.request import Request
    from voxtool.bench.timing import Bench
    from voxtool.job import Job
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

DIRECTION = np.array([2.0, 3.0, 6.0]) / 7  # of rays: a unit vector along no plane of the lattice
SPHERE_RADIUS = 0.195  # a million cells of levels 0 to 10 meet its surface
HASH = "keys of cells to perfect hash"
WORK = {  # by kind of points
    "random": "distances at {:,} random points",
    "rays": "distances at {:,} points along rays",
}


def measure(bench: Bench) -> Iterator[Point | Ablation]:
    """Yield the points and ablations of a model."""
    asked, mesh = bench.request, load_mesh(bench.model)
    distances = list(_exact_distances(mesh, bench))
    fields: list[DistanceField] = []
    for level, tolerance in product(asked.levels, asked.tolerances):
        point, field = _build(mesh, level, tolerance, bench)
        fields.append(field)
        yield point
        yield _hash(f"field, {point.method}", point.label, key_of(*cell_of(field.blocks)), bench)
        for exact in distances:
            yield from _queries(point, field, exact, bench)
    for exact in distances:
        yield from exact.points
    last = asked.sphere_level
    yield _hash("sphere", f"levels to {last}", sphere_keys(last), bench)
    if asked.ablations:
        level, tolerance = asked.levels[0], asked.tolerances[-1]
        work = f"mesh to field, levels to {level}, tolerance {tolerance:g}"
        job = _plan(mesh, bench.timed, asked, level, tolerance)
        yield from ablation.of_field(job, bench, work)
        finest, exact = max(fields, key=lambda field: field.reached["leaves"]), distances[0]
        limits = f"levels to {finest.max_level}, tolerance {finest.tolerance:g}"
        work = f"{exact.points[0].work}, {limits}"
        yield from ablation.of_queries(finest, exact.places, bench, work)


# --- build and hash ------------------------------------------------------------------------------


def _plan(
    mesh: Mesh, device: Device, asked: Request, level: int, tolerance: float
) -> Job[DistanceField]:
    return plan_field(
        mesh, tolerance=tolerance, max_level=level, band=asked.band, fill=asked.fill,
        measure=False, device=device,
    )  # fmt: skip


def _build(mesh: Mesh, level: int, tolerance: float, bench: Bench) -> tuple[Point, DistanceField]:
    """Return a field, and the point of its build."""
    asked, timed = bench.request, bench.timed
    job = _plan(mesh, timed, asked, level, tolerance)
    field = job.run()
    reached, errors = field.reached, measure_errors(field, mesh, timed)
    # of copies, which the device does not have
    upload = timing.times(lambda: FieldQuery(replace(field), timed), asked.repeat)
    figures: dict[str, float | None] = {
        "triangles": len(mesh.faces), "depth": field.depth, "blocks": len(field.voxels),
        "over tolerance": reached["missed"] + reached.get("medial", {}).get("leaves", 0),
        "lipschitz": field.lipschitz,
        "upload": statistics.median(upload),
    }  # fmt: skip
    found = {}
    for place, where in (("in the cube", ""), ("near the surface", " near the surface")):
        if errors.get(place, {}).get("points"):
            found |= {f"{name}{where}": errors[place][name] for name in ("rms", "p99", "max")}
            figures[f"within{where}"] = errors[place]["within"]
    band = None if math.isinf(asked.band) else asked.band
    return bench.point(
        "mesh to field", f"levels to {level}", f"tolerance {tolerance:g}",
        run=lambda device: _plan(replace(mesh), device, asked, level, tolerance).run(),
        asked={"tolerances": tolerance, "levels": level},
        setting={"sign": field.sign, "band": band}, figures=figures,
        size=reached["leaves"], size_of="leaves", errors=found,
        absent={} if "rms" in found else {"rms": "no point of the cube lies within the band"},
        left_out=job.with_(measure=True).left_out, bytes=sum(field.sizes().values()),
    ), field  # fmt: skip


def _hash(method: str, label: str, keys: np.ndarray, bench: Bench) -> Point:
    """Return the point of a perfect hash of (n, 3) keys."""
    n, build = len(keys), partial(build_hash, keys, bench.timed)
    table = build()
    return bench.point(
        HASH, method, label, setting={"keys": n}, runs=timing.by_turns(bench.request, build)[0],
        size=n, size_of="keys", absent=dict.fromkeys(MEASURES["adf"], "a hash has no error"),
        figures={"load": table.load(n), "bits a key": table.bits_a_key(n),
                 "side of slots": table.m, "side of offsets": table.r, "w": int(table.has_w)},
    )  # fmt: skip


def sphere_keys(last: int) -> np.ndarray:
    """Return (n, 3) int64: the keys of the cells of levels 0 to `last` that meet the surface of a
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

    places : (n, 3) float64, world points; distances : (n,) float64; side : the cube's.
    points : the measurements of exact distances and of other tools, in this order.
    """

    places: np.ndarray
    distances: np.ndarray
    side: float
    points: list[Point]

    def compared(self, found: np.ndarray) -> tuple[dict[str, float], dict[str, Any]]:
        """Return the errors of distances at the points, and the figures of their signs."""
        return distances_compared(found, self.distances, self.side)


def _exact_distances(mesh: Mesh, bench: Bench) -> Iterator[_Exact]:
    """Yield the exact distances, and other tools, at the points of each kind."""
    asked, others = replace(bench.request, peers=True), timing.Peers(bench.request.repeat)
    exact = plan_distance(mesh, fill=asked.fill, device=bench.timed).run()
    build = build_seconds(mesh, bench)
    for kind, places in points_of(mesh, asked).items():
        row = partial(
            replace(bench, request=asked).point, WORK[kind].format(len(places)),
            asked={"kinds": kind}, setting={"points": len(places)}, places=len(places),
        )  # fmt: skip
        alone = row(
            "exact distances", runs=timing.by_turns(asked, partial(exact, places))[0],
            absent=dict.fromkeys(MEASURES["adf"], "errors are measured against it"),
            figures={"build": build},
        )  # fmt: skip
        measured = _Exact(places, exact(places), cube_of(mesh)[1], [alone])
        peers = bench.tools.of_distance(mesh) if bench.request.peers else {}
        for peer, prepare in peers.items():
            ready, distance = timing.timed(prepare)
            runs, found = others.times(peer, partial(distance, places))
            if runs:
                errors, signs = measured.compared(found)
                figures = {"build": ready, **signs}
                point = row(peer, runs=runs, peer=True, errors=errors, figures=figures)
                measured.points.append(point)
        yield measured


def _queries(built: Point, field: DistanceField, exact: _Exact, bench: Bench) -> Iterator[Point]:
    """Yield a point for each search of a field."""
    places, alone = exact.places, exact.points[0]
    asks = {device: FieldQuery(field, device) for device in (bench.timed, bench.profiled)}
    spent = built.seconds + (built.figures["upload"] or 0) - (alone.figures["build"] or 0)
    for search in bench.request.searches:
        errors, figures = exact.compared(asks[bench.timed](places, search=search).distance)
        point = bench.point(
            alone.work, f"field, {built.method}, {search} search", built.label,
            run=lambda device, search=search: asks[device](places, search=search),
            setting={**built.setting, "points": len(places), "search": search},
            errors=errors, figures=figures, places=len(places),
            size=built.size, size_of=built.size_of, bytes=built.bytes,
        )  # fmt: skip
        even = break_even(spent, alone.seconds - point.seconds)
        count = None if even is None else math.ceil(even * len(places))
        figures = {**point.figures, "break-even": count}
        yield replace(point, figures=figures, command=built.command)


def break_even(spent: float, saved: float) -> float | None:
    """Return the number of runs after which the seconds saved in each make up for the seconds
    spent; None if no time is saved."""
    return None if saved <= 0 else max(0.0, spent / saved)


def points_of(mesh: Mesh, request: Request) -> dict[str, np.ndarray]:
    """Return (n, 3) float64 world points in the cube of a mesh, by kind: "random" are quasi-random,
    as many as the request asks for; "rays" lie along rays, in order, and fill the last ray."""
    origin, side = cube_of(mesh)
    step = 0.5 ** (max(request.levels) + 1)
    makers = {
        "random": lambda: sample_cube(request.points),
        "rays": lambda: rays_through_cube(request.points, step).reshape(-1, 3),
    }
    return {kind: origin + side * makers[kind]() for kind in request.kinds}


def rays_through_cube(count: int, step: float) -> np.ndarray:
    """Return (rays, n, 3) float64: points of the unit cube, `step` apart along parallel rays, at
    least `count` together; row by row, like the pixels of a picture.

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
