"""voxtool adf-query: what a distance field says at points, or on a plane as a picture."""

from __future__ import annotations

import math
import os
import sys
import time
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import SEARCHES
from voxtool.cli import options
from voxtool.errors import VoxtoolError, count_of

if TYPE_CHECKING:
    from collections.abc import Iterable

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


class Plane(click.ParamType):
    """An axis and where a plane crosses it: z=0.5."""

    name = "plane"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        axis, equals, text = str(value).partition("=")
        try:
            place = float(text)
        except ValueError:
            place = math.nan
        if axis not in ("x", "y", "z") or not equals or not math.isfinite(place):
            self.fail(f"{value!r} is no plane: write x=1.5, y=0 or z=-2", param, ctx)
        return axis, place


@dataclass
class Tally:
    """What was asked and answered, and the seconds that the queries took."""

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


@click.command("adf-query")
@click.argument("field")
@click.argument("points", required=False)
@options.output_options(
    "FILE",
    "Default POINTS's name with .distance.npy or --format, in this folder; stdout for stdin; with "
    "--slice FIELD's name with .slice.png.",
)
@click.option(
    "--search",
    type=click.Choice(SEARCHES),
    default="binary",
    show_default=True,
    help="How leaves are found: from coarse to fine; by halving the levels; or from the level of "
    "the point before, for points along rays or in another order of near ones.  All find the same.",
)
@click.option("--gradient", is_flag=True, help="Write the gradient, too: gx, gy, gz.")
@click.option(
    "--bounds",
    is_flag=True,
    help="Write how far at most the distance is from the exact one, too: bound.",
)
@click.option(
    "--cell", is_flag=True, help="Write the leaf, too: its level and its key kx, ky, kz (eq. 3-1)."
)
@click.option(
    "--slice",
    "plane",
    type=Plane(),
    metavar="AXIS=VALUE",
    help="Draw the field on this plane (z=0.5) as .png, instead of answering POINTS.",
)
@click.option(
    "--size",
    type=click.IntRange(200, 8192),
    help=f"Pixels of the picture's width.  [default: {SLICE_SIZE}]",
)
@options.format_option("npy", "csv")
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    field: str,
    points: str | None,
    output: str | None,
    no_clobber: bool,
    search: str,
    gradient: bool,
    bounds: bool,
    cell: bool,
    plane: tuple[str, float] | None,
    size: int | None,
    file_format: str | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Ask a distance FIELD how far POINTS are from its mesh; negative inside.

    FIELD is a file that adf-build wrote; POINTS a .npy, .npz, .csv, .xyz or .ply file; each can be
    - for stdin, which POINTS is by default. Points and answers are in world units. Outside of the
    field's cube answers are lower bounds on the distance, without a sign. Columns: distance; then,
    as asked for, gx, gy, gz; bound; level, kx, ky, kz; and with any of these outside (0 or 1).

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
            raise click.UsageError("FIELD and POINTS cannot both be stdin: name a file for one")
        if points == "-" and sys.stdin.isatty():
            raise click.UsageError("there are no POINTS: name a file, or pipe them in")
    elif points or gradient or bounds or cell or file_format:
        raise click.UsageError(
            "--slice draws distances: leave out POINTS, --gradient, --bounds, --cell and --format"
        )
    started = time.perf_counter()
    from voxtool.adf.host_query import no_bounds
    from voxtool.adf.query import FieldQuery
    from voxtool.files import check_target, read_adf
    from voxtool.files.answers import open_answers
    from voxtool.files.picture import write_picture
    from voxtool.files.points import read_points
    from voxtool.opencl import open_device
    from voxtool.plots.slice import check_plane, draw_slice

    if output is None:
        output = default_output(field, points, file_format)
    if output != "-":
        check_target(output, not no_clobber)
        if points and os.path.exists(output) and points != "-" and os.path.samefile(points, output):
            raise click.UsageError(f"{output} is POINTS itself: name another output")
    stages = ["read field", "query"] if plane is None else ["read field", "draw"]
    with options.Progress(stages) as progress:
        progress.enter("read field")
        source = read_adf(field)
        try:
            if bounds and source.bounds is None:
                raise no_bounds()
            if plane is not None:
                check_plane(source, *plane)
        except VoxtoolError as error:
            raise type(error)(f"{field}: {error}") from error
        chosen = open_device(device, profile=verbose)
        query = FieldQuery(source, chosen)
        progress.enter(stages[-1])
        if plane is not None:
            picture, drawn = draw_slice(query, *plane, size=size or SLICE_SIZE)
            write_picture(picture, output, clobber=not no_clobber)
            tally = Tally(points=len(drawn.distance))
        else:
            asked = {"gradient": gradient, "bounds": bounds, "cell": cell}
            columns = columns_of(asked)
            with open_answers(output, columns, file_format, not no_clobber) as answers:
                blocks = read_points(points or "-")
                tally = answer_points(query, blocks, answers, search=search, **asked)
    seconds = time.perf_counter() - started
    if as_json:
        if output != "-" or not quiet:
            options.print_json(summary(output, tally, seconds), err=output == "-")
    else:
        source_name = f"{field} at {plane[0]}={plane[1]:g}" if plane else points
        what = f"{tally.points:,} pixels" if plane else f"{count_of(tally.points, 'point')}"
        options.tell(
            f"{source_name if source_name != '-' else 'stdin'} -> "
            f"{output if output != '-' else 'stdout'}: {what}, {seconds:.2f} s"
        )
    tell_unusual(tally)
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")


def default_output(field: str, points: str | None, file_format: str | None) -> str:
    """points.csv -> points.distance.npy, in the current folder; stdin -> stdout. Without points a
    picture: bunny.adf.h5 -> bunny.slice.png."""
    if points is None:
        name = PurePath(field if field != "-" else "field").name
        return f"{name.removesuffix('.h5').removesuffix('.adf')}.slice.png"
    if points == "-":
        return "-"
    return f"{PurePath(points).stem}.distance.{file_format or 'npy'}"


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


def tell_unusual(tally: Tally) -> None:
    """How many points have answers of another kind."""
    if tally.nan:
        options.tell(f"{count_of(tally.nan, 'point')} {is_or_are(tally.nan)} NaN: so is the answer")
    if tally.outside:
        options.tell(
            f"{count_of(tally.outside, 'point')} {is_or_are(tally.outside)} outside of the cube: "
            "theirs are lower bounds"
        )


def is_or_are(count: int) -> str:
    return "is" if count == 1 else "are"


def summary(output: str, tally: Tally, seconds: float) -> dict[str, Any]:
    """What was answered, in JSON types; `ns_a_point` is of the queries, whose first one compiles
    kernels, and `seconds` of all. A picture's points are its pixels."""
    result: dict[str, Any] = {
        "output": output,
        "points": tally.points,
        "outside": tally.outside,
        "nan": tally.nan,
        "seconds": round(seconds, 3),
    }
    if tally.seconds:
        result["ns_a_point"] = round(1e9 * tally.seconds / tally.points, 1)
    return result
