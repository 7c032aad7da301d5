"""What the benches share that write reports: options, measuring, and what is printed of it."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options
from voxtool.errors import CheckError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from voxtool.bench.points import Budget, Point, Saving
    from voxtool.bench.sweep import Sweep


class Error(click.ParamType):
    """A number, and after a colon the measure that it is of: 1e-3 or 1e-3:hausdorff."""

    name = "error"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str | None]:
        if isinstance(value, tuple):
            return value
        number, _, measure = str(value).partition(":")
        try:
            most = float(number)
        except ValueError:
            most = -1.0
        if not 0 <= most < float("inf"):
            self.fail(f"{value!r} is no error: write 1e-3, or 1e-3:hausdorff", param, ctx)
        return most, measure.strip() or None


def report_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """-o, --no-clobber, --budget-time, --budget-error and --date."""
    for option in reversed(
        (
            click.option(
                "-o", "--output", metavar="FOLDER",
                help="Write a report: report.html, .json and .csv, and a PNG of each chart.",
            ),
            click.option(
                "--no-clobber", is_flag=True, help="Refuse to replace an existing file."
            ),
            click.option(
                "--budget-time", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS",
                help="Say which setting is the most accurate in this time.",
            ),
            click.option(
                "--budget-error", type=Error(), metavar="ERROR[:MEASURE]",
                help="Say which setting is the cheapest with this error at most.",
            ),
            click.option("--date", metavar="TEXT", help="To be written in the report."),
        )
    ):  # fmt: skip
        function = option(function)
    return function


samples_option = click.option(
    "--samples",
    type=click.IntRange(1, 100_000_000),
    default=20_000,
    show_default=True,
    help="Points on each surface at which the error of a report is measured.",
)


def wanted(given: dict[str, Any]) -> bool:
    """Whether a report or an answer is asked for, and not the bench's own table."""
    return any(given[name] is not None for name in ("output", "budget_time", "budget_error"))


def measure_and_report(
    models: Sequence[str],
    asked: Sweep,
    benches: tuple[str, ...] | None,
    *,
    output: str | None,
    no_clobber: bool,
    budget_time: float | None,
    budget_error: tuple[float, str | None] | None,
    date: str | None,
    as_json: bool,
) -> None:
    """Measure, print what to choose, and write the report.

    Raises
    ------
    VoxtoolError : as voxtool.bench.sweep.sweep and voxtool.bench.report.write_report.
    """
    from voxtool.bench.peers import missing
    from voxtool.bench.points import Budget, Point
    from voxtool.bench.report import Report, check_folder, write_report
    from voxtool.bench.sweep import bench_of, sweep
    from voxtool.opencl import open_device

    # for an answer alone, neither memory nor what plans save is looked at
    asked = replace(
        asked,
        commands=asked.commands and output is not None,
        forced=asked.forced and (output is not None or as_json),
    )
    error, measure = budget_error or (None, None)
    budget = Budget(budget_time, error, measure)
    budget.check({bench for model in models for bench in benches or bench_of(model)})
    if output is not None:
        check_folder(output, not no_clobber)
    device = open_device(asked.device)
    if asked.peers:
        for package in missing():
            options.tell(f"peer {package} is not installed: pip install {package}")
    points: list[Point] = []
    savings: list[Saving] = []
    steps = [f"{bench}, {model}" for model in models for bench in benches or bench_of(model)]
    with options.Progress(steps) as progress:
        for found in sweep(models, asked, benches, on_step=progress.enter):
            if isinstance(found, Point):
                points.append(found)
            else:
                savings.append(found)
    words = [word if word.isprintable() else "?" for word in sys.argv[1:]]
    report = Report(points, savings, device.info, shlex.join(["voxtool", *words]), date)
    if output is not None:
        write_report(report, output, not no_clobber)
    if as_json:
        options.print_json(report.as_dict())
    elif budget_time is None and budget_error is None:
        print_verdicts(report.points)
    if output is not None and not as_json:
        click.echo(f"report: {output.rstrip('/')}/report.html")
    if budget_time is not None or budget_error is not None:
        answer(points, budget, as_json)


def print_verdicts(points: Sequence[Point]) -> None:
    """What to choose, chart by chart."""
    from voxtool.bench.chart import exponents
    from voxtool.bench.points import charts_of, title, verdicts

    for chart, found in charts_of(points).items():
        click.echo(f"{title(chart)}")
        for line in verdicts(found):
            click.echo(f"  {line}")
        for method, (p, low, high) in exponents(found).items():
            size_of = next(point.size_of for point in found if point.size)
            click.echo(f"  cost of {method}: {size_of} to the {p:.2f}, {low:,g} to {high:,g}")
        click.echo()


def answer(points: Sequence[Point], budget: Budget, err: bool) -> None:
    """The setting to choose in each chart.

    Raises
    ------
    VoxtoolError : there is none in some chart.
    """
    from voxtool.bench.points import answers, charted, duration, named

    none = []
    for chart, point in answers(points, budget):
        if point is None:
            none.append(chart)
            continue
        measure = budget.measure or charted(point.bench)
        found = point.errors.get(measure)
        told = "" if found is None else f", {measure} error {found:.3g}"
        click.echo(f"{chart}: {named(point)}: {duration(point.seconds)}{told}", err=err)
    if none:
        raise CheckError(f"{budget}: nothing that was measured meets it in {'; '.join(none)}")
