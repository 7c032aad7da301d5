"""Pictures of volumes: their error against the time of a frame, one chart a transfer function.

Errors are measured against voxtool.selftest.reference, which draws the same mesh in float64.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench import ablation, timing
from voxtool.bench.points import MEASURES
from voxtool.bench.references import ReferencePicture
from voxtool.camera import Camera
from voxtool.files import read_unstructured
from voxtool.pictures.rendering import plan_render, render
from voxtool.selftest.isosurfaces import isosurfaces
from voxtool.selftest.reference import reference
from voxtool.tets.construction.conforming import tetrahedra
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import volume_cells

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.points import Ablation, Point
    from voxtool.bench.request import Request
    from voxtool.bench.timing import Bench
    from voxtool.tets.volume.mesh import ConformingMesh
    from voxtool.tets.volume.volume import TetVolume

DEPTH = 4.0  # optical, of the box's diagonal at the largest extinction of x1
LEVELS = (0.3, 0.5, 0.7)  # quantiles of the scalars, whose isosurfaces are drawn
SLAB = 0.1  # thickness of each slab of steps, in ranges of the scalar


def measure(bench: Bench) -> Iterator[Point | Ablation]:
    """Yield the points and ablations of a volume."""
    asked = bench.request
    mesh = read_unstructured(bench.model, asked.scalar, asked.component)
    cells = tetrahedra(bench.timed, volume_cells(mesh)).on_host()
    # either method draws either layout, and only "raycast" holds scalars of cells
    volumes = {
        method: build_tet(mesh, "raycast" if mesh.constant else method, device=bench.timed)
        for method in asked.methods
    }
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    camera = Camera.fit(*box, asked.view, fov=None)
    if not cells.constant:
        yield from _isosurfaces(volumes, cells, camera, bench)
    for name in asked.transfers:
        transfer, work = transfer_of(name, cells), f"frames through {name}"
        exact = reference_picture(cells, transfer, camera, asked)
        settings = {"transfers": name, "view": asked.view, "pixels": asked.pixels}
        row = partial(bench.point, work, size_of="pixels")
        for size, method, integrator in product(asked.sizes, volumes, asked.integrators):
            # smaller pictures are for the cost alone
            if size == max(asked.sizes) or integrator == asked.integrators[0]:
                made = {**settings, "sizes": size, "methods": method, "integrators": integrator}
                draw = partial(
                    render, view=camera.rays(size, size), transfer=transfer, method=method,
                    integrator=integrator,
                )  # fmt: skip
                yield _frame(volumes[method], draw, exact, bench, partial(row, asked=made), **made)
        for peer in _peers_of(cells, transfer, exact, bench):
            (first,) = timing.times(peer.draw, 1)
            runs, _ = timing.Peers(asked.repeat).times(peer.name, peer.draw)
            largest = exact.rays.size[0]
            pictures = {"shown": exact.of(peer.picture()), "rays": peer.at(exact.pixels)}
            for what, colours in pictures.items():
                yield row(
                    f"{peer.name}, linear, {what}", f"{largest} x {largest}", runs=runs,
                    first=first, peer=True, asked={**settings, "sizes": largest},
                    **exact.compared(colours),
                )  # fmt: skip
        for method, volume in volumes.items() if asked.ablations else ():
            job = plan_render(
                volume, exact.rays, transfer=transfer, method=method, device=bench.timed
            )
            yield from ablation.of_picture(job, bench, f"{work}, {method}")


def _isosurfaces(
    volumes: dict[str, TetVolume], cells: ConformingMesh, camera: Camera, bench: Bench
) -> Iterator[Point]:
    """Yield the points of frames of isosurfaces, by method, at the largest size."""
    asked, size = bench.request, max(bench.request.sizes)
    exact_rays, pixels = camera.rays(size, size), pixels_of(asked)
    values, tint = np.quantile(cells.scalars, LEVELS).tolist(), (1.0, 0.5, 0.25, 0.5)
    clear = TransferFunction(np.zeros(1), np.zeros((1, 3)), np.zeros(1))
    expected = isosurfaces(
        cells.vertices, cells.cells, cells.scalars, clear, exact_rays, values, tint, pixels
    )
    exact = ReferencePicture(exact_rays, pixels, expected)
    for method, volume in volumes.items():
        draw = partial(
            render, volume, exact_rays, isovalues=values, opacity=tint[3], colour=tint[:3],
            method=method,
        )  # fmt: skip
        yield bench.point(
            "frames of isosurfaces", method, f"{len(values)} surfaces, {size} x {size}",
            run=lambda device, draw=draw: draw(device=device),
            asked={"sizes": size, "methods": method, "view": asked.view, "pixels": asked.pixels},
            bytes=sum(volume.sizes().values()),
            **exact.compared(exact.of(draw(device=bench.timed))),
        )  # fmt: skip


def _frame(
    volume: TetVolume,
    draw: partial[np.ndarray],
    exact: ReferencePicture,
    bench: Bench,
    row: partial[Point],
    *,
    sizes: int,
    methods: str,
    integrators: str,
    **_: object,
) -> Point:
    """Return the point of frames after the first."""
    draw(volume, device=bench.timed)  # compile the kernels
    volume = replace(volume)  # a copy that no device has yet
    (first,) = timing.times(lambda: draw(volume, device=bench.timed), 1)
    kind, _colon, samples = integrators.partition(":")
    found: dict[str, Any] = {}
    if exact.rays.size == (sizes, sizes):
        found = exact.compared(exact.of(draw(volume, device=bench.timed)))
    else:
        width, height = exact.rays.size
        reason = f"pictures of {width} x {height} are compared"
        found["absent"] = dict.fromkeys(MEASURES["tets"], reason)
    return row(
        f"{methods}, {kind}", (f"{samples} a cell, " if samples else "") + f"{sizes} x {sizes}",
        run=lambda device: draw(volume, device=device), first=first,
        size=sizes * sizes if integrators == bench.request.integrators[0] else None,
        bytes=sum(volume.sizes().values()), **found,
    )  # fmt: skip


def _peers_of(
    cells: ConformingMesh, transfer: TransferFunction, exact: ReferencePicture, bench: Bench
) -> list[Any]:
    """Return the PicturePeers, if other tools are asked for."""
    if not bench.request.peers:
        return []
    return bench.tools.of_volume(
        cells.vertices, cells.cells, cells.scalars, transfer, exact.rays, constant=cells.constant
    )


def reference_picture(
    cells: ConformingMesh, transfer: TransferFunction, camera: Camera, asked: Request
) -> ReferencePicture:
    """Return the exact colours of `pixels` x `pixels` pixels of the largest picture."""
    pixels, rays = pixels_of(asked), camera.rays(*[max(asked.sizes)] * 2)
    expected = reference(
        cells.vertices, cells.cells, cells.scalars, transfer, rays, pixels, constant=cells.constant
    )
    return ReferencePicture(rays, pixels, expected)


def pixels_of(asked: Request) -> np.ndarray:
    """Return column and row of `pixels` x `pixels` pixels of the largest picture, (N, 2)."""
    largest = max(asked.sizes)
    every = max(largest // asked.pixels, 1)
    middles = np.arange(every // 2, largest, every)  # of squares of pixels
    return np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)


def transfer_of(name: str, mesh: ConformingMesh) -> TransferFunction:
    """Return a transfer function over the range of a mesh's scalars, by its name.

    x1 goes through five colours, from transparent at the least scalar; x10 and x100 are 10 and 100
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
