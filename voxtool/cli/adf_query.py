"""voxtool adf-query: the values of a distance field at points, or a picture of a plane."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import DEFAULT_SEARCH, SEARCHES
from voxtool.cli import options, runner
from voxtool.cli.options import Parsed, flag, option, plane_of, together
from voxtool.errors import count_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import numpy as np

    from voxtool.adf.host_query import QueryResult
    from voxtool.adf.query import FieldQuery
    from voxtool.files.answers import Answers

SLICE_SIZE = 800  # pixels
ANSWER_COLUMNS = {
    "distance": [("distance", "f8")],
    "gradient": [("gx", "f4"), ("gy", "f4"), ("gz", "f4")],
    "bounds": [("bound", "f8")],
    "cell": [("level", "u1"), ("kx", "u4"), ("ky", "u4"), ("kz", "u4")],
    "outside": [("outside", "?")],
}


PLANE = Parsed(
    "plane", lambda text: plane_of(text, finite), " is no plane: write x=1.5, y=0 or z=-2"
)


def finite(text: str) -> float:
    if not math.isfinite(place := float(text)):
        raise ValueError
    return place


@dataclass
class Tally:
    """Counts of points, and the seconds that the queries took."""

    points: int = 0
    outside: int = 0
    nan: int = 0
    seconds: float = 0.0

    def add(self, points: np.ndarray, answer: QueryResult, seconds: float) -> None:
        import numpy as np

        self.points += len(points)
        self.outside += int(np.count_nonzero(answer.outside))
        self.nan += int(np.count_nonzero(np.isnan(points).any(axis=1)))
        self.seconds += seconds

    def facts(self) -> dict[str, Any]:
        """The tally in JSON types; `ns_a_point` is of the queries alone, whose first one compiles
        kernels. The points of a picture are its pixels."""
        found: dict[str, Any] = {"points": self.points, "outside": self.outside, "nan": self.nan}
        if self.seconds:
            found["ns_a_point"] = round(1e9 * self.seconds / self.points, 1)
        return found

    def notes(self) -> Iterator[str]:
        """Counts of points with other values than distances."""
        if self.nan:
            yield f"{count_of(self.nan, 'point')} {is_or_are(self.nan)} NaN: so is the value"
        if self.outside:
            yield (
                f"{count_of(self.outside, 'point')} {is_or_are(self.outside)} outside the cube: "
                "the values are lower bounds"
            )


def is_or_are(count: int) -> str:
    return "is" if count == 1 else "are"


@click.command("adf-query")
@click.argument("field")
@click.argument("points", required=False)
@together(
    option("--search", SEARCHES,
        "How leaves are found: linear, from coarse to fine; binary, by halving the levels; "
        "coherent, from the level of the point before, for points along rays.  All find the same.",
        DEFAULT_SEARCH),
    flag("--gradient", "Write the gradient, too: gx, gy, gz."),
    flag("--bounds", "Write a bound of the error of the distance, too: bound."),
    flag("--cell", "Write the leaf, too: its level and its key kx, ky, kz (eq. 3-1)."),
    option("--slice plane", PLANE, "Draw the field on this plane (z=0.5) as .png, without POINTS.",
        metavar="AXIS=VALUE"),
    option("--size", click.IntRange(200, 8192),
        f"Pixels of the picture's width.  [default: {SLICE_SIZE}]"),
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
    run: runner.Run, field: str, points: str | None, search: str,
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
        points = points or "-"
        if field == points == "-":
            raise options.input_twice("FIELD", "POINTS")
        if points == "-" and sys.stdin.isatty():
            raise click.UsageError("there are no POINTS: name a file, or pipe them in")
    elif points or any(asked.values()) or run.file_format:
        raise click.UsageError(
            "--slice draws distances: leave out POINTS, --gradient, --bounds, --cell and --format"
        )
    from voxtool.adf.host_query import no_bounds
    from voxtool.adf.query import FieldQuery
    from voxtool.files import read_adf
    from voxtool.files.answers import open_answers
    from voxtool.files.picture import write_picture
    from voxtool.files.points import read_points
    from voxtool.plots.slice import check_plane, draw_slice

    if plane:
        run.file_format = "png"
        run.to(field, slice_name(field), ("png",))
    else:
        run.to_table(points or "-")
    with run:
        source = run.stage("read field", read_adf, field)
        with run.naming(field):
            if asked["bounds"] and source.bounds is None:
                raise no_bounds()
            if plane:
                check_plane(source, *plane)
        query = FieldQuery(source, run.device)
        if plane:
            run.enter("draw")
            picture, drawn = draw_slice(query, *plane, size=size or SLICE_SIZE)
            run.write(write_picture, picture)
            tally = Tally(points=len(drawn.distance))
        else:
            run.enter("query")
            opened = open_answers(
                str(run.output), columns_of(asked), run.file_format, not run.no_clobber
            )
            with opened as answers:
                blocks = read_points(points or "-")
                tally = answer_points(query, blocks, answers, search=search, **asked)
    what = f"{tally.points:,} pixels at {plane[0]}={plane[1]:g}" if plane else ""
    run.notes += tally.notes()
    run.report(what or count_of(tally.points, "point"), tally.facts)


def slice_name(field: str) -> str:
    """bunny.adf.h5 -> bunny.slice.png, in the current folder."""
    name = PurePath(field if field != "-" else "field").name
    return f"{name.removesuffix('.h5').removesuffix('.adf')}.slice.png"


def columns_of(asked: dict[str, bool]) -> list[tuple[str, str]]:
    """Names and types of what is written: `outside` too, if more than the distance is."""
    wanted = {"distance": True, **asked, "outside": any(asked.values())}
    return [
        column for part, columns in ANSWER_COLUMNS.items() if wanted[part] for column in columns
    ]


def answer_points(
    query: FieldQuery, blocks: Iterable[np.ndarray], answers: Answers, **request: Any
) -> Tally:
    """Ask for the points, block by block, and write the answers."""
    from voxtool.adf.cells import key_of

    tally = Tally()
    for points in blocks:
        started = time.perf_counter()
        answer = query(points, **request)
        tally.add(points, answer, time.perf_counter() - started)
        columns: list[np.ndarray] = [answer.distance]
        if answer.gradient is not None:
            columns.append(answer.gradient)
        if answer.bound is not None:
            columns.append(answer.bound)
        if answer.level is not None and answer.cell is not None:
            columns += [answer.level, key_of(answer.level, answer.cell)]
        if len(columns) > 1:
            columns.append(answer.outside)
        answers.write(columns)
    return tally
