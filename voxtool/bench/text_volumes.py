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
from voxtool.pictures.rendering import plan_render, render
from voxtool.tets.construction.conforming import tetrahedra
from voxtool.tets.construction.textures import build_tet
from voxtool.tets.pictures.integrate import BUCKETS, Integral
from voxtool.tets.pictures.scene import VolumeScene
from voxtool.tets.pictures.transfer import TransferFunction
from voxtool.tets.volume.mesh import UnstructuredMesh, volume_cells

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.bench.timing import Bench
    from voxtool.tets.volume.volume import TetVolume

TRANSFER = "x10"
SECTION, HEXAHEDRA = "[TetVol] section 4.2", "[TetVol] section 4.1"
SIDE, QUICK_SIDE = 32, 16  # hexahedra along each side of a box
TABLES = {  # by layout: its table, the bytes a tetrahedron, what they are, and what it replaces
    "projection": ("[TetVol] table 4", 71, "with a fifth as many vertices as tetrahedra; its sum, "
                   "4/5 + 4 + 3 + 3 + 4 + 3 floats, is 71.2 bytes",
                   {"vertex attributes": (48, "indices of strips, beside the textures"),
                    "in total": (119, "much less than attributes alone"),
                    "attributes alone": (912, "what the textures replace: 12 vertices each")}),
    "raycast": ("[TetVol] table 5", 96, "24 floats",
                {"textures of [Weiler 2003]": (144, "what the table replaces"),
                 "strips of tetrahedra": (76, "of Weiler 2004, smaller and more complex")}),
}  # fmt: skip
POINTS = 5, 64, 250  # control points
PAIRS = "a texture of the next two isosurfaces for each pair of scalars; no size, no time"
BETTER = "exact segments look better than pre-integration; no figure"
INTEGRATORS = {"linear": "exact segments", "preintegrated": "pre-integration"}


def rows_of(bench: Bench, quick: bool) -> Iterator[Row]:
    """Yield the rows of a volume."""
    size, pixels = (64, 16) if quick else (256, 32)
    asked = replace(bench.request, sizes=(size,), pixels=pixels)
    bench = replace(bench, request=asked)
    mesh = read_unstructured(bench.model, asked.scalar, asked.component)
    cells = tetrahedra(bench.timed, volume_cells(mesh)).on_host()
    model = f"{Path(bench.model).name}, {len(cells.cells):,} tetrahedra"
    volume = build_tet(mesh, device=bench.timed)
    for layout, (table, text, said, others) in TABLES.items():
        row = partial(Row, table, model, setting="bytes a cell", unit="")
        if layout == "raycast" or not mesh.constant:
            made = volume if layout == "raycast" else build_tet(mesh, layout, device=bench.timed)
            share = f"{len(made.vertices) / len(made.cells):.3f} vertices a cell"
            yield row("textures of the table", text=text, statement=said,
                      voxtool=made.bytes_a_cell(), ours=share)  # fmt: skip
            yield row("whole file", voxtool=sum(made.sizes().values()) / len(made.cells),
                      ours="with cells' vertices, neighbours and ranges of scalars")  # fmt: skip
        else:
            yield row("textures of the table", text=text, statement=said, voxtool=None,
                      ours="this layout has scalars at points alone")  # fmt: skip
        for what, (printed, words) in others.items():
            yield row(what, voxtool=None, ours="none: kernels read the textures", text=printed,
                      statement=words)  # fmt: skip
    yield from _hexahedra(bench, QUICK_SIDE if quick else SIDE)
    transfer = transfer_of(TRANSFER, cells)
    yield from _changes(volume, transfer, model, bench)
    yield from _control_points(volume, transfer, model, bench)
    box = cells.vertices.min(axis=0), cells.vertices.max(axis=0)
    exact = reference_picture(cells, transfer, Camera.fit(*box, asked.view, fov=None), asked)
    for integrator, about in INTEGRATORS.items():
        draw = partial(render, volume, exact.rays, transfer=transfer, integrator=integrator)
        colours = exact.of(draw(device=bench.timed))
        seconds = statistics.median(timing.times(partial(draw, device=bench.timed), asked.repeat))
        size = "{} x {}".format(*exact.rays.size)
        row = partial(Row, SECTION, model, setting=size, way=about)
        yield row("root mean square error", unit="of a colour", statement=BETTER,
                  voxtool=exact.compared(colours)["errors"]["rms"],
                  ours="against a picture in float64")  # fmt: skip
        table = ", and the table" * (integrator == "preintegrated")
        yield row("frame", unit="ms", voxtool=1000 * seconds,
                  ours=f"a call, Python included{table}")  # fmt: skip
    yield Row(
        SECTION, model, "compositing", "", "", None, "R' = R + (1 - A) r",
        statement="R' = A R + (1 - A) r; A' = A + (1 - A) a", note=MISPRINT,
    )  # fmt: skip


def _hexahedra(bench: Bench, side: int) -> Iterator[Row]:
    """Yield rows of hexahedra that stay whole, and of the tetrahedra that they are split into."""
    points = np.indices((side + 1,) * 3).reshape(3, -1).T.astype(np.float64)
    low = np.indices((side,) * 3).reshape(3, -1).T
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0),
                        (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])  # fmt: skip
    places = (low[:, None] + corners) @ np.array([(side + 1) ** 2, side + 1, 1])
    scalars = low.sum(axis=1).astype(np.float64)
    mesh = UnstructuredMesh(points, [("hexahedron", places)], [scalars], "sum")
    volumes = [build_tet(mesh, layout, device=bench.timed) for layout in ("hexahedra", "raycast")]
    size = bench.request.sizes[0]
    high = scalars.max()
    transfer = TransferFunction(
        np.array([0, high]), np.array([(0, 0.2, 0.5), (1, 0.8, 0)]), np.array([0, 4 / high])
    )
    draws = [
        plan_render(volume, bench.request.view, size=(size, size), transfer=transfer,
                    device=bench.timed).run
        for volume in volumes
    ]  # fmt: skip
    whole, split = (draw().astype(np.float64) for draw in draws)
    spent = timing.by_turns(bench.request, *draws)
    row = partial(Row, HEXAHEDRA, f"{side}^3 hexahedra in a box, with a scalar a cell", setting="",
                  statement="drawn whole with two more textures of normals; no figure")  # fmt: skip
    for way, volume, times in zip(("whole", "split"), volumes, spent, strict=True):
        row = partial(row, way=way, ours=f"{len(volume.cells):,} {volume.noun}")
        ours = volume.bytes_a_cell() * len(volume.cells) / len(low)
        yield row("textures", unit="bytes a hexahedron", voxtool=ours)
        yield row(f"frame, {size} x {size}", unit="ms", voxtool=1000 * statistics.median(times))
    yield row("pictures", unit="of a colour", voxtool=float(abs(whole - split).max()), way="",
              ours="largest difference of a pixel")  # fmt: skip


def _control_points(
    volume: TetVolume, transfer: TransferFunction, model: str, bench: Bench
) -> Iterator[Row]:
    """Yield rows of the search for the control points that a segment crosses: all are compared, or
    a table of scalars says where to begin."""
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
            row = partial(Row, "[TetVol] figure 28", model, setting=f"{number} points", way=what,
                          statement=PAIRS)  # fmt: skip
            yield row(f"frame, {size} x {size}", unit="ms", voxtool=1000 * statistics.median(times),
                      ours=same)  # fmt: skip
            yield row("table", unit="bytes", voxtool=held, ours="")


def _changes(
    volume: TetVolume, transfer: TransferFunction, model: str, bench: Bench
) -> Iterator[Row]:
    """Yield rows of a change of the transfer function."""
    low, width = transfer.scalars[0], float(np.ptp(transfer.scalars))
    moves = count(1)

    def change(integrator: str) -> None:
        # cells below the first point are transparent: other cells are drawn each time
        moved = low + width * 0.01 * next(moves)
        scalars = moved + (transfer.scalars - low) * (1 - (moved - low) / width)
        scene = VolumeScene(volume, replace(transfer, scalars=scalars), integrator=integrator)
        on_device, _ = scene.shown_on(bench.timed)
        Integral(volume, scene.local, on_device, integrator)
        bench.timed.queue.finish()

    for integrator, about in INTEGRATORS.items():
        work = partial(change, integrator)
        work()
        spent = 1000 * statistics.median(timing.times(work, bench.request.repeat))
        words = "control points, cells that are not transparent"
        words += ", and the pre-integrated table" if integrator == "preintegrated" else ""
        yield Row(SECTION, model, "change of the transfer function", "", "ms", spent, words, about,
                  statement="interactive; no figure")  # fmt: skip
