"""Pictures of volumes: error against run time."""

from __future__ import annotations

import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation as forced
from voxtool.bench import peers, tets, timing
from voxtool.bench.points import MEASURES, Point
from voxtool.bench.sweep.request import command
from voxtool.camera import Camera
from voxtool.files import read_unstructured
from voxtool.selftest.reference import reference
from voxtool.tets.mesh import tetrahedra
from voxtool.tets.render import VolumeRenderer
from voxtool.tets.textures import build_tet

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Saving
    from voxtool.bench.sweep.request import Sweep
    from voxtool.opencl import Device


def of_pictures(
    model: str, asked: Sweep, timed: Device, profiled: Device
) -> Iterator[Point | Saving]:
    """Pictures of a volume, one chart for each transfer function; errors are of the largest."""
    mesh = read_unstructured(model, asked.scalar, asked.component)
    cells, largest = tetrahedra(mesh), max(asked.sizes)
    volumes = {
        method: build_tet(mesh, "raycast" if mesh.constant else method) for method in asked.methods
    }
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    every = max(largest // asked.pixels, 1)
    middles = np.arange(every // 2, largest, every)  # of squares of pixels
    pixels = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    camera = Camera.fit(*box, asked.view, fov=None)
    rays = camera.rays(largest, largest)
    for name in asked.transfers:
        transfer = tets.transfer_of(name, cells)
        expected = reference(
            cells.vertices, cells.cells, cells.scalars, transfer, rays, pixels,
            constant=cells.constant,
        )  # fmt: skip
        view = tets.View(rays, pixels, expected)
        row = partial(Point, "tets", Path(model).name, f"frames through {name}")
        request = {"every": every, "transfers": name, "view": asked.view, "scalar": asked.scalar,
                   "component": asked.component}  # fmt: skip
        for size, method, integrator in product(asked.sizes, volumes, asked.integrators):
            volume = volumes[method]
            if size != largest and integrator != asked.integrators[0]:
                continue  # smaller ones are for the cost alone
            made = {**request, "size": size, "methods": method, "integrators": integrator}
            draw = partial(
                VolumeRenderer.render, rays=camera.rays(size, size), transfer=transfer,
                method=method, integrator=integrator,
            )  # fmt: skip
            draw(VolumeRenderer(volume, timed))  # kernels are compiled
            start = time.perf_counter()
            renderer = VolumeRenderer(volume, timed)
            picture = draw(renderer)
            first = time.perf_counter() - start
            kind, _, samples = integrator.partition(":")
            words = f"{samples} a cell, " if samples else ""
            yield row(
                f"{method}, {kind}", f"{words}{size} x {size}", setting=made, first=first,
                runs=asked.runs.times(partial(draw, renderer)),
                command=command("tets", model, asked, **made),
                size=size * size if integrator == asked.integrators[0] else None,
                size_of="pixels",
                **_errors(view, picture if size == largest else None),
                stages=_stages(partial(draw, VolumeRenderer(volume, profiled)), profiled),
                bytes=sum(volume.sizes().values()),
            )  # fmt: skip
        found = peers.of_volume(
            cells.vertices, cells.cells, cells.scalars, transfer, rays, constant=cells.constant
        )
        for peer in found if asked.peers else ():
            (first,) = timing.times(peer.draw, 1)
            runs, _ = timing.Peers(asked.repeat).times(peer.name, peer.draw)
            for what, colours in (
                ("shown", view.of(peer.picture())),
                ("rays", peer.at(view.pixels)),
            ):
                yield row(
                    f"{peer.name}, linear, {what}", f"{largest} x {largest}",
                    setting={**request, "size": largest}, runs=runs, first=first, peer=True,
                    errors=_named(view.errors(colours)),
                    command=command("tets", model, asked, **request, size=largest),
                )  # fmt: skip
        for method, volume in volumes.items() if asked.forced else ():
            about = {"bench": "tets", "model": Path(model).name,
                     "work": f"frames through {name}, {method}"}  # fmt: skip
            yield from forced.of_picture(volume, rays, transfer, method, timed, asked.runs, about)


def _errors(view: tets.View, picture: np.ndarray | None) -> Any:
    """A dict of "errors" and "absent", as of a Point, of a picture from this view or another."""
    if picture is None:
        width, height = view.rays.size
        reason = f"pictures of {width} x {height} are compared"
        return {"errors": {}, "absent": dict.fromkeys(MEASURES["tets"], reason)}
    return {"errors": _named(view.errors(view.of(picture))), "absent": {}}


def _named(errors: tuple[float, float]) -> dict[str, float]:
    return dict(zip(MEASURES["tets"], errors, strict=True))


def _stages(draw: partial[np.ndarray], profiled: Device) -> dict[str, float]:
    """Seconds of the stages of a later frame on the device."""
    draw()
    profiled.stage_times()
    return timing.stage_times(draw, profiled, 1)[0]
