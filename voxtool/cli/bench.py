"""voxtool bench: one command for each thing that is measured, and one for all of them.

Each command is a selection of benches and of the options that they read; all measure with one
engine and print alike.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from voxtool.bench.request import KINDS, QUICK, SETTINGS, TRANSFERS, Request
from voxtool.choices import (
    FILLS,
    FITS,
    MAX_LEVEL,
    METHODS,
    MODES,
    POINT_FILLS,
    SEARCHES,
    STYLE_ALIASES,
    STYLES,
    VIEWS,
)
from voxtool.cli import bench_compare, bench_texts, options
from voxtool.cli.options import DIM, flag, option, together
from voxtool.errors import CheckError, printable
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.points import Budget, Point
    from voxtool.bench.report import Report

FULL = Request()


def error_of(text: str) -> tuple[float, str | None]:
    """Return a number, and its measure after a colon: 1e-3 or 1e-3:hausdorff."""
    number, _, measure = text.partition(":")
    if not 0 <= float(number) < float("inf"):
        raise ValueError
    return float(number), measure.strip() or None


ERROR = options.Parsed("error", error_of, " is no error: write 1e-3, or 1e-3:hausdorff")
COUNT = click.IntRange(1, 100_000_000)
# By fields of a Request: the type of a value or its choices, the help, and the metavar. Fields that
# are tuples take several values.
OPTIONS: dict[str, tuple[Any, ...]] = {
    "dims": (DIM, "Voxels along the longest side.", "DIM,..."),
    "modes": (MODES, "Modes, as in `voxtool voxelize`."),
    "fills": (FILLS, "Fill rules of solids, as in `voxtool voxelize`; surfaces take the first."),
    "fit": (FITS, "stretch: eq. (5.1) of [voCCeL], as its tables."),
    "samples": (click.IntRange(0, 100_000_000), "Points on each surface at which errors are "
                "measured; with 0, no distances, which take minutes on millions of triangles, and "
                "no errors of voxels."),
    "styles": (options.Alias(STYLES, STYLE_ALIASES),
               "Styles, as in `voxtool extract`: marching-cubes of level 0, the others of voxels."),
    "isovalue": (float, "Between 0 and 1."),
    "tolerances": (click.FloatRange(min=0),
                   "Errors that leaves may have, in sides of the cube.", "LENGTH,..."),
    "levels": (click.IntRange(1, MAX_LEVEL),
               "Finest levels of fields, as --max-level of `voxtool adf-build`.", "LEVEL,..."),
    "band": (float, "As in `voxtool adf-build`.  [default: everywhere]"),
    "fill": (POINT_FILLS, "As in `voxtool adf-build` and `voxtool distance`.  [default: auto]"),
    "points": (COUNT, "Points at which distances are computed."),
    "kinds": (KINDS, "Points: random, or along rays."),
    "searches": (SEARCHES, "How the leaf of a point is found, as in `voxtool adf-query`."),
    "grids": (DIM, "Voxels along the longest side of dense grids.", "DIM,..."),
    "sizes": (click.IntRange(1, 8192), "Pixels along each side; errors are those of the largest.",
              "PIXELS,..."),
    "pixels": (COUNT, "Pixels along each side at which errors are measured."),
    "view": (VIEWS, "As in `voxtool render`; orthographic."),
    "methods": (METHODS, "As in `voxtool render`."),
    "integrators": (click.STRING, "As in `voxtool render`."),
    "transfers": (TRANSFERS, "Transfer functions: five colours, times as opaque, or two slabs."),
    "triangles": (COUNT, "Most triangles of a mesh that is subdivided."),
    "cells": (COUNT, "Most cells of a volume that is subdivided."),
    "scalar": (str, "As in `voxtool tet-build`.", "NAME"),
    "component": (str, "As in `voxtool tet-build`.", "NAME"),
}  # fmt: skip
ALIASES = {"levels": "--max-level", "sizes": "--size"}
COMMANDS = {
    "all": """Measure everything that voxtool does with MODELS: error against run time.

    Triangle meshes are voxelized, surfaces extracted, and distance fields built and queried; volume
    meshes are drawn. -o writes a page with charts and JSON.

    \b
    Examples:
      voxtool bench all bunny.obj volume.vtu --scalar density --quick -o report
      voxtool bench all bunny.obj --quick --budget-error 0.5
    """,
    "voxelize": """Measure voxelizing MODELS: error of the boundary, time, memory and stages.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench voxelize bunny.obj --dims 512,1024 --modes solid --peers
      voxtool bench voxelize bunny.obj --dims 64 --modes solid --fills parity,winding,flood
    """,
    "extract": """Measure extracting surfaces from the solid octrees of MODELS.

    \b
    Examples:
      voxtool bench extract bunny.obj --dims 256,512
      voxtool bench extract bunny.obj --dims 512,1024 --styles marching-cubes,surface-nets --peers
    """,
    "adf": """Measure distance fields of MODELS: their build, hash and queries.

    Exact distances are measured at the same points.

    \b
    Examples:
      voxtool bench adf bunny.obj --tolerances 1e-2,1e-3 --levels 7
      voxtool bench adf bunny.obj --tolerances 1e-3 --band 0.01 --peers
    """,
    "distance": """Measure exact distances to MODELS, at points and on dense grids.

    Errors are measured in rational arithmetic at a few points.

    \b
    Examples:
      voxtool bench distance bunny.obj --points 1000 --grids 16
      voxtool bench distance bunny.obj --quick --peers
    """,
    "pictures": """Measure pictures of the octrees and fields of MODELS, one ray a pixel.

    With --peers, other tools cast the same rays at the mesh itself.

    \b
    Examples:
      voxtool bench pictures bunny.obj --sizes 256 --dims 256 --levels 6 --tolerances 1e-2
      voxtool bench pictures bunny.obj --quick --peers
    """,
    "surfaces": """Measure surfaces of the distance fields of MODELS, rounded off and sharp.

    Other tools take samples of the field at the edges of its deepest leaves; their time includes
    these.

    \b
    Examples:
      voxtool bench surfaces bunny.obj --levels 5,6 --tolerances 1e-3
      voxtool bench surfaces bunny.obj --quick --peers
    """,
    "tets": """Measure pictures of MODELS, which are volume meshes, against pictures in float64.

    \b
    Examples:
      voxtool bench tets volume.vtu --scalar density --sizes 128 --peers
      voxtool bench tets volume.vtu --scalar density --sizes 64 --transfers x1 --methods raycast
    """,
    "view": """Measure pages of MODELS: the time to make them, their size, and what they unpack to.

    Pages of meshes show their octrees and fields. The size is that of the page over that of the
    content's .h5. An error is a value that the page unpacks to wrongly: there must be none.

    \b
    Examples:
      voxtool bench view bunny.obj --dims 128,256 --levels 5 --tolerances 1e-2
      voxtool bench view volume.vtu --scalar density
    """,
    "exchange": """Measure exports of the octrees of MODELS to every format, and imports of them.

    The size is that of the file over that of the octree's .svo.h5. An error is a voxel that comes
    back otherwise: there must be none. Times are of files on disk, flushed. A format whose package
    is not installed is left out, and so is a file that could have over 256 MB, with a warning.

    \b
    Examples:
      voxtool bench exchange bunny.obj --dims 128,512
      voxtool bench exchange bunny.obj --quick -o report
    """,
    "combine": """Measure set operations on the octrees of MODELS and of their mirror images.

    An error is a voxel that differs from numpy on dense arrays, up to dim 256: there must be none.
    The time of numpy is shown beside; that of voxelizing counts for neither.

    \b
    Examples:
      voxtool bench combine bunny.obj --dims 128,512
      voxtool bench combine bunny.obj --quick -o report
    """,
    "morph": """Measure morphology by a ball of 4 voxels, components and resampling of octrees.

    An error is a voxel that differs from SciPy's exact distance transform, up to dim 128: there
    must be none. The time of SciPy is shown beside; that of voxelizing does not count.

    \b
    Examples:
      voxtool bench morph bunny.obj --dims 128,512
      voxtool bench morph bunny.obj --quick -o report
    """,
    "fractions": """Measure how much of each voxel of MODELS lies inside: fractions and sampling.

    Compare fractions of each type, fractions of faces, 1,000 points a voxel up to dim 64, and the
    binary solid: the error of cut voxels is against float32 fractions, and that of the volume
    against the mesh's, exactly.

    \b
    Examples:
      voxtool bench fractions bunny.obj --dims 64,512
      voxtool bench fractions bunny.obj --quick -o report
    """,
    "attributes": """Measure octrees with labels, normals and colours, beside those without.

    With labels of shells, an error is a voxel without the label of the first shell that sets it,
    each voxelized alone. With normals and colours, it is an octree that sets other voxels. There
    must be none.

    \b
    Examples:
      voxtool bench attributes bunny.obj --dims 128,512
      voxtool bench attributes bunny.obj --quick -o report
    """,
    "scale": """Measure octrees of MODELS written in windows and merged, and many by one command.

    Windows have a quarter of the memory that the octree takes. An error is an octree whose content
    differs from that of the library: there must be none. Times are of files on disk, flushed.

    \b
    Examples:
      voxtool bench scale bunny.obj --dims 128,512
      voxtool bench scale bunny.obj --quick --peers
    """,
    "repair": """Measure the repair of MODELS with faces missing and reversed.

    Every seventeenth face is removed, and every fifth of the others reversed. Errors are those of
    the result against the model as it was: distances do not tell a solid from a crust, but volume
    and area do.

    \b
    Examples:
      voxtool bench repair bunny.obj --dims 128,256
      voxtool bench repair bunny.obj --quick --peers
    """,
    "growth": """Measure the growth of time with triangles, dims, leaves, pixels and cells.

    MODELS are subdivided for more triangles or cells. The exponent p of time ~ triangles^p is below
    each table.

    \b
    Examples:
      voxtool bench growth bunny.obj --triangles 300000
      voxtool bench growth volume.vtu --scalar density --cells 500000
    """,
    "degenerate": """Measure the growth of time with the faces of degenerate meshes.

    MODELS are kinds of meshes that are generated: copies, points, collinear, fan, closed-fans,
    loose-fan, book, loops, needles, shells, nested; by default all. The exponent p of time ~
    triangles^p is below each table.

    \b
    Examples:
      voxtool bench degenerate copies book --triangles 100000 --repeat 1
      voxtool bench degenerate --triangles 1000 --repeat 1 -o report
    """,
    "plans": """Measure what plans leave out, for ten scenes of each wing.

    MODELS are scenes that are generated, as voxels-cube and field-ball; by default all. For each
    part that its plan leaves out, a decision is forced that undoes it: the time and the bytes of
    memory that leaving it out saves are printed.

    \b
    Examples:
      voxtool bench plans voxels-cube field-ball
      voxtool bench plans --repeat 3 -o report
    """,
}
UNITS = """
    Times are medians after a warm-up, in memory, kernels compiled; ± is their spread. Errors are in
    diagonals of the model (surfaces), sides of the field's cube (distances), colours from 0 to 1
    (pictures of volumes) or shares of pixels (other pictures), values (pages) or voxels (files). *
    marks the Pareto front. With a budget the exit code is 1 if nothing measured meets it.
"""


@click.group("bench")
def command() -> None:
    """Measure voxtool: error against run time, beside other tools on the same work.

    Times are in s, ms or µs, memory in MB.

    \b
    Examples:
      voxtool bench all bunny.obj --quick -o report
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench compare old/report.json new/report.json
    """


report_options = together(
    option("-o --output", str,
        "Write a report: report.html, .json and .csv, and a PNG of each chart.", metavar="FOLDER"),
    options.clobber_option,
    option("--budget-time", click.FloatRange(min=0, min_open=True),
        "Print only the most accurate setting within this time.", metavar="SECONDS"),
    option("--budget-error", ERROR, "Print only the cheapest setting with at most this error.",
        metavar="ERROR[:MEASURE]"),
    option("--date", str, "Written in the report.", metavar="TEXT"),
)  # fmt: skip


def request_option(name: str) -> options.Decorator:
    """Return the option of a field of a Request; the default None leaves the request's own."""
    kind, about, *metavar = OPTIONS[name]
    default = getattr(FULL, name)
    several = isinstance(default, tuple)
    if default is not None and name != "band":
        about += f"  [default: {','.join(map(str, default if several else (default,)))}]"
    if several:
        kind = options.List(click.Choice(kind) if isinstance(kind, tuple) else kind)
        metavar = metavar or ["NAME,..."]
    words = f"--{name} {ALIASES.get(name, '')} {name}"
    return option(words, kind, about, metavar=metavar[0] if metavar else None)


def bench_command(bench: str) -> click.Command:
    """Return the command of a bench, or of all."""
    selection = None if bench == "all" else (bench,)
    names = tuple(dict.fromkeys(n for one in selection or SETTINGS for n in SETTINGS[one]))

    def call(
        models: tuple[str, ...], quick: bool, repeat: int | None, peers: bool,
        device_name: str | None, quiet: bool, no_ablate: bool, **given: Any,
    ) -> None:  # fmt: skip
        values = {name: given.pop(name) for name in names}
        chosen = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
            if value is not None
        }
        request = replace(QUICK if quick else FULL, **chosen, peers=peers, device=device_name)
        request = replace(request, ablations=not no_ablate)
        if repeat:
            request = replace(request, repeat=repeat, seconds=0.0)
        measure(models, request, selection, **given)

    head, examples = COMMANDS[bench].split("\n\n    \b", 1)
    call.__doc__ = f"{head}\n{UNITS}\n    \b{examples}"
    decorate = together(
        click.argument("models", nargs=-1, required=bench not in ("degenerate", "plans")),
        flag("--quick", "Few and small settings: seconds, not minutes."),
        option("--repeat", click.IntRange(1, 1000), "Runs after a warm-up.  [default: 3, and up "
               "to 9 of short work; 2 with --quick]", metavar="N"),
        flag("--peers", "Other tools on the same work, those that are installed: VTK, Open3D, "
             "libigl, scikit-image, trimesh, MeshLab."),
        *map(request_option, names),
        flag("--no-ablate", "Do not force decisions of plans, for what each of them saves."),
        report_options,
        options.device_option,
        options.quiet_option,
        options.json_option,
    )  # fmt: skip
    return click.command(bench)(decorate(call))


def measure(
    models: Sequence[str], request: Request, benches: tuple[str, ...] | None, *,
    output: str | None, no_clobber: bool, budget_time: float | None,
    budget_error: tuple[float, str | None] | None, date: str | None, as_json: bool,
) -> None:  # fmt: skip
    """Measure, print the points and what to choose, and write the report.

    Raises
    ------
    VoxtoolError : as voxtool.bench.sweep.sweep and voxtool.bench.report.write_report.
    """
    from voxtool.bench.peers import missing
    from voxtool.bench.points import Budget, Point
    from voxtool.bench.report import Report, check_folder, write_report
    from voxtool.bench.request import benches_for
    from voxtool.bench.sweep import sweep
    from voxtool.opencl import shared_device

    error, measure = budget_error or (None, None)
    budget = Budget(budget_time, error, measure)
    asked = budget_time is not None or budget_error is not None
    steps = [(bench, model) for model in models for bench in benches or benches_for(model)]
    budget.check({bench for bench, _ in steps})
    if output is not None:
        check_folder(output, not no_clobber)
    if asked and output is None:  # an answer needs neither the memory nor the ablations
        request = replace(request, commands=False, ablations=False)
    info = shared_device(request.device).info
    if request.peers:
        for package in missing({bench for bench, _ in steps}):
            options.tell(f"peer {package} is not installed: pip install {package}")
    with options.Progress([f"{bench}, {model}" for bench, model in steps]) as progress:
        found = list(sweep(models, request, benches, progress.enter))
    report = Report(
        [one for one in found if isinstance(one, Point)],
        [one for one in found if not isinstance(one, Point)],
        info, shlex.join(["voxtool", *map(printable, sys.argv[1:])]), date,
    )  # fmt: skip
    if output is not None:
        write_report(report, output, not no_clobber)
    if as_json:
        options.print_json(report.as_dict())
    elif not asked:
        click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
        print_points(report)
    if output is not None and not as_json:
        click.echo(f"report: {printable(output.rstrip('/'))}/report.html")
    if asked:
        answer(report.points, budget, as_json)


def print_points(report: Report) -> None:
    """Print the tables of each chart and what to choose from it; then the ablations."""
    from voxtool.bench.points import charts_of, costs, title, verdicts
    from voxtool.bench.tables import absent_of, tables_of

    for chart, points in charts_of(report.points).items():
        click.echo(f"\n{printable(title(chart))}")
        for table in tables_of(points):
            click.echo(f"  {table.note}")
            for line in table.lines():
                click.echo(f"    {printable(line)}")
        for line in (*absent_of(points), *verdicts(points), *costs(points)):
            click.echo(f"  {printable(line)}")
    for one in report.ablations:
        result = "" if one.same else "; the result differs"
        words = f"{one.bench}, {one.model}: {one.work}: without {one.what}: {one.verdict}{result}"
        click.echo(f"{chr(10) * (one is report.ablations[0])}{printable(words)}")


def answer(points: Sequence[Point], budget: Budget, err: bool) -> None:
    """Print the setting to choose in each chart.

    Raises
    ------
    CheckError : nothing meets the budget in some chart.
    """
    from voxtool.bench.points import answers, charted, duration, named

    none = []
    for chart, point in answers(points, budget):
        if point is None:
            none.append(chart)
            continue
        measure = budget.measure or charted(point.bench)
        found = point.errors.get(measure)
        error = "" if found is None else f", {measure} error {found:.3g}"
        say = options.tell if err else click.echo
        say(f"{chart}: {named(point)}: {duration(point.seconds)}{error}")
    if none:
        raise CheckError(f"{budget}: nothing that was measured meets it in {'; '.join(none)}")


for _name in COMMANDS:
    command.add_command(bench_command(_name))
command.add_command(bench_compare.command)
command.add_command(bench_texts.command)
