"""voxtool bench texts: tables of the texts that voxtool implements, beside its own figures."""

from __future__ import annotations

import click

from voxtool.bench.voccel_tables import DIMS, HARDWARE
from voxtool.cli import options
from voxtool.cli.options import flag
from voxtool.errors import printable


@click.command("texts")
@click.argument("models", nargs=-1, required=True)
@flag("--quick", "Only dims 64 and 128.")
@options.device_option
@options.json_option
def command(models: tuple[str, ...], quick: bool, device_name: str | None, as_json: bool) -> None:
    """Measure what tables 7.1 to 7.3 of [voCCeL] do: total times, sizes and cubes visited.

    Times are in ms, sizes in kB, cubes in percent of the grid. Its model is that of the same
    name, or else the nearest by triangles; without --quick, dims are 64 to 2048.

    \b
    Examples:
      voxtool bench texts bunny.obj --quick
      voxtool bench texts bunny.obj --quick --json
    """
    from voxtool.bench.texts import rows_of
    from voxtool.opencl import shared_device

    device = shared_device(device_name)
    dims = DIMS[:2] if quick else DIMS
    rows = [row for model in models for row in rows_of(model, dims, device)]
    if as_json:
        options.print_json({"hardware": HARDWARE, "device": device.info.name, "rows": rows})
        return
    click.echo(f"text: {HARDWARE}; voxtool: {device.info.name}")
    for row in rows:
        who = f"{printable(row['model'])} ({row['triangles']:,} triangles)"
        other = f"{row['text_model']} ({row['text_triangles']:,})"
        what = f"table {row['table']}, {row['what']}, dim {row['dim']}"
        unit, note = row["unit"], row["note"] or ""
        end = f"{unit}; {note}" if note else unit
        click.echo(f"{what}: {other} {row['text']:g}, {who} {row['voxtool']:.4g} {end}")
