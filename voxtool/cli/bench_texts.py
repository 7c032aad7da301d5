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
@flag("--quick", "Few dims and levels: under a minute a model.")
@option("--scalar", str, "As in `voxtool tet-build`.", metavar="NAME")
@option("-o --output", str, "Write a report: report.html and .json.", metavar="FOLDER")
@options.clobber_option
@options.device_option
@options.quiet_option
@options.json_option
def command(
    models: tuple[str, ...], quick: bool, scalar: str | None, output: str | None,
    no_clobber: bool, device_name: str | None, quiet: bool, as_json: bool,
) -> None:  # fmt: skip
    """Repeat the experiments of the texts that voxtool implements, with their figures beside.

    Triangle meshes serve for the tables, figures and methods of [voCCeL], and for the hash,
    searches and sizes of [ADF]; volume meshes for the textures and the integration of [TetVol].
    Units stand beside what is measured, ms for times. Misprints are marked and not compared.
    docs/references.md names the texts.

    \b
    Examples:
      voxtool bench texts bunny.obj volume.vtu --scalar density --quick
      voxtool bench texts bunny.obj --quick -o report
    """
    from voxtool.bench.report import check_folder
    from voxtool.bench.text_layout import as_text, sections
    from voxtool.bench.text_report import as_dict, write_text_report
    from voxtool.bench.texts import rows_of, steps_of
    from voxtool.opencl import shared_device
    from voxtool.version import __version__

    if output is not None:
        check_folder(output, not no_clobber)
    device = shared_device(device_name).info
    with options.Progress(steps_of(models)) as progress:
        rows = rows_of(models, device_name, quick, scalar, progress.enter)
    words = shlex.join(["voxtool", *map(printable, sys.argv[1:])])
    if output is not None:
        write_text_report(rows, device, words, output, not no_clobber)
    if as_json:
        options.print_json(as_dict(rows, device, words))
        return
    click.echo(f"voxtool {__version__} on {device.name}")
    for line in as_text(sections(rows), dict.fromkeys(row.key for row in rows)):
        click.echo(printable(line))
    if output is not None:
        click.echo(f"report: {printable(output.rstrip('/'))}/report.html")
