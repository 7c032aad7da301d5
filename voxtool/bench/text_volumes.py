"""Rows of the textures and the integration of [TetVol], with figures of voxtool beside."""

from __future__ import annotations

import statistics
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from voxtool.bench import timing
from voxtool.bench.tets import reference_picture, transfer_of
from voxtool.bench.text_rows import MISPRINT, Row
from voxtool.camera import Camera
from voxtool.files import read_unstructured
from voxtool.rendering import plan_render, render
from voxtool.tets.conforming import tetrahedra
from voxtool.tets.integrate import BUCKETS, Integral
from voxtool.tets.mesh import UnstructuredMesh, volume_cells
from voxtool.tets.scene import VolumeScene
from voxtool.tets.textures import build_tet
from voxtool.tets.transfer import TransferFunction
from voxtool.tets.view import DeviceVolume

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.timing import Bench
    from voxtool.tets.volume import TetVolume

TRANSFER = "x10"
SECTION = "[TetVol] section 4.2"
SIDE = 16  # hexahedra along each side of a box
TABLES = {  # by layout: its table, the bytes a tetrahedron, what they are, and what it replaces
    "projection": ("[TetVol] table 4", 71, "with a fifth as many vertices as tetrahedra",
                   {"vertex attributes beside": 48, "total": 119, "vertex attributes alone": 912}),
    "raycast": ("[TetVol] table 5", 96, "24 floats",
                {"[Weiler 2003]": 144, "strips of tetrahedra": 76}),
}  # fmt: skip
POINTS = 5, 64, 250  # control points
INTEGRATORS = {"linear": "exact segments", "preintegrated": "pre-integration"}


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """The rows of a volume."""
    size, pixels = (64, 16) if quick else (256, 32)
    asked = replace(bench.request, sizes=(size,), pixels=pixels)
    bench = replace(bench, request=asked)
    mesh = read_unstructured(bench.model, asked.scalar, asked.component)
    cells = tetrahedra(bench.timed, volume_cells(mesh)).on_host()
    model = f"{Path(bench.model).name} ({len(cells.cells):,} tetrahedra)"
    volume = build_tet(mesh, device=bench.timed)
    for layout, (table, text, said, others) in TABLES.items():
        row = partial(Row, table, model, unit="bytes a cell")
        if layout == "raycast" or not mesh.constant:
            made = volume if layout == "raycast" else build_tet(mesh, layout, device=bench.timed)
            share = f"{len(made.vertices) / len(made.cells):.3f} vertices a cell"
            yield row(what="textures of the table", setting=layout, text=text, statement=said,
                      voxtool=made.bytes_a_cell(), ours=share)  # fmt: skip
        for what, size in others.items():
            yield row(what=what, setting=layout, text=size, statement="beside it or replaced",
                      voxtool=None, ours="not built")  # fmt: skip
    yield from _hexahedra(bench)
    transfer = transfer_of(TRANSFER, cells)
    yield from _changes(volume, transfer, model, bench)
    yield from _control_points(volume, transfer, model, bench)
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    exact = reference_picture(cells, transfer, Camera.fit(*box, asked.view, fov=None), asked)
    for integrator, about in INTEGRATORS.items():
        draw = partial(render, volume, exact.rays, transfer=transfer, integrator=integrator)
        colours = exact.of(draw(device=bench.timed))
        seconds = statistics.median(timing.times(partial(draw, device=bench.timed), asked.repeat))
        whole = f"{about}, a call, Python included"
        whole += ", and the table" if integrator == "preintegrated" else ""
        size = "{} x {}".format(*exact.rays.size)
        row = partial(Row, SECTION, model, setting=f"{integrator}, {size}", text=None)
        yield row(what="root mean square error", unit="of a colour",
                  statement="exact segments look better than pre-integration; no figure",
                  voxtool=exact.compared(colours)["errors"]["rms"],
                  ours=f"{about}, against float64")  # fmt: skip
        yield row(what="frame", unit="ms", statement="no figure", voxtool=1000 * seconds,
                  ours=whole)  # fmt: skip
    yield Row(
        SECTION, model, "compositing", "front to back", "", None,
        "R' = A R + (1 - A) r; A' = A + (1 - A) a", None, "R' = R + (1 - A) r", MISPRINT,
    )  # fmt: skip


def _hexahedra(bench: Bench) -> Iterator[Row]:
    """Rows of hexahedra that stay whole, and of the tetrahedra that they are split into."""
    points = np.indices((SIDE + 1,) * 3).reshape(3, -1).T.astype(np.float64)
    low = np.indices((SIDE,) * 3).reshape(3, -1).T
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0),
                        (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])  # fmt: skip
    places = (low[:, None] + corners) @ np.array([(SIDE + 1) ** 2, SIDE + 1, 1])
    scalars = low.sum(axis=1).astype(np.float64)
    mesh = UnstructuredMesh(points, [("hexahedron", places)], [scalars], "sum")
    for layout in ("hexahedra", "raycast"):
        volume = build_tet(mesh, layout, device=bench.timed)
        ours = volume.bytes_a_cell() * len(volume.cells) / len(low)
        yield Row(
            TABLES["raycast"][0], f"{SIDE}^3 hexahedra", "bytes of hexahedra", layout,
            "bytes a hexahedron", None, "two more textures of normals draw them whole; no figure",
            ours, f"{len(volume.cells):,} {volume.noun}",
        )  # fmt: skip


def _control_points(
    volume: TetVolume, transfer: TransferFunction, model: str, bench: Bench
) -> Iterator[Row]:
    """Rows of the search for the control points that a segment crosses: all are compared, or a
    table of scalars says where to begin."""
    low, high = transfer.scalars[[0, -1]]
    for number in POINTS:
        scalars = np.linspace(low, high, number)
        dense = TransferFunction(scalars, *transfer.evaluate(scalars))
        size = bench.request.sizes[0]
        job = plan_render(volume, bench.request.view, size=(size, size), transfer=dense,
                          device=bench.timed)  # fmt: skip
        ways = {"all are compared": job.with_(buckets=0), "a table": job.with_(buckets=BUCKETS)}
        first, second = (way.run() for way in ways.values())
        same = "the same picture" if np.array_equal(first, second) else "another picture"
        spent = timing.by_turns(bench.request, *(way.run for way in ways.values()))
        for (what, _), times in zip(ways.items(), spent, strict=True):
            held = 4 * BUCKETS if what == "a table" else 0
            yield Row("[TetVol] figure 28", model, f"isosurfaces of control points: {what}",
                      f"{number} points, {size} x {size}", "ms", None,
                      "a texture of the next two for each pair of scalars; no size, no time",
                      1000 * statistics.median(times), f"{held} bytes more: {same}")  # fmt: skip


def _changes(
    volume: TetVolume, transfer: TransferFunction, model: str, bench: Bench
) -> Iterator[Row]:
    """Rows of a change of the transfer function."""
    on_device = DeviceVolume.of(volume, bench.timed)
    low, width = transfer.scalars[0], float(np.ptp(transfer.scalars))
    moves = count(1)

    def change(integrator: str) -> None:
        # cells below the first point are transparent: other cells are drawn each time
        moved = low + width * 0.01 * next(moves)
        scalars = moved + (transfer.scalars - low) * (1 - (moved - low) / width)
        scene = VolumeScene(volume, replace(transfer, scalars=scalars), integrator=integrator)
        on_device.shown(volume, scene.blocks)
        Integral(volume, scene.local, on_device, integrator)
        bench.timed.queue.finish()

    for integrator, about in INTEGRATORS.items():
        work = partial(change, integrator)
        work()
        spent = 1000 * statistics.median(timing.times(work, bench.request.repeat))
        words = "control points, cells that are not transparent"
        words += ", and the pre-integrated table" if integrator == "preintegrated" else ""
        yield Row(SECTION, model, "change of the transfer function", about, "ms", None,
                  "interactive; no figure", spent, words)  # fmt: skip
