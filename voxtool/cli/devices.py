"""voxtool devices: what can compute here."""

from __future__ import annotations

import sys

import click

from voxtool.cli import options


@click.command("devices")
@options.json_option
def command(as_json: bool) -> None:
    """List every OpenCL device, and whether the probe kernel ran on it.

    Memory is in GB. The first device whose probe is ok is used; --device and $VOXTOOL_DEVICE choose
    another.

    \b
    Examples:
      voxtool devices
      voxtool voxelize bunny.obj --device pocl
    """
    from voxtool.opencl import list_devices
    from voxtool.opencl.device import INSTALL_HINT

    found = list_devices()
    if as_json:
        options.print_json([d.as_dict() for d in found])
    for d in found if not as_json else ():
        click.echo(f"{d.index}  {d.name} ({d.platform}, {d.kind})")
        click.echo(
            f"   driver {d.driver}; {d.opencl}; {d.units} units; {d.memory / 1e9:.1f} GB, largest "
            f"buffer {d.max_allocation / 1e9:.1f} GB; probe {d.probe}"
        )
    if not any(d.probe == "ok" for d in found):
        options.tell(f"error: no usable OpenCL device: {INSTALL_HINT}")
        sys.exit(1)
