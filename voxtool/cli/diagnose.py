"""voxtool diagnose: what is wrong with a mesh, where, and what to do about it."""

from __future__ import annotations

import os

import click

from voxtool.cli import options
from voxtool.errors import CheckError, count_of

TUBE = 2e-3  # radius of a tube about a loop, of the mesh's longest side


@click.command("diagnose")
@click.argument("mesh")
@click.option(
    "--dim",
    type=click.IntRange(8, 65536),
    default=256,
    show_default=True,
    help="Voxels along the longest side, for the rows that leak and the fill rules.",
)
@click.option(
    "--obj",
    metavar="FILE.obj",
    help="Write the boundary loops as thin tubes, a mesh that any viewer shows.",
)
@click.option("--no-clobber", is_flag=True, help="Refuse to replace an existing file.")
@click.option("--strict", is_flag=True, help="Exit 1 if something is wrong.")
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    mesh: str,
    dim: int,
    obj: str | None,
    no_clobber: bool,
    strict: bool,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Report what is wrong with a triangle MESH, where, and what to do about it.

    MESH is an OBJ, STL, PLY, OFF or GLB file, .gz too, or - for stdin. Lengths and places are in
    the mesh's own units; sizes also in voxels of a grid of --dim, on which the fill rules of
    voxelize are compared. Vertices at one position are one; faces are counted from 0.

    \b
    Examples:
      voxtool diagnose open.obj
      voxtool diagnose open.obj --obj leaks.obj
      voxtool diagnose bunny.obj --json --strict
    """
    from voxtool.files import check_target, format_of, write_mesh
    from voxtool.files.mesh import load_mesh
    from voxtool.grid import Grid
    from voxtool.mesh.loops import tubes
    from voxtool.opencl import open_device
    from voxtool.report import STAGES, diagnose

    if obj is not None:
        if obj == "-":
            raise click.UsageError("stdout has the report: name a file for --obj")
        format_of(obj, ("obj",))
        check_target(obj, not no_clobber)
        if os.path.exists(obj) and os.path.exists(mesh) and os.path.samefile(mesh, obj):
            raise click.UsageError(f"{obj} is MESH itself: name another file")
    with options.Progress(["read mesh", *STAGES]) as bar:
        bar.enter("read mesh")
        loaded = load_mesh(mesh)
        chosen = open_device(device, profile=verbose)
        grid = Grid.fit(loaded, dim)
        report = diagnose(loaded, grid, device=chosen, progress=bar.enter)
        loops = report.boundary
        if obj is not None:
            low, high = loaded.bounds
            drawn = tubes(loaded.vertices[loops.edges], TUBE * float((high - low).max()))
            write_mesh(drawn, obj, not no_clobber, "obj")
    if as_json:
        options.print_json(report.as_dict())
    else:
        click.echo(report.text())
    if obj is not None:
        what = count_of(len(loops.closed), "boundary loop")
        options.tell(f"{mesh if mesh != '-' else 'stdin'} -> {obj}: {what} as tubes")
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")
    if strict and report.faults:
        faults = "; ".join(fault.what for fault in report.faults)
        raise CheckError(f"{loaded.name or 'mesh'}: {faults} (--strict)")
