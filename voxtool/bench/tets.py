"""Pictures of volumes: their error against the time of a frame, one chart a transfer function.

Errors are those of voxtool.selftest.reference, which draws the same mesh in float64.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation, timing
from voxtool.bench.points import MEASURES, Point
from voxtool.bench.references import ReferencePicture
from voxtool.camera import Camera
from voxtool.files import read_unstructured
from voxtool.rendering import plan_render, render
from voxtool.selftest.reference import reference
from voxtool.tets.conforming import tetrahedra
from voxtool.tets.mesh import volume_cells
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Ablation
    from voxtool.bench.request import Request
    from voxtool.bench.timing import Bench
    from voxtool.tets.mesh import ConformingMesh
    from voxtool.tets.volume import TetVolume

DEPTH = 4.0  # optical, of the box's diagonal at the largest extinction of x1
SLAB = 0.1  # thickness of each slab of steps, in ranges of the scalar


def measure(model: str, bench: Bench) -> Iterator[Point | Ablation]:
    """The points and ablations of a volume."""
    asked = bench.request
    mesh = read_unstructured(model, asked.scalar, asked.component)
    cells = tetrahedra(volume_cells(mesh))
    # either method draws either layout, and only "raycast" holds scalars of cells
    volumes = {
        method: build_tet(mesh, "raycast" if mesh.constant else method) for method in asked.methods
    }
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    camera = Camera.fit(*box, asked.view, fov=None)
    for name in asked.transfers:
        transfer = transfer_of(name, cells)
        exact = reference_picture(cells, transfer, camera, asked)
        about = {"bench": "tets", "model": Path(model).name, "work": f"frames through {name}"}
        row = partial(Point, **about, size_of="pixels")
        settings = {"transfers": name, "view": asked.view, "pixels": asked.pixels}
        for size, method, integrator in product(asked.sizes, volumes, asked.integrators):
            # smaller pictures are for the cost alone
            if size == max(asked.sizes) or integrator == asked.integrators[0]:
                made = {**settings, "sizes": size, "methods": method, "integrators": integrator}
                yield _frame(
                    volumes[method], transfer, camera, exact, bench,
                    partial(row, setting=made, command=asked.command("tets", model, **made)),
                    **made,
                )  # fmt: skip
        if asked.peers:
            yield from _peers(cells, transfer, exact, row, settings, model, bench)
        for method, volume in volumes.items() if asked.ablations else ():
            work = {**about, "work": f"{about['work']}, {method}"}
            job = plan_render(
                volume, exact.rays, transfer=transfer, method=method, device=bench.timed
            )
            yield from ablation.of_picture(job, bench, work)


def reference_picture(
    cells: ConformingMesh, transfer: TransferFunction, camera: Camera, asked: Request
) -> ReferencePicture:
    """The exact colours of `pixels` x `pixels` pixels of the largest picture."""
    largest = max(asked.sizes)
    every = max(largest // asked.pixels, 1)
    middles = np.arange(every // 2, largest, every)  # of squares of pixels
    pixels = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    rays = camera.rays(largest, largest)
    expected = reference(
        cells.vertices, cells.cells, cells.scalars, transfer, rays, pixels, constant=cells.constant
    )
    return ReferencePicture(rays, pixels, expected)


def transfer_of(name: str, mesh: ConformingMesh) -> TransferFunction:
    """A transfer function over the range of a mesh's scalars, by its name.

    x1 goes through five colours, from transparent at the least scalar; x10 and x100 are as many
    times as opaque. steps has two slabs with jumps at their sides, as opaque as x100.
    """
    low, high = float(mesh.scalars.min()), float(mesh.scalars.max())
    diagonal = float(np.sqrt((np.ptp(mesh.vertices, axis=0) ** 2).sum()))
    most = DEPTH / diagonal
    colours = np.array([(0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 0, 0.0)])
    if name == "steps":
        sides = np.array([0.25, 0.25 + SLAB, 0.6, 0.6 + SLAB]).repeat(2)
        inside = np.array([0, 1, 1, 0, 0, 1, 1, 0.0])
        return TransferFunction(
            low + sides * (high - low), colours[[1, 1, 1, 1, 4, 4, 4, 4]], 100 * most * inside
        )
    points = np.linspace(low, high, 5)
    return TransferFunction(points, colours, int(name[1:]) * most * np.arange(5) / 4)


def _frame(
    volume: TetVolume,
    transfer: TransferFunction,
    camera: Camera,
    exact: ReferencePicture,
    bench: Bench,
    row: partial[Point],
    *,
    sizes: int,
    methods: str,
    integrators: str,
    **_: object,
) -> Point:
    """The point of frames after the first."""
    draw = partial(
        render, view=camera.rays(sizes, sizes), transfer=transfer, method=methods,
        integrator=integrators,
    )  # fmt: skip
    draw(volume, device=bench.timed)  # kernels are compiled
    volume = replace(volume)  # which no device has yet
    start = time.perf_counter()
    picture = draw(volume, device=bench.timed)
    first = time.perf_counter() - start
    kind, _colon, samples = integrators.partition(":")
    label = (f"{samples} a cell, " if samples else "") + f"{sizes} x {sizes}"
    found: dict[str, Any] = {}
    if exact.rays.size == (sizes, sizes):
        found = _compared(exact, exact.of(picture))
    else:
        width, height = exact.rays.size
        reason = f"pictures of {width} x {height} are compared"
        found["absent"] = dict.fromkeys(MEASURES["tets"], reason)
    measured = bench.measured(lambda device: draw(volume, device=device))
    measured["figures"] |= found.pop("figures", {})
    return row(
        method=f"{methods}, {kind}", label=label, first=first,
        size=sizes * sizes if integrators == bench.request.integrators[0] else None,
        bytes=sum(volume.sizes().values()), **found, **measured,
    )  # fmt: skip


def _compared(exact: ReferencePicture, colours: np.ndarray) -> dict[str, Any]:
    """The `errors` and `figures` of a Point."""
    seen = exact.expected[:, 3]
    figures = {"pixels compared": int(np.count_nonzero(seen)), "largest alpha": float(seen.max())}
    return {"errors": exact.errors(colours), "figures": figures}


def _peers(
    cells: ConformingMesh,
    transfer: TransferFunction,
    exact: ReferencePicture,
    row: partial[Point],
    settings: dict[str, Any],
    model: str,
    bench: Bench,
) -> Iterator[Point]:
    """Two points for each other tool: its picture as it is shown, and what its rays find."""
    asked, largest = bench.request, exact.rays.size[0]
    made = {**settings, "sizes": largest}
    for peer in bench.tools.of_volume(
        cells.vertices, cells.cells, cells.scalars, transfer, exact.rays, constant=cells.constant
    ):
        (first,) = timing.times(peer.draw, 1)
        runs, _ = timing.Peers(asked.repeat).times(peer.name, peer.draw)
        shown, rays = exact.of(peer.picture()), peer.at(exact.pixels)
        for what, colours in (("shown", shown), ("rays", rays)):
            yield row(
                method=f"{peer.name}, linear, {what}", label=f"{largest} x {largest}",
                setting=made, runs=runs, first=first, peer=True,
                command=asked.command("tets", model, **made), **_compared(exact, colours),
            )  # fmt: skip
