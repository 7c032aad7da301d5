"""voxtool bench texts: what the texts that voxtool implements measured, beside its own figures."""

from __future__ import annotations

import shlex
import sys

import click

from voxtool.cli import options
from voxtool.cli.options import flag, option
from voxtool.errors import printable


@click.command("texts")
@click.argument("models", nargs=-1, required=True)
@flag("--quick", "Few and small settings: under a minute a model.")
@option("--scalar", str, "As of `voxtool tet-build`.", metavar="NAME")
@option("-o --output", str, "Write a report: report.html and .json.", metavar="FOLDER")
@options.clobber_option
@options.device_option
@options.json_option
def command(
    models: tuple[str, ...], quick: bool, scalar: str | None, output: str | None,
    no_clobber: bool, device_name: str | None, as_json: bool,
) -> None:  # fmt: skip
    """Measure what the texts that voxtool implements did, beside their figures and statements.

    Of triangle meshes: tables 7.1 to 7.3 of [voCCeL], and what [ADF] says of its hash, its searches
    and its sizes. Of volume meshes: what [TetVol] says of its textures and its integration. Each
    row has its unit, ms for times. Stages are on the device. Misprints are marked and not compared.

    \b
    Examples:
      voxtool bench texts bunny.obj volume.vtu --scalar density --quick
      voxtool bench texts bunny.obj --quick -o report
    """
    from voxtool.bench.report import check_folder
    from voxtool.bench.text_report import as_dict, write_text_report
    from voxtool.bench.text_rows import HARDWARE, by_table
    from voxtool.bench.texts import rows_of
    from voxtool.opencl import shared_device

    if output is not None:
        check_folder(output, not no_clobber)
    device = shared_device(device_name).info
    rows = rows_of(models, device_name, quick, scalar)
    words = shlex.join(["voxtool", *map(printable, sys.argv[1:])])
    if output is not None:
        write_text_report(rows, device, words, output, not no_clobber)
    if as_json:
        options.print_json(as_dict(rows, device, words))
        return
    click.echo(f"voxtool: {device.name}")
    for (table, model), some in by_table(rows).items():
        click.echo(f"\n{table}, {printable(model)}; text: {HARDWARE[some[0].key]}")
        for row in some:
            what, setting, text, ours, said, words, note = row.cells()
            end = f"; {note}" if note else ""
            click.echo(f"  {what}, {setting}: {said}: {text}; voxtool: {ours} ({words}){end}")
    if output is not None:
        click.echo(f"report: {printable(output.rstrip('/'))}/report.html")
