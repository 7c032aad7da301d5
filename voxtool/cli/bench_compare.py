"""voxtool bench compare: what became slower or less accurate, between two reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from voxtool.cli import options
from voxtool.cli.options import flag, option, together
from voxtool.errors import CheckError, VoxtoolError, count_of, printable

if TYPE_CHECKING:
    from voxtool.bench.compare import Change


@click.command("compare")
@click.argument("old")
@click.argument("new")
@together(
    option("--fail-over", click.FloatRange(min=0),
        "Fail if something became slower by more, beyond the noise, or less accurate.",
        metavar="PERCENT"),
    flag("--all show_all", "Print also what has not changed."),
)  # fmt: skip
@options.json_option
def command(old: str, new: str, fail_over: float | None, show_all: bool, as_json: bool) -> None:
    """Compare two reports of `voxtool bench`, row by row.

    A time has changed where the repeats of the two do not overlap; times are in s or ms. Errors
    have no noise: any larger error is reported. With --fail-over the exit code is 1 where a row of
    both became slower by more than this, or less accurate.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64 -o a --json | voxtool bench compare a/report.json -
      voxtool bench extract bunny.obj --dims 64 -o b --json | voxtool bench compare b/report.json -
    """
    from voxtool.bench.compare import compare, read_report

    after = read_report(new)  # first: it may come through a pipe from who writes the old one
    before = read_report(old)
    if before.where != after.where:
        options.tell(
            f"warning: measured on different devices: {printable(before.where)}; "
            f"{printable(after.where)}"
        )
    changes = compare(before, after)
    gone, added = (len(one.rows) - len(changes) for one in (before, after))
    failed = [change for change in changes if fail_over is not None and change.fails(fail_over)]
    if as_json:
        rows = [change.as_dict() for change in changes]
        options.print_json({"rows": rows, "only_in_old": gone, "only_in_new": added})
    else:
        print_table(changes, show_all)
        click.echo(
            f"{count_of(len(changes), 'row')} in both, {gone} only in the old, {added} only in "
            "the new"
        )
    if not changes:
        raise VoxtoolError(
            "the reports have no row in common: measure the same models and settings"
        )
    if failed:
        raise CheckError(
            f"{count_of(len(failed), 'row')} slower by more than {fail_over:g} % beyond the noise, "
            "or less accurate"
        )


def print_table(changes: list[Change], show_all: bool) -> None:
    """Print a line for each row that has changed, the slowest first."""
    changed = [c for c in changes if show_all or c.slower or c.faster or c.worse or c.better]
    for change in sorted(changed, key=lambda c: -c.percent):
        click.echo(line(change))
    if not changed:
        click.echo("nothing has changed beyond the noise")


def line(change: Change) -> str:
    from voxtool.bench.points import duration

    words = "slower" if change.slower else "faster" if change.faster else "same"
    name = ", ".join(printable(word) for word in change.key if word)
    text = (
        f"{words:<7}{change.percent:+8.1f} %  {duration(change.old.seconds):>9} -> "
        f"{duration(change.new.seconds):<9}  {name}"
    )
    for verdict, found in (("less accurate", change.worse), ("more accurate", change.better)):
        for measure, (was, now) in found.items():
            text += f"; {verdict}: {printable(measure)} {was:.3g} -> {now:.3g}"
    return text
