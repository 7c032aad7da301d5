"""Distance fields against run time: build, hash, queries and error; beside them the exact distance
and peers, at the same points.

A field costs its build, and saves time at each point that it is asked at: the break-even says at
how many points it has paid for itself.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.accuracy import measure_errors
from voxtool.adf.build import build_adf
from voxtool.adf.hashing import build_hash, cell_of, key_of
from voxtool.adf.plan import MAX_LEVEL_ASKED
from voxtool.adf.query import FieldQuery
from voxtool.adf.survey import cube_of
from voxtool.bench import peers, timing
from voxtool.choices import SEARCHES
from voxtool.files.mesh import load_mesh
from voxtool.opencl import open_device
from voxtool.spatial.sampling import spread_in_cube
from voxtool.spatial.signed_distance import SignedDistance

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device

FEW = 1 << 17  # points that the exact distance and peers are asked at: they take much longer
DIRECTION = np.array([2.0, 3.0, 6.0]) / 7  # of rays, a unit vector along no plane of the lattice
SPHERE_LEVEL, SPHERE_RADIUS = 10, 0.195  # a sphere that a million cells of levels 0 to 10 pass

Distance = Callable[[np.ndarray], np.ndarray]


@dataclass
class Hash:
    """The perfect hash of a set of keys.

    seconds : from keys in memory to the table, the median; spread : (max - min) / median; m, r :
    sides of the tables of slots and of offsets; w : whether it is stored; load : share of the slots
    that is taken; bits_a_key : of the offsets.
    """

    keys: int
    seconds: float
    spread: float
    m: int
    r: int
    w: bool
    load: float
    bits_a_key: float


@dataclass
class Query:
    """A field asked for distances at points, in one search.

    points : "random" or "rays"; count : how many; ns : nanoseconds a point from array to array, the
    median; device_ns : on the device, by its events; spread : (max - min) / median; break_even :
    the points from which on the field, its build and its way to the device included, takes less
    time than the exact distance with its build; None where it is not faster at a point.
    """

    points: str
    search: str
    count: int
    ns: float
    device_ns: float
    spread: float
    break_even: int | None = None


@dataclass
class Exact:
    """What computes distances without a field: voxtool's own, or a peer.

    build : seconds, the median; count : points that were asked at, of each kind; ns : nanoseconds a
    point, the median, by kind; error : by kind, as errors_at; none for voxtool's own, which it is
    measured against.
    """

    name: str
    build: float
    count: dict[str, int]
    ns: dict[str, float]
    error: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass
class Row:
    """One model at one tolerance; times are medians, in seconds, unless they are said to be in ns.

    build : mesh in memory to field in memory, Python included, the measurement of its errors left
    out; spread : (max - min) / median of `build`; stages : on the device, by its events; device :
    their sum; host : what Python adds, in the same runs; bytes : of the textures; error : p99, rms,
    max in sides of the cube and the share within the tolerance, as adf.accuracy.measure_errors;
    missed : leaves over the tolerance; upload : the field's way to the device; hash : of the
    field's keys, alone; exact, peers : of the model, the same in each of its rows.
    """

    model: str
    triangles: int
    sign: str
    tolerance: float
    build: float
    spread: float
    stages: dict[str, float]
    device: float
    host: float
    depth: int
    blocks: int
    leaves: int
    bytes: int
    lipschitz: float
    error: dict[str, Any]
    missed: int
    upload: float
    hash: Hash
    queries: list[Query]
    exact: Exact
    peers: list[Exact] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def sweep(
    models: list[str],
    tolerances: list[float],
    *,
    max_level: int = MAX_LEVEL_ASKED,
    band: float = math.inf,
    sign: str | None = None,
    points: int = 1_000_000,
    repeat: int = 5,
    device: str | None = None,
    with_peers: bool = False,
) -> Iterator[Row]:
    """Measure every model at every tolerance, `repeat` times after a warm-up.

    Parameters
    ----------
    max_level, band, sign : as build_adf.
    points : that queries are measured at; those along rays are as many, up to a whole ray, and half
        an edge of a cell of max_level apart.

    Raises
    ------
    VoxtoolError : a model cannot be read, or as build_adf.
    """
    timed = open_device(device)
    profiled = open_device(device, profile=True)
    for model in models:
        mesh = load_mesh(model)
        many, few = points_of(mesh, points, max_level)
        make = partial(_fresh_distance, mesh, sign, timed)
        exact, distances = measure_exact("exact", make, few, repeat)
        others = []
        if with_peers:
            side = cube_of(mesh)[1]
            others = [
                measure_peer(peer, few, distances, side, repeat) for peer in peers.of_distance(mesh)
            ]
        for tolerance in tolerances:
            build = partial(
                build_adf, mesh, tolerance=tolerance, max_level=max_level, band=band, sign=sign,
                measure=False,
            )  # fmt: skip
            built = build(timed)
            times = timing.times(partial(build, timed), repeat)
            stages, whole = timing.stage_times(partial(build, profiled), profiled, repeat)
            seconds, on_device = statistics.median(times), sum(stages.values())
            upload = statistics.median(timing.times(partial(FieldQuery, built, timed), repeat))
            asked = FieldQuery(built, timed), FieldQuery(built, profiled)
            queries = [
                measure_query(*asked, kind, at, search, repeat)
                for kind, at in many.items()
                for search in SEARCHES
            ]
            for query in queries:
                query.break_even = break_even(seconds + upload, query, exact)
            yield Row(
                model=Path(model).name,
                triangles=len(mesh.faces),
                sign=built.sign,
                tolerance=tolerance,
                build=seconds,
                spread=_spread(times),
                stages=stages,
                device=on_device,
                host=whole - on_device,
                depth=built.depth,
                blocks=len(built.voxels),
                leaves=built.reached["leaves"],
                bytes=sum(built.sizes().values()),
                lipschitz=built.lipschitz,
                error=measure_errors(built, mesh, timed),
                missed=built.reached["missed"],
                upload=upload,
                hash=measure_hash(key_of(*cell_of(built.blocks)), timed, repeat),
                queries=queries,
                exact=exact,
                peers=others,
            )


# --- build and hash ------------------------------------------------------------------------------


def measure_hash(keys: np.ndarray, device: Device, repeat: int) -> Hash:
    """Build the perfect hash of (n, 3) keys, `repeat` times after a warm-up."""
    table = build_hash(keys, device)
    times = timing.times(partial(build_hash, keys, device), repeat)
    n = len(keys)
    return Hash(
        n, statistics.median(times), _spread(times), table.m, table.r, table.has_w,
        table.load(n), table.bits_a_key(n),
    )  # fmt: skip


def sphere_keys() -> np.ndarray:
    """(n, 3) int64: the keys of the cells of levels 0 to SPHERE_LEVEL that a sphere passes."""
    octants = np.indices((2, 2, 2)).reshape(3, 8).T
    centre = np.array([0.5, 0.48, 0.51])  # symmetric to no cell
    cells, keys = np.zeros((1, 3), np.int64), []
    for level in range(SPHERE_LEVEL + 1):
        low = cells * 0.5**level - centre
        high = low + 0.5**level
        nearest, farthest = np.maximum(np.maximum(low, -high), 0), np.maximum(-low, high)
        passed = (nearest * nearest).sum(axis=1) <= SPHERE_RADIUS**2
        passed &= (farthest * farthest).sum(axis=1) >= SPHERE_RADIUS**2
        cells = cells[passed]
        keys.append(key_of(level, cells))
        cells = (2 * cells[:, None] + octants).reshape(-1, 3)
    return np.concatenate(keys)


# --- points --------------------------------------------------------------------------------------


def points_of(
    mesh: Mesh, count: int, max_level: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """By kind, (n, 3) float64 world points in the cube of a mesh: about `count` of them, and about
    FEW of those, or all if they are fewer.

    "random" are spread evenly, in an order without sense; "rays" are in their order along rays.
    """
    origin, side = cube_of(mesh)
    spread, rays = spread_in_cube(count), rays_through_cube(count, 0.5 ** (max_level + 1))
    chosen = max(1, min(len(rays), FEW // rays.shape[1]))
    some = rays[np.arange(chosen) * len(rays) // chosen]

    def world(points: np.ndarray) -> np.ndarray:
        return origin + side * points.reshape(-1, 3)

    return (
        {"random": world(spread), "rays": world(rays)},
        {"random": world(spread[:FEW]), "rays": world(some)},
    )


def rays_through_cube(count: int, step: float) -> np.ndarray:
    """(rays, n, 3) float64: points of the unit cube, `step` apart along parallel rays, at least
    `count` in all; row by row, as the pixels of a picture.

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


# --- queries -------------------------------------------------------------------------------------


def measure_query(
    ask: FieldQuery, profiled: FieldQuery, kind: str, points: np.ndarray, search: str, repeat: int
) -> Query:
    """Ask a field at points, `repeat` times after a warm-up, and again by the device's events."""
    n = len(points)
    ask(points, search=search)
    times = timing.times(partial(ask, points, search=search), repeat)
    profiled.device.stage_times()
    stages, _ = timing.stage_times(
        partial(profiled, points, search=search), profiled.device, repeat
    )
    whole, on_device = statistics.median(times), sum(stages.values())
    return Query(kind, search, n, 1e9 * whole / n, 1e9 * on_device / n, _spread(times))


def measure_exact(
    name: str, make: Callable[[], Distance], few: dict[str, np.ndarray], repeat: int
) -> tuple[Exact, dict[str, np.ndarray]]:
    """Build what computes distances, ask it at each kind of points, `repeat` times after a warm-up;
    and what it answered."""
    distance = make()
    build = statistics.median(timing.times(make, repeat))
    answers = {kind: distance(points) for kind, points in few.items()}
    seconds = {
        kind: statistics.median(timing.times(partial(distance, points), repeat))
        for kind, points in few.items()
    }
    count = {kind: len(points) for kind, points in few.items()}
    ns = {kind: 1e9 * seconds[kind] / count[kind] for kind in few}
    return Exact(name, build, count, ns), answers


def measure_peer(
    peer: peers.DistancePeer,
    few: dict[str, np.ndarray],
    distances: dict[str, np.ndarray],
    side: float,
    repeat: int,
) -> Exact:
    """Likewise, at most 3 times; and how far its answers are from the exact distances."""
    measured, answers = measure_exact(peer.name, peer.build, few, min(repeat, 3))
    if peer.builds_each_time:
        for kind, ns in measured.ns.items():
            measured.ns[kind] = max(0.0, ns - 1e9 * measured.build / measured.count[kind])
    measured.error = {kind: errors_at(answers[kind], distances[kind], side) for kind in few}
    return measured


def errors_at(found: np.ndarray, exact: np.ndarray, side: float) -> dict[str, Any]:
    """How far distances are from the exact ones, world units both.

    Returns
    -------
    JSON types: "points"; "max", "rms" and "p99", the 99th percentile, in sides; "max_unsigned", the
    largest if signs are left out; and "other_sign", the points at which signs differ.
    """
    errors = np.abs(found - exact) / side
    unsigned = np.abs(np.abs(found) - np.abs(exact)) / side
    return {
        "points": len(errors),
        "max": float(errors.max()),
        # math.fsum rounds once, whatever the order
        "rms": math.sqrt(math.fsum(errors * errors) / len(errors)),
        "p99": float(np.quantile(errors, 0.99, method="inverted_cdf")),
        "max_unsigned": float(unsigned.max()),
        "other_sign": int(np.count_nonzero((found < 0) != (exact < 0))),
    }


def break_even(seconds: float, query: Query, exact: Exact) -> int | None:
    """The points from which on a field that was ready after `seconds` takes less time than the
    exact distance; None if it is not faster at a point."""
    saved = exact.ns[query.points] - query.ns
    if saved <= 0:
        return None
    return max(0, math.ceil(1e9 * (seconds - exact.build) / saved))


def _spread(times: list[float]) -> float:
    return (max(times) - min(times)) / statistics.median(times)


def _fresh_distance(mesh: Mesh, sign: str | None, device: Device) -> SignedDistance:
    """The distance to a copy of a mesh, for which nothing is on the device yet."""
    return SignedDistance(replace(mesh), sign, device)
