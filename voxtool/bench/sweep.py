"""Sweeps over settings, each with its time and its error: what reports are made of.

Every time is of work whose kernels are compiled, in the same process, after a warm-up; peers do the
same work in the same run, and their errors are by the same measure.
"""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.build import build_adf, cube_of
from voxtool.adf.query import FieldQuery
from voxtool.bench import adf, forced, peers, tets, timing, voxels
from voxtool.bench import extract as bench_extract
from voxtool.bench import voxelize as bench_voxelize
from voxtool.bench.error import deviation
from voxtool.bench.points import MEASURES, Point, Saving
from voxtool.bench.reference import reference
from voxtool.camera import Camera
from voxtool.diagnosis import diagnose, volume
from voxtool.files import VOLUME_FORMATS, read_unstructured
from voxtool.grid import Grid
from voxtool.mesh import load_mesh
from voxtool.opencl import open_device
from voxtool.proximity.signs import SignedDistance
from voxtool.svo.isosurface import extract
from voxtool.svo.voxelize import MODES, voxelize
from voxtool.tets.mesh import tetrahedra
from voxtool.tets.render import METHODS, VolumeRenderer
from voxtool.tets.textures import build_tet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from voxtool.mesh import Mesh
    from voxtool.opencl import Device

    Measured = Iterator[Point | Saving]


@dataclass(frozen=True)
class Sweep:
    """What is measured, and how often.

    dims, modes, fit, styles, isovalue : of voxels and surfaces, with errors at `samples` points.
    tolerances, levels, band, sign, queries : of fields, and the points that they are asked at.
    sizes, transfers, integrators : of pictures, whose errors are of `pixels` along each side; the
    smaller sizes have the first integrator alone.
    repeat : runs after a warm-up; commands : whether the peak of memory is measured, by running the
    whole command in a process of its own.
    """

    dims: tuple[int, ...] = (64, 128, 256, 512)
    modes: tuple[str, ...] = MODES
    fit: str = "uniform"
    styles: tuple[str, ...] = ("smooth", "nets")
    isovalue: float = 0.5
    samples: int = 20_000
    tolerances: tuple[float, ...] = (1e-2, 3e-3, 1e-3)
    levels: tuple[int, ...] = (5, 7)
    band: float = math.inf
    sign: str | None = None
    queries: int = 1 << 17
    sizes: tuple[int, ...] = (128, 256, 512)
    pixels: int = 64
    view: str = "iso"
    methods: tuple[str, ...] = METHODS
    transfers: tuple[str, ...] = tets.TRANSFERS
    integrators: tuple[str, ...] = tets.INTEGRATORS
    scalar: str | None = None
    component: str | None = None
    repeat: int = 3
    commands: bool = True
    peers: bool = False
    forced: bool = True
    device: str | None = None


QUICK = Sweep(
    dims=(16, 32), styles=("smooth",), samples=1000, tolerances=(1e-1, 1e-2), levels=(3,),
    queries=1 << 10, sizes=(16, 32), pixels=8, transfers=("x10",), repeat=2, commands=False,
    integrators=("linear", "average"),
)  # fmt: skip


PEERS = {"vtk": "vtk", "open3d": "open3d", "igl": "libigl", "skimage": "scikit-image"}


def bench_of(model: str) -> tuple[str, ...]:
    """The benches for a file, by its name."""
    return ("tets",) if is_volume(model) else ("voxelize", "extract", "adf")


def is_volume(model: str) -> bool:
    name = model.lower().removesuffix(".gz")
    return name.endswith(tuple(VOLUME_FORMATS))


def missing_peers() -> list[str]:
    """What pip calls the peers that are not installed."""
    return [package for module, package in PEERS.items() if not peers._module(module)]


def sweep(
    models: Sequence[str],
    asked: Sweep,
    benches: tuple[str, ...] | None = None,
    on_step: Callable[[str], None] = lambda step: None,
) -> Measured:
    """Measure every model, in the benches for its kind or in those that are named; `on_step` is
    told which one begins.

    Raises
    ------
    VoxtoolError : a model cannot be read, or something of it cannot be computed.
    """
    timed = open_device(asked.device)
    profiled = open_device(asked.device, profile=True)
    work = {
        "voxelize": of_voxelize,
        "extract": of_extract,
        "adf": of_fields,
        "tets": of_pictures,
    }
    for model in models:  # a wrong one is refused before anything is measured
        if is_volume(model):
            read_unstructured(model, asked.scalar, asked.component)
        else:
            load_mesh(model)
    for model in models:
        for bench in benches or bench_of(model):
            on_step(f"{bench}, {model}")
            yield from work[bench](model, asked, timed, profiled)


# --- voxels and surfaces -------------------------------------------------------------------------


def of_voxelize(model: str, asked: Sweep, timed: Device, profiled: Device) -> Measured:
    """Sets of voxels; the error is of their boundary."""
    mesh = load_mesh(model)
    surface = Reference(mesh, asked.samples, timed)
    name = Path(model).name
    for dim in asked.dims:
        grid = Grid.fit(mesh, dim, fit=asked.fit)
        for mode in asked.modes:
            work = partial(voxelize, mesh, grid, mode)
            octree = work(device=timed)
            # the faces of voxels are no area, and a shell around a surface has no volume like it
            without = {"area": "faces of voxels do not tend to the area"}
            if mode != "solid":
                without["volume"] = "a set of voxels that a surface touches is no solid"
            request = {"dims": dim, "modes": mode, "fit": asked.fit, "samples": asked.samples}
            method = f"{mode}, {octree.fill}" if mode == "solid" else mode
            point = Point(
                "voxelize", name, work_of(mode), method, f"dim {dim}",
                setting={"dim": dim, "mode": mode, "fill": octree.fill, "fit": asked.fit,
                         "samples": asked.samples},
                runs=timing.times(partial(work, device=timed), asked.repeat),
                command=command("voxelize", model, asked, **request),
                size=dim, size_of="dim",
                **surface.errors_of(extract(octree, style="blocks", device=timed).mesh(), without),
                stages=timing.stage_times(partial(work, device=profiled), profiled, 1)[0],
                left_out=octree.plan["left_out"],
                bytes=octree.nbytes,
            )  # fmt: skip
            if asked.commands:
                _, peak = bench_voxelize.whole_command(
                    model, dim, mode, asked.fit, timed.info.index
                )
                point = replace(point, peak=peak)
            yield point
            if asked.peers:
                for peer, run in peers.of(mesh, grid, mode).items():
                    errors = surface.errors_of(voxels.of_peer(run(), grid), without)
                    yield _peer(point, f"{peer}, {mode}", timing.times(run, asked.repeat), errors)
        if asked.forced and dim == max(asked.dims):
            for mode in asked.modes:
                about = {"bench": "voxelize", "model": name, "work": f"{mode}, dim {dim}"}
                yield from forced.of_voxelize(mesh, grid, mode, timed, asked.repeat, about)


def of_extract(model: str, asked: Sweep, timed: Device, profiled: Device) -> Measured:
    """Surfaces of solid octrees."""
    mesh = load_mesh(model)
    surface = Reference(mesh, asked.samples, timed)
    for dim in asked.dims:
        octree = voxelize(mesh, Grid.fit(mesh, dim), "solid", device=timed)
        for style in asked.styles:
            work = partial(extract, octree, style=style, isovalue=asked.isovalue)
            made = work(device=timed)
            request = {"dims": dim, "styles": style, "isovalue": asked.isovalue,
                       "samples": asked.samples}  # fmt: skip
            point = Point(
                "extract", Path(model).name, "solid voxels to surface", style, f"dim {dim}",
                setting={"dim": dim, "style": style, "isovalue": asked.isovalue,
                         "samples": asked.samples},
                runs=timing.times(partial(work, device=timed), asked.repeat),
                command=command("extract", model, asked, **request),
                size=dim, size_of="dim",
                **surface.errors_of(made.mesh(), {}),
                stages=timing.stage_times(partial(work, device=profiled), profiled, 1)[0],
                bytes=made.points.nbytes + made.faces.nbytes,
            )  # fmt: skip
            if asked.commands:
                _, peak = bench_extract.whole_command(
                    octree, style, asked.isovalue, timed.info.index
                )
                point = replace(point, peak=peak)
            yield point
            if asked.peers and style == "smooth":
                for peer, run in peers.of_octree(octree, asked.isovalue).items():
                    errors = surface.errors_of(voxels.of_peer_surface(run(), octree), {})
                    yield _peer(point, peer, timing.times(run, asked.repeat), errors)


def work_of(mode: str) -> str:
    """What is timed: a solid is other work than a surface."""
    return "mesh to solid voxels" if mode == "solid" else "mesh to voxels of the surface"


class Reference:
    """A mesh that surfaces are held against."""

    def __init__(self, mesh: Mesh, samples: int, device: Device) -> None:
        self.mesh, self.samples, self.device = mesh, samples, device
        (low, high), found = mesh.bounds, diagnose(mesh)
        self.diagonal = math.sqrt(float(((high - low) ** 2).sum()))
        self.volume, self.area = abs(volume(mesh)), area(mesh)
        reason = f"the model is open: {found.boundary_edges} boundary edges"
        self.absent = {} if found.closed else {"volume": reason, "area": reason}

    def errors_of(self, surface: Mesh, without: dict[str, str]) -> Any:
        """A dict of "errors" and "absent", as of a Point; `without` says why measures are of no
        use."""
        absent = {**self.absent, **without}
        if not len(surface.faces):
            return {"errors": {}, "absent": dict.fromkeys(MEASURES["extract"], "it is empty")}
        found = deviation(surface, self.mesh, self.samples, device=self.device)
        ways = found["surface_to_reference"], found["reference_to_surface"]
        errors = {
            "rms": max(way["rms"] for way in ways) / self.diagonal,
            "hausdorff": found["hausdorff"] / self.diagonal,
            "volume": abs(abs(volume(surface)) / self.volume - 1) if self.volume else math.inf,
            "area": abs(area(surface) / self.area - 1),
        }
        return {
            "errors": {name: value for name, value in errors.items() if name not in absent},
            "absent": absent,
        }


def area(mesh: Mesh) -> float:
    """Of a mesh, in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    (ex, ey, ez), (fx, fy, fz) = (b - a).T, (c - a).T
    x, y, z = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    return math.fsum(np.sqrt(x * x + y * y + z * z).tolist()) / 2


# --- fields --------------------------------------------------------------------------------------


def of_fields(model: str, asked: Sweep, timed: Device, profiled: Device) -> Measured:
    """Distance fields, and what they say at points of the cube, beside exact distances."""
    mesh = load_mesh(model)
    name, side = Path(model).name, cube_of(mesh)[1]
    many, few = adf.points_of(mesh, asked.queries, max(asked.levels))
    points = (few if asked.queries >= adf.FEW else many)["random"][: asked.queries]
    exact = SignedDistance(mesh, timed, asked.sign)
    distances = exact(points)
    work = f"distances at {len(points):,} points"
    for level in asked.levels:
        for tolerance in asked.tolerances:
            build = partial(
                build_adf, mesh, tolerance=tolerance, max_level=level, band=asked.band,
                sign=asked.sign,
            )  # fmt: skip
            field = build(device=timed)
            request = {"tolerances": tolerance, "max-level": level, "points": asked.queries,
                       "band": None if math.isinf(asked.band) else asked.band,
                       "sign": asked.sign}  # fmt: skip
            point = Point(
                "adf", name, "mesh to field", f"levels to {level}", f"tolerance {tolerance:g}",
                setting={"tolerance": tolerance, "max_level": level, "sign": field.sign},
                runs=[adf.seconds_to_field(build, timed) for _ in range(asked.repeat)],
                command=command("adf", model, asked, **request),
                size=field.reached["leaves"], size_of="leaves",
                errors=field_errors(field.reached["errors"]),
                stages=build_stages(build, profiled),
                left_out=field.plan["left_out"],
                bytes=sum(field.sizes().values()),
            )  # fmt: skip
            yield point
            ask = FieldQuery(field, timed)
            answer = ask(points).distance
            profiled_ask = FieldQuery(field, profiled)
            profiled.stage_times()
            yield replace(
                point,
                work=work,
                method=f"field, {point.method}",
                setting={**point.setting, "points": len(points)},
                runs=timing.times(partial(ask, points), asked.repeat),
                stages=timing.stage_times(partial(profiled_ask, points), profiled, 1)[0],
                errors=query_errors(answer, distances, side),
            )
    alone = partial(
        Point, "adf", name, work, label="", setting={"points": len(points)}, size=None
    )  # of what has no field
    again = command("adf", model, replace(asked, peers=True), points=asked.queries)
    yield alone(
        method="exact distances",
        runs=timing.times(partial(exact, points), asked.repeat),
        command=again,
        absent=dict.fromkeys(MEASURES["adf"], "errors are measured against it"),
    )
    if asked.peers:
        for peer in peers.of_distance(mesh):
            distance = peer.build()
            found = distance(points)
            runs = timing.times(partial(distance, points), asked.repeat)
            method = f"{peer.name}, building its trees" if peer.builds_each_time else peer.name
            yield alone(
                method=method, runs=runs, command=again, peer=True,
                errors=query_errors(found, distances, side),
            )  # fmt: skip
    if asked.forced:
        level, tolerance = asked.levels[0], asked.tolerances[-1]
        about = {
            "bench": "adf", "model": name,
            "work": f"mesh to field, levels to {level}, tolerance {tolerance:g}",
        }  # fmt: skip
        yield from forced.of_field(
            mesh, timed, asked.repeat, about, tolerance=tolerance, max_level=level, band=asked.band,
            sign=asked.sign,
        )  # fmt: skip


def build_stages(build: Callable[..., Any], profiled: Device) -> dict[str, float]:
    """Seconds of the stages of a field's build on the device; its events know of no compilation, so
    without a warm-up."""
    profiled.stage_times()
    adf.seconds_to_field(build, profiled)
    return profiled.stage_times()


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


# --- pictures ------------------------------------------------------------------------------------


def of_pictures(model: str, asked: Sweep, timed: Device, profiled: Device) -> Measured:
    """Pictures of a volume, one chart for each transfer function."""
    mesh = read_unstructured(model, asked.scalar, asked.component)
    cells = tetrahedra(mesh)
    name = Path(model).name
    made = {
        method: build_tet(mesh, "raycast" if mesh.constant else method) for method in asked.methods
    }
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    renderers = {
        method: (VolumeRenderer(volume, timed), VolumeRenderer(volume, profiled))
        for method, volume in made.items()
    }
    for transfer_name in asked.transfers:
        transfer = tets.transfer_of(transfer_name, cells)
        work = f"frames through {transfer_name}"
        largest = max(asked.sizes)
        every = max(largest // asked.pixels, 1)
        middles = np.arange(every // 2, largest, every)  # of squares of pixels
        pixels = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
        rays = Camera.fit(*box, asked.view, fov=None).rays(largest, largest)
        expected = reference(
            cells.vertices, cells.cells, cells.scalars, transfer, rays, pixels,
            constant=cells.constant,
        )  # fmt: skip
        view = tets.View(rays, pixels, expected)
        for size in asked.sizes:
            rays = Camera.fit(*box, asked.view, fov=None).rays(size, size)
            for method, (renderer, other) in renderers.items():
                for integrator in asked.integrators if size == largest else asked.integrators[:1]:
                    draw = partial(
                        VolumeRenderer.render, rays=rays, transfer=transfer, method=method,
                        integrator=integrator,
                    )  # fmt: skip
                    picture = draw(renderer)
                    errors, absent = (
                        {},
                        dict.fromkeys(
                            MEASURES["tets"], f"pictures of {largest} x {largest} are compared"
                        ),
                    )
                    if size == largest:
                        errors = dict(zip(absent, view.errors(view.of(picture)), strict=True))
                        absent = {}
                    draw(other)
                    profiled.stage_times()
                    request = {"size": size, "every": every, "methods": method,
                               "integrators": integrator, "transfers": transfer_name,
                               "view": asked.view}  # fmt: skip
                    yield Point(
                        "tets", name, work, method, f"{integrator}, {size} x {size}",
                        setting={**request, "scalar": mesh.scalar},
                        runs=timing.times(partial(draw, renderer), asked.repeat),
                        command=command(
                            "tets", model, asked, **request, scalar=asked.scalar,
                            component=asked.component,
                        ),
                        size=size * size if integrator == asked.integrators[0] else None,
                        size_of="pixels",
                        errors=errors,
                        absent=absent,
                        stages=timing.stage_times(partial(draw, other), profiled, 1)[0],
                        bytes=sum(made[method].sizes().values()),
                    )  # fmt: skip
        if asked.peers:
            yield from _picture_peers(cells, view, transfer, name, work, largest, asked, model)
        if asked.forced:
            for method, volume_ in made.items():
                about = {"bench": "tets", "model": name, "work": f"{work}, {method}"}
                yield from forced.of_picture(
                    volume_, view.rays, transfer, method, timed, asked.repeat, about
                )


def _picture_peers(
    cells: Any, view: tets.View, transfer: Any, name: str, work: str, size: int, asked: Sweep,
    model: str,
) -> Iterator[Point]:  # fmt: skip
    for peer in peers.of_volume(
        cells.vertices, cells.cells, cells.scalars, transfer, view.rays, constant=cells.constant
    ):
        peer.draw()
        runs = timing.times(peer.draw, min(asked.repeat, 3))
        for what, found in (("shown", view.of(peer.picture())), ("rays", peer.at(view.pixels))):
            rms, most = view.errors(found)
            yield Point(
                "tets", name, work, f"{peer.name}, {what}", f"linear, {size} x {size}",
                setting={"size": size}, runs=runs, errors={"rms": rms, "max": most}, peer=True,
                command=command("tets", model, replace(asked, peers=True), size=size,
                                scalar=asked.scalar, component=asked.component),
            )  # fmt: skip


# --- what rows have in common --------------------------------------------------------------------


def command(bench: str, model: str, asked: Sweep, **request: Any) -> str:
    """The words that measure a row again, for a shell."""
    words = ["voxtool", "bench", bench, model]
    for name, value in {**request, "repeat": asked.repeat, "device": asked.device}.items():
        if value is not None:
            words += [f"--{name}", str(value)]
    return shlex.join([*words, *["--peers"] * asked.peers, "-o", "report"])


def _peer(ours: Point, method: str, runs: list[float], errors: dict[str, Any]) -> Point:
    """A peer's point beside ours."""
    return replace(
        ours, method=method, runs=runs, peer=True, stages={}, left_out={}, bytes=None, peak=None,
        **errors,
    )  # fmt: skip
