"""voxtool extract: octree to triangle mesh."""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import MARCHING_CUBES, STYLE_ALIASES, STYLES, VOXEL_FACES
from voxtool.cli import options
from voxtool.errors import CheckError, MeshWarning, VoxtoolError

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree
    from voxtool.svo.surface.isosurface import Isosurface
    from voxtool.svo.surface.plan import ExtractionPlan


class Level(click.ParamType):
    """A level of the octree, or voxel."""

    name = "level"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | str:
        if value == "voxel":
            return value
        try:
            return int(value)
        except ValueError:
            self.fail(f"{value!r}: choose voxel, or a level, from 0 (bricks) on", param, ctx)


@click.command("extract")
@click.argument("octree")
@options.output_options(
    "FILE", "Default OCTREE's name with the style, and .obj or --format, in this folder."
)
@click.option(
    "--style",
    type=options.Alias(STYLES, STYLE_ALIASES),
    default=MARCHING_CUBES,
    show_default=True,
    help="marching-cubes: smooth, from the shares of set voxels of bricks; voxel-faces: the exact "
    "boundary of the voxels; surface-nets: smooth at full resolution, every vertex kept in its "
    "cell.  Coarse samples round off more.",
)
@click.option(
    "--level",
    type=Level(),
    metavar="N|voxel",
    help="What a sample is: a node of level N (0: a brick of 4 x 4 x 4 voxels; higher: coarser), "
    "or a voxel.  [default: 0 for marching-cubes, else voxel]",
)
@click.option(
    "--isovalue",
    type=float,
    default=0.5,
    show_default=True,
    help="Share of its voxels, between 0 and 1, from which on a sample is inside.",
)
@click.option(
    "--merge",
    is_flag=True,
    help="voxel-faces: join coplanar squares (greedy meshing); leaves T-junctions.",
)
@click.option("--normals", is_flag=True, help="Write vertex normals, too (.obj, .ply, .glb).")
@click.option(
    "--check",
    is_flag=True,
    help="Print as JSON whether the mesh is closed and manifold, its genus, shells and volume; "
    "exit 1 if it is not closed.",
)
@click.option(
    "--against",
    metavar="MESH",
    help="Print as JSON how far the surface and this mesh are from each other, both ways; the "
    "memory that it takes does not count for --max-memory.",
)
@click.option(
    "--samples",
    type=click.IntRange(1, 100_000_000),
    help=f"Points on each surface that --against measures at.  [default: {options.SAMPLES}]",
)
@options.format_option("obj", "ply", "stl", "glb", "off")
@options.plan_options
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    octree: str,
    output: str | None,
    no_clobber: bool,
    style: str,
    level: int | str | None,
    isovalue: float,
    merge: bool,
    normals: bool,
    check: bool,
    against: str | None,
    samples: int | None,
    file_format: str | None,
    only_plan: bool,
    max_memory: int | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Extract a closed triangle mesh from an OCTREE, visiting only the cubes that matter.

    OCTREE is a file that voxelize wrote, or - for stdin. The mesh is in world units, where the
    voxels lie; write it as .obj, .ply, .stl, .glb or .off. Distances of --against are in world
    units and in voxels.

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 -o - | voxtool extract - -o smooth.obj
      voxtool extract bunny.svo.h5 --style surface-nets --check --against bunny.obj
    """
    if merge and style != VOXEL_FACES:
        raise click.UsageError(f"--merge goes with --style {VOXEL_FACES}: {style} has no squares")
    if samples is not None and against is None:
        raise click.UsageError("--samples goes with --against MESH: there is nothing to measure")
    if octree == against == "-":
        raise click.UsageError("OCTREE and --against cannot both be stdin: name a file for one")
    started = time.perf_counter()
    from voxtool.files import (
        MESH_FORMATS,
        NORMAL_FORMATS,
        TEXT_FORMATS,
        check_target,
        format_of,
        read_svo,
        write_mesh,
    )
    from voxtool.files.mesh import load_mesh
    from voxtool.opencl import open_device
    from voxtool.svo.surface.extract import plan_extract

    if output is None:
        output = default_output(octree, style, file_format or "obj")
    file_format = file_format or format_of(output, MESH_FORMATS)
    if normals and file_format not in NORMAL_FORMATS:
        held = ", ".join(f".{name}" for name in NORMAL_FORMATS)
        raise click.UsageError(f"--normals: .{file_format} holds none: write one of {held}")
    if not only_plan:
        if output != "-":
            check_target(output, not no_clobber)
        elif sys.stdout.isatty() and file_format not in TEXT_FORMATS:
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")
    request: dict[str, Any] = {"style": style, "level": level, "isovalue": isovalue, "merge": merge}
    with options.Progress(["read octree"]) as progress:
        progress.enter("read octree")
        source = read_svo(octree)
        reference = load_mesh(against) if against is not None else None
        chosen = open_device(device, profile=verbose)
        try:
            job = plan_extract(source, device=chosen, max_memory=max_memory, **request)
        except VoxtoolError as error:
            raise type(error)(f"{octree}: {error}") from error
        progress.stages = ["read octree", *job.stages, "write file"]
        if only_plan:
            progress.erase()
            print_plan(job.plan, as_json)
            options.warn_if_refused(job.plan, max_memory, chosen)
            return
        with warnings.catch_warnings(action="ignore", category=MeshWarning):
            surface = job.run(progress.enter)
        findings = list(job.findings(surface))
        if not len(surface.faces):
            raise VoxtoolError(f"{octree}: {findings[0]}")
        checked, measured = {}, {}
        if check:
            progress.enter("check")
            checked = {"check": check_mesh(source, surface)}
        if reference is not None:
            progress.enter("measure")
            measured = {"against": measure(surface, reference, samples or options.SAMPLES, chosen)}
        progress.enter("write file")
        vertex_normals = surface.normals if normals else None
        write_mesh(surface.mesh(), output, not no_clobber, file_format, normals=vertex_normals)
    seconds = time.perf_counter() - started
    result = {**summary(source, surface, output, seconds), **checked, **measured}
    if as_json or check or reference is not None:
        options.print_json(result, err=output == "-")
    if not as_json:
        target = output if output != "-" else "stdout"
        options.tell(
            f"{octree if octree != '-' else 'stdin'} -> {target}: {style}, level {surface.level}, "
            f"isovalue {isovalue:g}; {len(surface.points):,} vertices, {len(surface.faces):,} "
            f"triangles, {seconds:.2f} s"
        )
    for finding in findings:
        options.tell(f"warning: {finding}")
    if (losses := job.losses(surface)) and not findings:
        options.tell(losses)
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
        for stage, time_on_device in chosen.stage_times().items():
            options.tell(f"  {stage:<18} {1e3 * time_on_device:9.2f} ms")
    if check and not result["check"]["closed"]:
        raise CheckError(f"{output}: what was written is not closed: report this octree")


def default_output(octree: str, style: str, file_format: str) -> str:
    """bunny.svo.h5 -> bunny.marching-cubes.obj, in the current folder, never the mesh that it was
    made from; stdin -> stdout."""
    if octree == "-":
        return "-"
    name = PurePath(octree).name
    for extension in (".gz", ".h5", ".xml", ".svo"):
        name = name.removesuffix(extension)
    return f"{name}.{style}.{file_format}"


def summary(octree: Octree, surface: Isosurface, output: str, seconds: float) -> dict[str, Any]:
    """What was made, in JSON types."""
    return {
        "output": output,
        "dim": octree.grid.dim,
        "style": surface.style,
        "level": surface.level,
        "isovalue": surface.isovalue,
        "vertices": len(surface.points),
        "triangles": len(surface.faces),
        "cubes_cut": surface.cubes,
        "voxels": octree.count,
        "voxels_below_isovalue": surface.lost.below,
        "voxels_vanished": surface.lost.vanished,
        "digest": surface.digest(),
        "seconds": round(seconds, 3),
    }


def check_mesh(octree: Octree, surface: Isosurface) -> dict[str, Any]:
    """Whether the surface is closed, what it is, and its volume against the octree's."""
    from voxtool.mesh.topology import check_surface, closed_chain, volume

    mesh = surface.mesh()
    enclosed, set_volume = volume(mesh), octree.count * octree.grid.voxel_volume
    if surface.merged:  # edges end within others: what counts edges says nothing
        found = {"closed": closed_chain(mesh), "t_junctions": True}
    else:
        checked = check_surface(mesh, weld=False)
        found = {**checked.as_dict(), "closed": checked.watertight and checked.manifold}
    return {
        **found,
        "volume": enclosed,
        "octree_volume": set_volume,
        "volume_ratio": enclosed / set_volume,
    }


def measure(surface: Isosurface, reference: Mesh, samples: int, device: Device) -> dict[str, Any]:
    """The deviation between the surface and a mesh."""
    from voxtool.spatial.deviation import deviation

    pitch = max(surface.grid.pitch)
    return deviation(surface.mesh(), reference, samples, pitch=pitch, device=device)


def print_plan(plan: ExtractionPlan, as_json: bool) -> None:
    """What will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(plan.as_dict())
        return
    from voxtool.errors import human

    rows = [
        *plan.rows(),
        ("stages", ", ".join(plan.stages)),
        *(("left out", f"{what}: {why}") for what, why in plan.left_out.items()),
        ("predicted", f"{human(plan.cost.device)} on the device"),
    ]
    for name, text in rows:
        click.echo(f"{name:<10} {text}")
