"""voxtool devices: what can compute here."""

from __future__ import annotations

import click

from voxtool.cli import options


@click.command("devices")
@options.json_option
def command(as_json: bool) -> None:
    """List every OpenCL device, and whether the probe kernel ran on it.

    Memory is in GB. The first device whose probe is ok is used, GPUs first; --device and
    $VOXTOOL_DEVICE choose another, by its number, its kind or a part of its name.

    \b
    Examples:
      voxtool devices --json
      voxtool voxelize bunny.obj --device cpu
    """
    from voxtool.opencl import list_devices
    from voxtool.opencl.device import WITHOUT_FLOAT64
    from voxtool.opencl.discovery import no_usable_device

    found = list_devices()
    if as_json:
        options.print_json([d.as_dict() for d in found])
    for d in found if not as_json else ():
        click.echo(f"{d.index}  {d.name} ({d.platform}, {d.kind})")
        click.echo(
            f"   driver {d.driver}; {d.opencl}; {d.units} units; {d.memory / 1e9:.1f} GB, largest "
            f"buffer {d.max_allocation / 1e9:.1f} GB; probe {d.probe}"
        )
        if not d.fp64:
            click.echo(f"   no double precision: it does {WITHOUT_FLOAT64}")
    if not any(d.probe == "ok" for d in found):
        raise no_usable_device([f"{d.name} ({d.platform}), probe {d.probe}" for d in found])
