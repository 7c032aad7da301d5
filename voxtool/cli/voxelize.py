"""voxtool voxelize: mesh to octree."""

from __future__ import annotations

import time
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.mesh import Mesh
    from voxtool.plan import Plan


@click.command("voxelize")
@click.argument("mesh")
@options.output_options("FILE", "Default MESH's name with .svo.h5, in this folder.")
@click.option(
    "--mode",
    type=click.Choice(["surface26", "surface6", "solid"]),
    default="solid",
    show_default=True,
    help="surface26: every voxel that touches a triangle; surface6: "
    "the thinner 6-separating set; solid: every voxel whose centre is inside.",
)
@click.option(
    "--fill",
    type=click.Choice(["parity"]),
    default="parity",
    show_default=True,
    help="What is inside, for solid: an odd number of crossings along x.",
)
@click.option("--with-surface", is_flag=True, help="solid and surface26: thin walls survive.")
@click.option("--dim", type=int, help="Voxels along the longest side, 8 to 65536.  [default: 256]")
@click.option("--pitch", type=float, help="Voxel size in world units, instead of --dim.")
@click.option(
    "--bbox",
    type=float,
    nargs=6,
    metavar="X0 Y0 Z0 X1 Y1 Z1",
    help="The grid covers this box, in world units, not the mesh.",
)
@click.option("--like", metavar="FILE.svo.h5", help="The grid of another octree.")
@click.option(
    "--margin",
    type=int,
    help="Empty voxels on each side.  [default: min(4, dim // 8), 0 with --bbox]",
)
@click.option(
    "--fit",
    type=click.Choice(["uniform", "stretch"]),
    default="uniform",
    show_default=True,
    help="stretch: each axis apart, as eq. (5.1) of the thesis.",
)
@click.option(
    "--format",
    "file_format",
    type=click.Choice(["svo.h5", "svo.xml", "svo.xml.gz"]),
    help="File format, instead of what the name says.",
)
@click.option(
    "--plan",
    "only_plan",
    is_flag=True,
    help="Print what would be done, left out and needed, and stop.",
)
@click.option(
    "--max-memory",
    type=options.Bytes(),
    metavar="BYTES",
    help="Refuse to use more on the device (800M, 8G).  [default: what it has]",
)
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    mesh: str,
    output: str | None,
    no_clobber: bool,
    mode: str,
    fill: str,
    with_surface: bool,
    dim: int | None,
    pitch: float | None,
    bbox: tuple[float, ...] | None,
    like: str | None,
    margin: int | None,
    fit: str,
    file_format: str | None,
    only_plan: bool,
    max_memory: int | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Voxelize a triangle MESH exactly into a sparse voxel octree.

    MESH is an OBJ, STL, PLY, OFF or GLB file, .gz too, or - for stdin. Sizes are in the mesh's own
    units; a voxel (i, j, k) is the cube from origin + pitch (i, j, k).

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 --mode solid
      voxtool voxelize bunny.obj --pitch 0.01 --mode surface26 -o bunny.svo.xml
    """
    if like and (dim is not None or pitch is not None or bbox or margin is not None):
        raise click.UsageError("--like sets the grid: drop --dim, --pitch, --bbox and --margin")
    if with_surface and mode != "solid":
        raise click.UsageError(f"--with-surface goes with --mode solid: {mode} is a surface")
    started = time.perf_counter()
    from voxtool.files import check_target, read_svo, write_svo
    from voxtool.mesh import load_mesh
    from voxtool.opencl import open_device
    from voxtool.svo.voxelize import plan_voxelize, voxelize

    if output is None:
        output = default_output(mesh)
    if output != "-" and not only_plan:
        check_target(output, not no_clobber)
    loaded = load_mesh(mesh)
    grid = read_svo(like).grid if like else fit_grid(loaded, dim, pitch, bbox, margin, fit)
    chosen = open_device(device, profile=verbose)
    request: dict[str, Any] = {"fill": fill, "with_surface": with_surface, "device": chosen}
    if only_plan:
        print_plan(plan_voxelize(loaded, grid, mode, **request), grid, as_json)
        return
    if mode == "solid":
        warn_if_open(loaded, quiet)
    progress = options.Progress(chosen, [], quiet)
    octree = voxelize(loaded, grid, mode, max_memory=max_memory, **request)
    progress.finish()
    write_svo(octree, output, not no_clobber, file_format)

    seconds = time.perf_counter() - started
    result = {
        "output": output,
        "dim": grid.dim,
        "mode": octree.mode,
        "voxels": octree.count,
        "nodes": len(octree.nodes),
        "bricks": len(octree.bricks),
        "bytes": octree.nbytes,
        "seconds": round(seconds, 3),
    }
    if as_json and output != "-":
        options.print_json(result)
    else:
        options.tell(
            f"{mesh} -> {output}: {octree.mode}, dim {grid.dim}, pitch {grid.pitch[0]:.6g}; "
            f"{octree.count:,} voxels in {octree.nbytes / 1e6:,.1f} MB, {seconds:.2f} s",
            quiet,
        )
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")


def default_output(mesh: str) -> str:
    """bunny.obj.gz -> bunny.svo.h5, in the current folder; stdin -> stdout."""
    if mesh == "-":
        return "-"
    name = PurePath(mesh).name
    if name.lower().endswith(".gz"):
        name = name[:-3]
    return f"{PurePath(name).stem}.svo.h5"


def fit_grid(
    mesh: Mesh,
    dim: int | None,
    pitch: float | None,
    bbox: tuple[float, ...] | None,
    margin: int | None,
    fit: str,
) -> Grid:
    from voxtool.grid import Grid

    return Grid.fit(mesh, dim, pitch=pitch, bbox=bbox or None, margin=margin, fit=fit)


def warn_if_open(mesh: Mesh, quiet: bool) -> None:
    """Parity needs a closed mesh: say what is wrong with this one."""
    from voxtool.diagnosis import diagnose

    diagnosis = diagnose(mesh)
    if not diagnosis.even:
        options.tell(
            f"warning: {mesh.name or 'mesh'} is {diagnosis.summary()}; filled by parity, rows of "
            "voxels along x leak where they pass a gap",
            quiet,
        )


def print_plan(plan: Plan, grid: Grid, as_json: bool) -> None:
    """What will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(
            {**plan.as_dict(), "origin": list(grid.origin), "pitch": list(grid.pitch)}
        )
        return
    shape = " x ".join(map(str, plan.shape))
    rows = [
        ("grid", f"{shape} voxels of {grid.pitch[0]:.6g}, octree of {plan.levels} levels"),
        ("scene", f"{plan.survey.triangles:,} triangles, {plan.survey.outside:,} outside; the "
         f"largest spans {plan.survey.extent:.1f} voxels"),
        ("stages", ", ".join(plan.stages)),
        *(("left out", f"{what}: {why}") for what, why in plan.left_out().items()),
        ("predicted", f"{plan.bricks:,} bricks, {plan.nodes:,} nodes, "
         f"{plan.octree_bytes / 1e6:,.1f} MB; {plan.device_bytes / 1e6:,.1f} MB on the device"),
        ("work", f"about {plan.work:,} voxels and crossings visited"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<10} {text}")
