"""voxtool bench texts: what the texts that voxtool implements measured, beside its own figures."""

from __future__ import annotations

import click

from voxtool.cli import options
from voxtool.cli.options import flag
from voxtool.errors import printable


@click.command("texts")
@click.argument("models", nargs=-1, required=True)
@flag("--quick", "Few and small settings: under a minute a model.")
@options.device_option
@options.json_option
def command(models: tuple[str, ...], quick: bool, device_name: str | None, as_json: bool) -> None:
    """Measure what the texts that voxtool implements did: tables 7.1 to 7.3 of [voCCeL].

    Stages are ms on the device, totals ms of a call, sizes kB, cubes percent of the grid. The
    model of the text is that of the same name, or else the nearest by triangles. Misprints are
    marked and not to be compared.

    \b
    Examples:
      voxtool bench texts bunny.obj --quick
      voxtool bench texts bunny.obj --quick --json
    """
    from voxtool.bench.text_rows import HARDWARE, by_table
    from voxtool.bench.texts import rows_of
    from voxtool.opencl import shared_device

    device = shared_device(device_name).info.name
    rows = list(rows_of(models, device_name, quick))
    if as_json:
        options.print_json({"device": device, "rows": [row.as_dict() for row in rows]})
        return
    click.echo(f"voxtool: {device}")
    for (table, model), some in by_table(rows).items():
        click.echo(f"\n{table}, {printable(model)}; text: {HARDWARE[some[0].key]}")
        for row in some:
            what, setting, text, ours, said, words, note = row.cells()
            end = f"; {note}" if note else ""
            click.echo(f"  {what}, {setting}: {said}: {text}; voxtool: {ours} ({words}){end}")
