"""voxtool voxelize: mesh to octree."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

import click

from voxtool.choices import FILLS, FITS, MODES
from voxtool.cli import options

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.svo.plan import VoxelizePlan


@click.command("voxelize")
@click.argument("mesh")
@options.output_options("FILE", "Default MESH's name with .svo.h5, in this folder.")
@click.option(
    "--mode",
    type=click.Choice(MODES),
    default="solid",
    show_default=True,
    help="surface26: every voxel that touches a triangle; surface6: "
    "the thinner 6-separating set; solid: every voxel whose centre is inside.",
)
@click.option(
    "--fill",
    type=click.Choice(FILLS),
    default="auto",
    show_default=True,
    help="What is inside, for solid. parity: an odd number of crossings along x; nonzero: those "
    "that enter and leave do not cancel; winding: a winding number of 1/2 or more; flood: what the "
    "outside does not reach; auto: parity if the mesh is closed and consistently wound, or else "
    "winding.",
)
@click.option(
    "--gap",
    type=click.IntRange(0),
    default=0,
    metavar="VOXELS",
    help="With --fill flood: close openings of up to so many voxels.",
)
@click.option("--with-surface", is_flag=True, help="solid and surface26: thin walls survive.")
@click.option(
    "--dim", type=click.IntRange(8, 65536), help="Voxels along the longest side.  [default: 256]"
)
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
    type=click.IntRange(0),
    help="Empty voxels on each side.  [default: min(4, dim // 8), 0 with --bbox]",
)
@click.option(
    "--fit",
    type=click.Choice(FITS),
    default="uniform",
    show_default=True,
    help="stretch: each axis apart, as eq. (5.1) of the thesis.",
)
@options.format_option("svo.h5", "svo.xml", "svo.xml.gz")
@options.plan_options
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
    gap: int,
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
      voxtool voxelize open.obj --fill winding
      voxtool voxelize open.obj --fill flood --gap 3
    """
    placed = {"--dim": dim, "--pitch": pitch, "--bbox": bbox, "--margin": margin}
    check_usage([name for name, value in placed.items() if value is not None], like, fit)
    if with_surface and mode != "solid":
        raise click.UsageError(f"--with-surface goes with --mode solid: {mode} is a surface")
    if gap and (fill != "flood" or mode != "solid"):
        raise click.UsageError("--gap goes with --mode solid --fill flood")
    started = time.perf_counter()
    from voxtool.errors import human
    from voxtool.files import (
        SVO_FORMATS,
        TEXT_FORMATS,
        check_target,
        format_of,
        read_svo,
        write_svo,
    )
    from voxtool.files.mesh import load_mesh
    from voxtool.grid import Grid
    from voxtool.opencl import open_device
    from voxtool.svo.voxelize import plan_voxelize

    if output is None:
        output = options.output_of(mesh, "svo.h5")
    file_format = file_format or format_of(output, SVO_FORMATS)
    if not only_plan:
        if output != "-":
            check_target(output, not no_clobber)
        elif sys.stdout.isatty() and file_format not in TEXT_FORMATS:
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")
    with options.Progress(stages(mode, fill, with_surface)) as progress:
        progress.enter("read mesh")
        loaded = load_mesh(mesh)
        if like:
            grid = read_svo(like).grid
        else:
            grid = Grid.fit(loaded, dim, pitch=pitch, bbox=bbox, margin=margin, fit=fit)
        chosen = open_device(device, profile=verbose)
        if mode == "solid":
            progress.enter("check mesh")
        with chosen.reporting(progress.enter):
            job = plan_voxelize(
                loaded,
                grid,
                mode,
                fill=fill,
                gap=gap,
                with_surface=with_surface,
                device=chosen,
                max_memory=max_memory,
            )
        if only_plan:
            progress.erase()
            print_plan(job.plan, grid, as_json)
            options.warn_if_refused(job.plan, max_memory, chosen)
            return
        octree = job.run(progress.enter)
        for note in job.notes(octree):
            options.tell(note)
        progress.enter("write file")
        write_svo(octree, output, not no_clobber, file_format)

    seconds = time.perf_counter() - started
    if as_json:
        result = {
            "output": output,
            "dim": grid.dim,
            "mode": octree.mode,
            "fill": octree.fill,
            "voxels": octree.count,
            "nodes": len(octree.nodes),
            "bricks": len(octree.bricks),
            "bytes": octree.nbytes,
            "seconds": round(seconds, 3),
        }
        if output != "-" or not quiet:
            options.print_json(result, err=output == "-")
    else:
        source, target = mesh if mesh != "-" else "stdin", output if output != "-" else "stdout"
        filled = "" if octree.fill == "none" else f" by {octree.fill}"
        options.tell(
            f"{source} -> {target}: {octree.mode}{filled}, dim {grid.dim}, pitch {pitch_of(grid)}; "
            f"{octree.count:,} voxels in {human(octree.nbytes)}, {seconds:.2f} s"
        )
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")


def check_usage(placed: list[str], like: str | None, fit: str) -> None:
    """Refuse options that place the grid in two ways; `placed` names those that are given."""
    names = " and ".join(placed)
    if like and (placed or fit != "uniform"):
        raise click.UsageError(f"--like sets the grid: drop {names or '--fit'}")
    if {"--dim", "--pitch"} <= set(placed):
        raise click.UsageError("--dim and --pitch both set the voxel size: drop one of them")
    if fit == "stretch" and placed not in ([], ["--dim"]):
        raise click.UsageError(
            "--fit stretch goes with --dim alone: drop --pitch, --bbox, --margin"
        )


def stages(mode: str, fill: str, with_surface: bool) -> list[str]:
    """What the progress bar counts: the plan's stages, and what comes before and after."""
    solid, flood = mode == "solid", mode == "solid" and fill == "flood"
    holes = solid and fill in ("auto", "winding")
    surface = "surface26" if with_surface or flood else "" if solid else mode
    return [
        "read mesh",
        *(["check mesh"] if solid else []),
        "survey",
        *(["holes"] if holes else []),
        "active nodes",
        "octree",
        *(["crossings", "rows", "fill"] if solid and not flood else []),
        *(["near holes"] if holes else []),
        *([surface] if surface else []),
        "flood" if flood else "read back",
        "write file",
    ]


def pitch_of(grid: Grid) -> str:
    """0.01, or where the axes differ 0.01 x 0.02 x 0.03."""
    sizes = [f"{p:.6g}" for p in grid.pitch]
    return sizes[0] if len(set(grid.pitch)) == 1 else " x ".join(sizes)


def print_plan(plan: VoxelizePlan, grid: Grid, as_json: bool) -> None:
    """What will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(
            {**plan.as_dict(), "origin": list(grid.origin), "pitch": list(grid.pitch)}
        )
        return
    from voxtool.errors import human

    shape = " x ".join(map(str, plan.shape))
    rows = [
        ("grid", f"{shape} voxels of {pitch_of(grid)}, octree of {plan.levels} levels"),
        ("scene", f"{plan.survey.triangles - plan.caps:,} triangles, {plan.survey.outside:,} "
         f"outside; the largest spans {plan.survey.extent:.1f} voxels"),
        *([("fill", fill_of(plan))] if plan.solid else []),
        ("stages", ", ".join(plan.stages)),
        *(("left out", f"{what}: {why}") for what, why in plan.left_out.items()),
        ("predicted", f"{plan.bricks:,} bricks, {plan.nodes:,} nodes, "
         f"{human(plan.octree_bytes)}; {human(plan.device_bytes)} on the device"),
        ("work", f"about {plan.work:,} voxels and crossings visited"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<10} {text}")


def fill_of(plan: VoxelizePlan) -> str:
    """The rule that tells inside from outside, and what it makes of holes."""
    from voxtool.errors import count_of

    if plan.fill != "winding":
        return plan.rule
    return f"winding; {count_of(plan.holes, 'hole')}, {count_of(plan.caps, 'cap triangle')}"
