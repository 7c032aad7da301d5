"""voxtool export: an octree's voxels for other programs."""

from __future__ import annotations

import click

from voxtool.cli import options


class Slice(click.ParamType):
    """AXIS=VALUE: a plane of voxels."""

    name = "slice"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        if isinstance(value, tuple):
            return value
        axis, _, index = str(value).partition("=")
        if axis not in ("x", "y", "z") or not index.isdecimal():
            self.fail(f"{value!r} is no plane of voxels: write z=128", param, ctx)
        return axis, int(index)


@click.command("export")
@click.argument("file")
@options.output_options("OUT", "Its ending says the format: .npy, .npz, .vti or .png.")
@click.option(
    "--slice",
    "plane",
    type=Slice(),
    metavar="AXIS=VALUE",
    help="For .png: the plane of voxels to draw.  [default: the middle along z]",
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["npy", "npz", "vti", "png"]),
    help="File format, instead of what the name says.",
)
def command(
    file: str,
    output: str | None,
    no_clobber: bool,
    plane: tuple[str, int] | None,
    file_format: str | None,
) -> None:
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
