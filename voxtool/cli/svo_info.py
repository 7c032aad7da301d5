"""voxtool svo-info: what an octree holds."""

from __future__ import annotations

import os
from typing import Any

import click

from voxtool.cli import options


@click.command("svo-info")
@click.argument("file")
@click.option("--check", is_flag=True, help="Check every invariant.")
@click.option("--digest", is_flag=True, help="Print the SHA-256 of the content, and that alone.")
@options.json_option
def command(file: str, check: bool, digest: bool, as_json: bool) -> None:
    """Describe an octree FILE (.svo.h5, .svo.xml, or - for stdin).

    Lengths and volumes are in the mesh's own units. The digest covers the content, not the
    container: it is the same for HDF5 and XML, on every device.

    \b
    Examples:
      voxtool svo-info bunny.svo.h5 --check
      voxtool voxelize bunny.obj -o - | voxtool svo-info - --digest
    """
    from voxtool.files import read_svo

    octree = read_svo(file)
    if check:
        octree.validate()
    if digest and not as_json:
        click.echo(octree.digest())
        return
    info = octree.summary()
    if os.path.isfile(file):  # neither stdin nor a pipe
        info["file_bytes"] = os.path.getsize(file)
    if check:
        info["check"] = "ok"
    if digest:
        info["digest"] = octree.digest()
    if as_json:
        options.print_json(info)
    else:
        print_text(info)


def print_text(info: dict[str, Any]) -> None:
    shape, origin, pitch = (info[name] for name in ("shape", "origin", "pitch"))
    unit = f" {info['units']}" if info["units"] else ""
    size = " x ".join(map(str, shape))
    rows = [
        ("grid", f"{size} voxels (dim {info['dim']}, depth {info['depth']})"),
        ("mode", info["mode"] + ("" if info["fill"] == "none" else f", filled by {info['fill']}")),
        ("origin", f"{' '.join(f'{v:.9g}' for v in origin)}{unit}"),
        ("pitch", f"{' '.join(f'{v:.9g}' for v in pitch)}{unit}"),
        ("set voxels", f"{info['voxels']:,} ({100 * info['occupancy']:.3g} % of the grid)"),
        ("volume", f"{info['volume']:.9g}{unit and unit + '^3'}"),
        ("bricks", f"{info['bricks']:,}"),
        ("bytes", f"{info['bytes']:,} on the device ({info['bytes_with_x_pointers']:,} with "
         "x-pointers)" + (f", {info['file_bytes']:,} on disk" if "file_bytes" in info else "")),
        ("compression", f"{info['compression']:.1f} times smaller than a dense bit grid"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<12} {text}")
    click.echo(
        "\nlevel   side        nodes      refined       inside          set voxels   coverage"
    )
    for row in info["levels"]:
        click.echo(
            f"{row['level']:>5} {row['side']:>6} {row['nodes']:>12,} {row['refined']:>12,} "
            f"{row['inside']:>12,} {row['voxels']:>19,} {100 * row['coverage']:>8.2f} %"
        )
    if info["plan"].get("left_out"):
        click.echo("\nleft out")
        for what, why in info["plan"]["left_out"].items():
            click.echo(f"  {what}: {why}")
    for name in ("check", "digest"):
        if name in info:
            click.echo(f"\n{name}: {info[name]}")
