"""voxtool export: an octree's voxels for other programs."""

from __future__ import annotations

import click

from voxtool.cli.options import Parsed, format_option, option, output_options, plane_of, together

SLICE = Parsed(
    "slice", lambda text: plane_of(text, number_of), " is no plane of voxels: write z=128"
)


def number_of(text: str) -> int:
    if not text.isdecimal():
        raise ValueError
    return int(text)


@click.command("export")
@click.argument("file")
@together(
    output_options("OUT", "Its ending says the format: .npy, .npz, .vti or .png."),
    option("--slice plane", SLICE,
        "For .png: the plane of voxels to draw.  [default: the middle along z]",
        metavar="AXIS=VALUE"),
    format_option("npy", "npz", "vti", "png"),
)  # fmt: skip
def command(
    file: str, output: str | None, no_clobber: bool, plane: tuple[str, int] | None,
    file_format: str | None,
) -> None:  # fmt: skip
    """Export the set voxels of an octree FILE.

    .npy is the dense bool array [x, y, z]; .npz the coordinates of the set voxels, in voxels, with
    origin, pitch and shape; .vti cell data for ParaView; .png a slice. In the mesh's own units, the
    low corner of a voxel is origin + pitch * voxel.

    \b
    Examples:
      voxtool export bunny.svo.h5 -o bunny.vti
      voxtool export bunny.svo.h5 -o slice.png --slice z=100
    """
    from voxtool.files import EXPORTS, export, format_of, read_svo

    if output is None:
        raise click.UsageError("where to? Give -o OUT.npy, .npz, .vti or .png")
    chosen = file_format or format_of(output, EXPORTS)
    if plane and chosen != "png":
        raise click.UsageError(f"--slice goes with .png: .{chosen} holds all voxels")
    where = {"axis": plane[0], "value": plane[1]} if plane else {}
    export(read_svo(file), output, not no_clobber, chosen, **where)
