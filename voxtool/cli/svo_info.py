"""voxtool svo-info: what an octree holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.cli.info import describe, info_options, normalized, on_disk, place, table
from voxtool.cli.options import flag

if TYPE_CHECKING:
    from collections.abc import Iterator


def print_dtd(context: click.Context, _: click.Parameter, asked: bool) -> None:
    """Print the DTD and end the command, if that is asked for."""
    if asked:
        from voxtool.files.svo_xml import DTD

        click.echo(DTD.read_text(encoding="ascii"), nl=False)
        context.exit()


@click.command("svo-info")
@click.argument("file")
@info_options
@flag("--set-digest", "Print the SHA-256 of the set of voxels, however it was made.")
@click.option("--dtd", is_flag=True, is_eager=True, expose_value=False, callback=print_dtd,
    help="Print the DTD of the XML, octree.dtd, and that alone; no FILE is needed.")  # fmt: skip
def command(file: str, **asked: bool) -> None:
    """Describe an octree FILE (.svo.h5, .svo.xml, .voccel.xml, or - for stdin).

    Lengths and volumes are in the mesh's own units. The digest covers the content, not the
    container: it is the same for HDF5 and XML, on every device. The set digest is the same for
    equal sets of voxels of one grid, whatever their mode, fill and refinement. Of merged subtrees
    (voxtool svo-dag) all but the line "merged" is that of the octree that they stand for.

    \b
    Examples:
      voxtool svo-info bunny.svo.h5 --check
      voxtool voxelize bunny.obj -o - | voxtool svo-info - --digest
    """
    from voxtool.files import open_svo

    with open_svo(file) as octree:
        describe(file, octree, text_of, **asked)


def merged(info: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the line of a merged octree's subtrees, if it is one."""
    if "subtrees" in info:
        size, times = info["merged_bytes"], info["bytes"] / info["merged_bytes"]
        yield (
            "merged",
            f"{info['subtrees']:,} distinct subtrees in {size:,} bytes ({times:.1f} times fewer)",
        )


def text_of(info: dict[str, Any]) -> Iterator[str]:
    """The lines of a summary."""
    unit = f" {info['units']}" if info["units"] else ""
    size = " x ".join(map(str, info["shape"]))
    yield from table((
        ("grid", f"{size} voxels (dim {info['dim']}, depth {info['depth']})"),
        ("mode", info["mode"] + ("" if info["fill"] == "none" else f", filled by {info['fill']}")),
        ("origin", f"{place(info['origin'])}{unit}"),
        ("pitch", f"{place(info['pitch'])}{unit}"),
        *normalized(*info["transform"]),
        ("set voxels", f"{info['voxels']:,} ({100 * info['occupancy']:.3g} % of the grid)"),
        ("volume", f"{info['volume']:.9g}{unit and unit + '^3'}"),
        ("bricks", f"{info['bricks']:,}"),
        ("bytes", f"{info['bytes']:,} on the device ({info['bytes_with_x_pointers']:,} with "
         f"x-pointers){on_disk(info)}"),
        *merged(info),
        ("compression", f"{info['compression']:.1f} times smaller than a dense bit grid"),
    ))  # fmt: skip
    distinct = "     subtrees" if "subtrees" in info else ""
    yield (
        "\nlevel   side        nodes      refined       inside          set voxels   coverage"
        + distinct
    )
    for row in info["levels"]:
        yield (
            f"{row['level']:>5} {row['side']:>6} {row['nodes']:>12,} {row['refined']:>12,} "
            f"{row['inside']:>12,} {row['voxels']:>19,} {100 * row['coverage']:>8.2f} %"
            + (f" {row['subtrees']:>12,}" if distinct else "")
        )
