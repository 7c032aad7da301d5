"""voxtool adf-query: the values of a distance field at points, or a picture of a plane."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import DEFAULT_SEARCH, EXACT, SAMPLERS, SEARCHES
from voxtool.cli import options, runner
from voxtool.cli.options import (
    BYTES,
    Parsed,
    flag,
    numbers_of,
    option,
    output_of,
    plane_of,
    together,
)
from voxtool.errors import count_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.stored_field import StoredField
    from voxtool.adf.queries.query import FieldQuery

SLICE_SIZE = 800  # pixels
COLUMNS = {
    "distance": [("distance", "f8")],
    "gradient": [("gx", "f4"), ("gy", "f4"), ("gz", "f4")],
    "bounds": [("bound", "f8")],
    "cell": [("level", "u1"), ("kx", "u4"), ("ky", "u4"), ("kz", "u4")],
    "outside": [("outside", "?")],
}


PLANE = Parsed(
    "plane",
    lambda text: plane_of(text, lambda place: numbers_of(place, 1)[0]),
    " is no plane: write x=1.5, y=0 or z=-2",
)


@click.command("adf-query")
@click.argument("field")
@click.argument("points", required=False)
@together(
    option("--search", SEARCHES,
        "How leaves are found: linear, from coarse to fine; binary, by halving the levels; "
        "coherent, from the level of the point before, for points along rays; bottom-up, from fine "
        "to coarse, for points near the surface.  All find the same.",
        DEFAULT_SEARCH),
    option("--sampler", SAMPLERS,
        "What interpolates: exact arithmetic, the same everywhere, or the device's hardware, with "
        "8-bit weights on most.", EXACT),
    flag("--gradient", "Write the gradient, too: gx, gy, gz."),
    flag("--bounds", "Write a bound of the error of the distance, too: bound."),
    flag("--cell", "Write the leaf, too: its level and its key kx, ky, kz (eq. 3-1)."),
    option("--slice plane", PLANE, "Draw the field on this plane (z=0.5) as .png, without POINTS.",
        metavar="AXIS=VALUE"),
    option("--size", click.IntRange(200, 8192),
        f"Pixels of the picture's width.  [default: {SLICE_SIZE}]"),
    option("--max-memory", BYTES,
        "Leave a larger FIELD in its file, and read only what POINTS need (800M, 8G), for the "
        "same values.  [default: half of what is free]", metavar="BYTES"),
)  # fmt: skip
@runner.run_options(
    options.output_options(
        "FILE", "Default POINTS's name with .distance.npy or --format, in this folder; stdout, as "
        "CSV, for stdin; with --slice FIELD's name with .slice.png.",
    ),
    options.format_option("npy", "csv"),
    options.device_option,
    options.report_options,
)  # fmt: skip
def command(
    run: runner.Run, field: str, points: str | None, search: str, sampler: str,
    plane: tuple[str, float] | None, size: int | None, **asked: bool,
) -> None:  # fmt: skip
    """Evaluate a distance FIELD at POINTS: their distances from its mesh, negative inside.

    FIELD is a file that adf-build wrote; POINTS is a .npy, .npz, .csv, .xyz or .ply file. Each can
    be - for stdin, which is the default of POINTS. Points and distances are in world units. Outside
    the field's cube, distances are lower bounds without a sign. The columns are distance; then, if
    asked for, gx, gy, gz; bound; level, kx, ky, kz; and with any of these outside (0 or 1).

    \b
    Examples:
      voxtool adf-query bunny.adf.h5 points.csv --gradient -o answers.csv
      voxtool adf-query bunny.adf.h5 --slice z=0 -o slice.png
    """
    if plane is None:
        if size is not None:
            raise click.UsageError("--size goes with --slice: there is no picture")
        points = options.points_of(points, "FIELD", field, "name a file, or pipe them in")
    elif points or any(asked.values()) or run.file_format:
        raise click.UsageError(
            "--slice draws distances: leave out POINTS, --gradient, --bounds, --cell and --format"
        )
    from voxtool.adf.field.host_query import no_bounds
    from voxtool.adf.field.stored_field import StoredField
    from voxtool.adf.queries.query import FieldQuery
    from voxtool.files import read_adf
    from voxtool.pictures.slices import check_plane

    if plane:
        run.file_format = "png"
        run.to(field, output_of(field if field != "-" else "field", "slice.png"), ("png",))
    else:
        run.to_table(points or "-")
    with run, ExitStack() as stack:
        source = stored_in(run, field, stack) if plane is None else None
        if source is None:
            source = run.stage("read field", read_adf, field)
        with run.naming(field):
            if asked["bounds"] and source.bounds is None:
                raise no_bounds()
            query: Any = source.query
            if not isinstance(source, StoredField):
                if plane:
                    check_plane(source, *plane)
                query = FieldQuery(source, run.device, sampler=sampler)
        if plane:
            facts = draw(run, query, plane, size or SLICE_SIZE)
        else:
            facts = answer(run, query, points or "-", search, asked)
    what = f"{facts['points']:,} pixels at {plane[0]}={plane[1]:g}" if plane else ""
    run.notes += notes_of(facts)
    run.report(f"{what or count_of(facts['points'], 'point')}, {run.size}", lambda: facts)


def stored_in(run: runner.Run, field: str, stack: ExitStack) -> StoredField | None:
    """Return a field that stays in its file since it does not fit in memory, or None."""
    from voxtool.adf.field.stored_field import StoredField
    from voxtool.files import open_adf
    from voxtool.memory import available_memory

    limit = available_memory() // 2 if run.max_memory is None else run.max_memory
    if field == "-" or not os.path.isfile(field) or os.path.getsize(field) <= limit:
        return None
    source: Any = run.stage("read field", stack.enter_context, open_adf(field))
    run.on_device = not isinstance(source, StoredField)
    return source if isinstance(source, StoredField) else None


def draw(run: runner.Run, query: FieldQuery, plane: tuple[str, float], size: int) -> dict[str, Any]:
    """Write the picture of a plane; return the facts of the report, whose points are pixels."""
    from voxtool.files.pictures.picture import write_picture
    from voxtool.pictures.slices import draw_field_slice

    run.enter("draw")
    picture, drawn = draw_field_slice(query, *plane, size=size)
    run.write(write_picture, picture)
    return {"points": len(drawn.distance), "outside": 0, "nan": 0}


def answer(
    run: runner.Run, query: FieldQuery, points: str, search: str, asked: dict[str, bool]
) -> dict[str, Any]:
    """Write the values at points, block by block; return the facts of the report. `ns_a_point` is
    of the queries alone; the first one compiles kernels."""
    import numpy as np

    from voxtool.adf.field.cells import key_of
    from voxtool.files.tables.points import read_points

    included = {"distance": True, **asked, "outside": any(asked.values())}
    columns = [column for part in COLUMNS if included[part] for column in COLUMNS[part]]
    facts: dict[str, Any] = {"points": 0, "outside": 0, "nan": 0}
    seconds = 0.0
    run.enter("query")
    with run.table(columns) as answers:
        for block in read_points(points):
            started = time.perf_counter()
            found = query(block, search=search, **asked)
            seconds += time.perf_counter() - started
            facts["points"] += len(block)
            facts["outside"] += int(np.count_nonzero(found.outside))
            facts["nan"] += int(np.count_nonzero(np.isnan(block).any(axis=1)))
            values = [found.distance, found.gradient, found.bound, found.level]
            if found.level is not None and found.cell is not None:
                values.append(key_of(found.level, found.cell))
            if included["outside"]:
                values.append(found.outside)
            answers.write([part for part in values if part is not None])
    if seconds:
        facts["ns_a_point"] = round(1e9 * seconds / facts["points"], 1)
    return facts


def notes_of(facts: dict[str, Any]) -> Iterator[str]:
    """Return the remarks on points whose values are not distances."""
    for what, place, values in (
        ("nan", "NaN", "so is the value"),
        ("outside", "outside the cube", "the values are lower bounds"),
    ):
        if count := facts[what]:
            yield f"{count_of(count, 'point')} {'is' if count == 1 else 'are'} {place}: {values}"
