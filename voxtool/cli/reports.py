"""Options, measuring and printing of all benches."""

from __future__ import annotations

import shlex
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from voxtool.cli import options
from voxtool.cli.options import option, together
from voxtool.errors import CheckError, printable
from voxtool.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.bench.points import Budget, Point
    from voxtool.bench.report import Report
    from voxtool.bench.request import Request


def error_of(text: str) -> tuple[float, str | None]:
    """A number, and its measure after a colon: 1e-3 or 1e-3:hausdorff."""
    number, _, measure = text.partition(":")
    if not 0 <= float(number) < float("inf"):
        raise ValueError
    return float(number), measure.strip() or None


ERROR = options.Parsed("error", error_of, " is no error: write 1e-3, or 1e-3:hausdorff")
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


def measure_and_report(
    models: Sequence[str], request: Request, benches: tuple[str, ...] | None, *,
    words: Sequence[str], output: str | None, no_clobber: bool, budget_time: float | None,
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
    from voxtool.opencl import open_device

    error, measure = budget_error or (None, None)
    budget = Budget(budget_time, error, measure)
    asked = budget_time is not None or budget_error is not None
    steps = [(bench, model) for model in models for bench in benches or benches_for(model)]
    budget.check({bench for bench, _ in steps})
    if output is not None:
        check_folder(output, not no_clobber)
    if asked and output is None:  # an answer needs neither the memory nor the ablations
        request = replace(request, commands=False, ablations=False)
    info = open_device(request.device).info
    if request.peers:
        for package in missing({bench for bench, _ in steps}):
            options.tell(f"peer {package} is not installed: pip install {package}")
    with options.Progress([f"{bench}, {model}" for bench, model in steps]) as progress:
        found = list(sweep(models, request, benches, progress.enter))
    report = Report(
        [one for one in found if isinstance(one, Point)],
        [one for one in found if not isinstance(one, Point)],
        info, shlex.join(["voxtool", *map(printable, words)]), date,
    )  # fmt: skip
    if output is not None:
        write_report(report, output, not no_clobber)
    if as_json:
        options.print_json(report.as_dict())
    elif not asked:
        click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
        print_points(report)
    if output is not None and not as_json:
        click.echo(f"report: {output.rstrip('/')}/report.html")
    if asked:
        answer(report.points, budget, as_json)


def print_points(report: Report) -> None:
    """The tables of each chart and what to choose from it; then the ablations."""
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
        click.echo(f"{chart}: {named(point)}: {duration(point.seconds)}{error}", err=err)
    if none:
        raise CheckError(f"{budget}: nothing that was measured meets it in {'; '.join(none)}")
