"""voxtool bench texts: what the texts that voxtool implements measured, beside its own figures."""

from __future__ import annotations

import click

from voxtool.cli import options
from voxtool.cli.options import flag, option
from voxtool.errors import printable


@click.command("texts")
@click.argument("models", nargs=-1, required=True)
@flag("--quick", "Few and small settings: under a minute a model.")
@option("--scalar", str, "As of `voxtool tet-build`.", metavar="NAME")
@options.device_option
@options.json_option
def command(
    models: tuple[str, ...], quick: bool, scalar: str | None, device_name: str | None, as_json: bool
) -> None:
    """Measure what the texts that voxtool implements did, beside their figures and statements.

    Of triangle meshes: tables 7.1 to 7.3 of [voCCeL], and what [ADF] says of its hash, its searches
    and its sizes. Of volume meshes: what [TetVol] says of its textures and its integration. Each
    row has its unit. Stages are on the device. Misprints are marked and not compared.

    \b
    Examples:
      voxtool bench texts bunny.obj volume.vtu --scalar density --quick
      voxtool bench texts bunny.obj --quick --json
    """
    from voxtool.bench.text_rows import HARDWARE, by_table
    from voxtool.bench.texts import rows_of
    from voxtool.opencl import shared_device

    device = shared_device(device_name).info.name
    rows = rows_of(models, device_name, quick, scalar)
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
