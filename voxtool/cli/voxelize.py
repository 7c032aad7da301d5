"""voxtool voxelize: mesh to octree."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import (
    ATTRIBUTES,
    COLOURS,
    DEFAULT_DIM,
    DEFAULT_MODE,
    FILLS,
    FITS,
    FRACTION,
    FRACTION_TYPES,
    LABELS,
    MODES,
    PRIORITIES,
)
from voxtool.cli import options, runner
from voxtool.cli.in_windows import make_in_windows, refuse_stdout, windows_options
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import DIM, flag, option, together
from voxtool.cli.placing import check_placing, lattice_options, placed
from voxtool.errors import MemoryLimitError, OnePieceError
from voxtool.files.formats import EXPORTS, MERGED_FORMATS, OCTREE_FORMATS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from voxtool.grid import Grid
    from voxtool.svo.dag.merged import MergedOctree
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.voxelization.voxelize import VoxelizeJob
    from voxtool.tiles.octree import BlockOctree
    from voxtool.tiles.windows import WindowsJob


@click.command("voxelize")
@mesh_argument("", "svo.h5", divides=True)
@together(
    option("--mode", (*MODES, FRACTION),
        "surface26: every voxel that touches a triangle; surface6: the thinner 6-separating set; "
        "solid: every voxel whose centre is inside; fraction: every voxel of which a part is "
        "inside, and how much of it.", DEFAULT_MODE),
    option("--fraction-type", FRACTION_TYPES,
        "With --mode fraction: store float32, or whole numbers of 16 or 8 bits.  "
        f"[default: {FRACTION_TYPES[0]}]"),
    flag("--face-fractions",
        "With --mode fraction: also how much of each face of a voxel is inside (finite volumes)."),
    option("--fill", FILLS,
        "What is inside, for solid and fraction. parity: an odd number of crossings along x; "
        "nonzero: crossings that enter and leave do not cancel; winding: a winding number of 1/2 "
        "or more; flood: everything that the outside cannot reach; auto: parity if the mesh is "
        "closed, the union of its parts if they overlap, winding if it is consistent but open, "
        "otherwise the rule that keeps its outer surface.", FILLS[0]),
    option("--gap", click.IntRange(0),
        "With --fill flood: close openings of up to this many voxels first.", 0, metavar="VOXELS",
        show_default=False),
    flag("--with-surface", "Add surface26 to solid, so that thin walls survive."),
    flag("--connected", "With --mode solid: keep each part of the mesh that is thinner than two "
        "voxels, such as a vessel, a wire or a wall, in one piece, by few voxels that touch it."),
    option("--dim", DIM, f"Voxels along the longest side.  [default: {DEFAULT_DIM}]"),
    option("--pitch", float, "Voxel size in world units, instead of --dim."),
    lattice_options,
    option("--margin", click.IntRange(0),
        "Empty voxels on each side.  [default: min(4, dim // 8), 0 with --bbox]"),
    option("--fit", FITS,
        "uniform: one pitch for all axes; stretch: each axis scaled apart, as eq. (5.1) of "
        "[voCCeL].", FITS[0]),
    options.length_options(),
    flag("--dag", "Store equal subtrees once (SVO 2.0): a tenth of the bytes, for large octrees. "
        "All commands read it."),
    flag("--thin", "With a surface mode: leave out voxels without which the surface still "
        "separates (N-minimal).  A surface with holes larger than a voxel separates nothing."),
    option("--labels", LABELS,
        "Label each voxel with its part of the mesh (SVO 3.0): a group, material or object that "
        "the file names, a shell, or of several meshes the file.  They become one octree, which -o "
        "names."),
    option("--priority", str,
        "With --labels: which part a voxel has that several parts of a solid share, or have equal "
        "shares of with --mode fraction: the first, the last, or those named here, in this order, "
        "before the others.  [default: first]",
        metavar="first|last|NAME,..."),
    option("--attributes", options.List(click.Choice(ATTRIBUTES)),
        f"Attributes of the voxels of the surface: {', '.join(ATTRIBUTES)} (SVO 3.0).  Colours "
        "are those of the mesh's materials, textures and vertices.  Exposed voxels of solids that "
        "no triangle touches have the colour and the normal of the nearest point of the surface.",
        metavar="NAME,..."),
    option("--colour", COLOURS,
        "With --attributes colour: the mean by area, in linear light, or that of the greatest part "
        f"of the surface in the voxel, as it is.  [default: {COLOURS[0]}]"),
    flag("--doctype", "For .svo.xml and .voccel.xml: name octree.dtd (svo-info --dtd prints it)."),
    windows_options,
    options.normalize_option("stored"),
)  # fmt: skip
@runner.job_options(
    "FILE",
    "Its ending says the format, of an octree or of an export (voxtool export -h).  Default MESH's "
    "name with .svo.h5, in this folder.",
    *OCTREE_FORMATS, *EXPORTS,
)  # fmt: skip
def command(
    run: runner.Run, mesh: str, mode: str, fraction_type: str | None,
    face_fractions: bool, fill: str, gap: int, with_surface: bool, connected: bool,
    normalize: str | None, units: str | None, scale: float, windows: str,
    dag: bool, thin: bool, labels: str | None, priority: str | None, attributes: list[str] | None,
    colour: str | None, doctype: bool, resume: bool, no_keep: bool, dask: str | None = None,
    workers: int | None = None, others: tuple[str, ...] = (), **placing: Any,
) -> None:  # fmt: skip
    """Voxelize a triangle MESH directly into a sparse voxel octree.

    MESH is an OBJ, STL, PLY, OFF, GLB or 3MF file, .gz too, or - for stdin. With many, -o names
    the folder of their outputs (docs/many.md). Sizes are in the mesh's own units, once scaled; a
    voxel (i, j, k) is the cube from origin + pitch (i, j, k).

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 --mode solid
      voxtool voxelize bunny.obj --pitch 0.01 --mode surface26 -o bunny.svo.xml
      voxtool voxelize bunny.obj --mode fraction --fraction-type u2
      voxtool voxelize open.obj --fill winding
      voxtool voxelize parts.glb --mode surface26 --attributes colour,normal
      voxtool voxelize bunny.obj open.obj -o octrees/ --dim 64
      voxtool voxelize bunny.obj --dim 1024 --dag -o small.svo.h5
      voxtool voxelize bunny.obj --dim 2048 --dask local --workers 2
      voxtool voxelize open.obj --fill flood --gap 3
      voxtool voxelize bunny.obj open.obj --labels file -o both.svo.h5
      voxtool voxelize bunny.obj --like mask.npy -o bunny.npy
      voxtool voxelize open.obj --lattice bunny.svo.h5 -o box.svo.h5
      voxtool voxelize bunny.obj --normalize unit --dim 64 --bbox 0 0 0 1 1 1 -o bunny.npy
    """
    check_placing(placing)
    if (fraction_type or face_fractions) and mode != FRACTION:
        name = "--face-fractions" if face_fractions else "--fraction-type"
        raise click.UsageError(f"{name} goes with --mode {FRACTION}, not {mode}")
    if mode == FRACTION:
        given = {"--with-surface": with_surface, "--attributes": attributes, "--dag": dag}
        given["--connected"] = connected
        check_fraction(fill, given)
    if with_surface and mode != "solid":
        raise click.UsageError(f"--with-surface goes with --mode solid: {mode} is a surface")
    if connected and mode != "solid":
        raise click.UsageError(f"--connected goes with --mode solid: {mode} is a surface")
    if connected and with_surface:
        raise click.UsageError("--connected adds some of --with-surface's voxels: drop one")
    if thin and "surface" not in mode:
        raise click.UsageError("--thin goes with --mode surface26 and surface6")
    attributes = attributes or []
    if colour and "colour" not in attributes:
        raise click.UsageError("--colour goes with --attributes colour")
    check_attributes(attributes, {"--dag": dag, "--thin": thin})
    if gap and (fill != "flood" or mode != "solid"):
        raise click.UsageError("--gap goes with --mode solid --fill flood")
    if labels and face_fractions:
        raise click.UsageError("--face-fractions are of a solid without --labels: drop one")
    if priority and not labels:
        raise click.UsageError("--priority goes with --labels: give both")
    if labels and (dag or thin):
        raise click.UsageError("--labels: not with --dag and --thin: drop them")
    from voxtool.files import SVO_FORMATS, export, write_svo
    from voxtool.svo.attribution.request import kept_for, plan_octree

    default = options.output_of(mesh, run.file_format or "svo.h5")
    run.to(", ".join((mesh, *others)), default, (*SVO_FORMATS, *EXPORTS))
    if dask and run.file_format != "svo.h5":
        raise click.UsageError("--dask writes .svo.h5: name one with -o, and use voxtool export")
    if dask:
        refuse_stdout(run)
    if dag and run.file_format not in MERGED_FORMATS:
        raise click.UsageError("--dag writes .svo.h5: name one with -o")
    if thin and (dask or resume):
        raise click.UsageError("--thin takes a surface in one piece: drop --dask and --resume")
    if connected and (dask or resume):
        raise click.UsageError("--connected takes a solid in one piece: drop --dask and --resume")
    if labels and "xml" in str(run.file_format):
        raise click.UsageError("XML holds no attributes of voxels: name a .svo.h5 with -o")
    if doctype and "xml" not in str(run.file_format):
        raise click.UsageError("--doctype goes with .svo.xml and .voccel.xml: name one with -o")
    with run, ExitStack() as stack:
        keep = kept_for(labels, attributes)
        loaded = run.meshes((mesh, *others), units, scale, normalize, keep)
        loaded, grid, beyond, _ = placed(run, loaded, placing)
        request: dict[str, Any] = {"fill": fill, "gap": gap, "with_surface": with_surface}
        request["connected"] = connected
        request |= {"fraction_type": fraction_type, "face_fractions": face_fractions}
        request |= {"labels": labels, "priority": priority or PRIORITIES[0]}
        request |= {"attributes": attributes, "colour": colour or COLOURS[0]}
        job: Any = run.plan(plan_octree, loaded, grid, mode, **request)
        place: dict[str, Any] = {"origin": list(grid.origin), "pitch": list(grid.pitch)}
        parts = None
        if dask:
            from voxtool.tiles import cluster
            from voxtool.tiles.plan import plan_spread

            client = stack.enter_context(cluster.connected(dask, workers))
            parts = run.stage("plan windows", plan_spread, job, client, run.device_name, merged=dag)
        elif windows != "never" and not thin and run.file_format == "svo.h5" and not fits(job, dag):
            parts = run.stage("plan windows", windows_of, job, dag)
        if parts and dag and run.to_stdout and not dask:
            octree = run.job(parts, **place)
            run.write(write_svo, octree)
        elif parts:
            octree = make_in_windows(run, parts, resume, no_keep, **place)
        else:
            octree = run.job(job, ("thin",) * thin + ("merge subtrees",) * dag, **place)
            if thin:
                from voxtool.svo.sets.thin import plan_thin

                octree = run.job(run.stage("thin", plan_thin, octree), ("merge subtrees",) * dag)
            if dag:
                from voxtool.svo.dag.merged import MergedOctree

                octree = run.stage("merge subtrees", MergedOctree.of, octree)
            if run.file_format in EXPORTS:
                run.write(export, octree)
            else:
                run.write(write_svo, octree, doctype=doctype)
    details = details_of(octree) if run.verbose else ()
    line = report_line(octree, run.size)
    run.report(line, lambda: {**facts_of(octree), "beyond": beyond}, details)


def check_attributes(names: Sequence[str], others: dict[str, bool]) -> None:
    """Refuse options that do not go with --attributes."""
    given = [name for name, is_given in others.items() if is_given]
    if names and given:
        raise click.UsageError(f"--attributes: not with {given[0]}: drop one")
    if len(set(names)) < len(names):
        raise click.UsageError(f"--attributes {','.join(names)}: name each once")


def check_fraction(fill: str, others: dict[str, Any]) -> None:
    """Refuse options that do not go with --mode fraction."""
    given = [name for name, is_given in others.items() if is_given]
    if given:
        raise click.UsageError(f"{' and '.join(given)}: not with --mode {FRACTION}: drop it")
    if fill == "flood":
        raise click.UsageError(
            f"--fill flood fills whole voxels, so --mode {FRACTION} has no part of one: choose "
            "winding, nonzero, parity or auto"
        )


def fits(job: VoxelizeJob, dag: bool) -> bool:
    """Return whether the octree, and merging it, fit in memory in one piece; slabs of a flood are
    more than one, and take longer than windows."""
    if getattr(job.plan, "slabs", 1) > 1:
        return False
    if not dag:
        return job.fits
    from voxtool.tiles.merging import merging_fits

    return merging_fits(job)


def windows_of(job: VoxelizeJob, dag: bool) -> WindowsJob | None:
    """Return the job in windows, with `dag` merged, or None if windows do not fit either."""
    from voxtool.tiles.plan import plan_windows

    try:
        return plan_windows(job, merged=dag)
    except OnePieceError:
        raise
    except MemoryLimitError:
        return None


def facts_of(octree: Octree | BlockOctree | MergedOctree) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    grid = octree.grid
    return {
        "grid": {name: list(getattr(grid, name)) for name in ("shape", "origin", "pitch")},
        "dim": grid.dim,
        "units": octree.units,
        "mode": octree.mode,
        "fill": octree.fill,
        "transform": list(octree.transform),
        "voxels": octree.count,
        "nodes": len(octree.nodes),
        "bricks": len(octree.bricks),
        "memory_bytes": octree.nbytes,
        "digest": octree.digest(),
        **connected_of(octree),
        **attributes_of(octree),
        **volumes_of(octree),
    }


def connected_of(octree: Octree | BlockOctree | MergedOctree) -> dict[str, Any]:
    """Return what connecting its thin parts added to an octree, in JSON types."""
    facts = octree.plan.get("connected")
    return {"connected": facts} if facts else {}


def attributes_of(octree: Any) -> dict[str, Any]:
    """Return the attributes of an octree, by name, in JSON types."""
    found = getattr(octree, "attributes", ())
    return {"attributes": {one.name: one.summary() for one in found}} if found else {}


def volumes_of(octree: Any) -> dict[str, float]:
    """Return the volume of an octree with fractions and, if it is of one solid, those of its mesh
    and of the mesh on the lattice, in cubic world units."""
    if octree.mode != f"solid+{FRACTION}":
        return {}
    from voxtool.svo.attribution.fraction import LATTICE_VOLUME, MESH_VOLUME
    from voxtool.svo.octree.stored_volume import stored_volume

    voxels = {"volume": stored_volume(octree)}
    for name, key in (("mesh_volume", MESH_VOLUME), ("lattice_volume", LATTICE_VOLUME)):
        if key in octree.plan:
            voxels[name] = octree.plan[key]
    return {name: number * octree.grid.voxel_volume for name, number in voxels.items()}


def details_of(octree: Any) -> Iterator[str]:
    """Yield what -v says of an octree with fractions: its lattice, and what this changed."""
    volumes = volumes_of(octree)
    if not volumes:
        return
    from voxtool.svo.attribution.fraction import LATTICE_BITS

    text = f"vertices rounded to 2^-{octree.plan[LATTICE_BITS]} of a voxel"
    if volumes.get("mesh_volume"):
        change = abs(volumes["lattice_volume"] / volumes["mesh_volume"] - 1)
        text += f", which changes the mesh's volume by {change:.1e} of it"
    yield text


def report_line(octree: Octree | BlockOctree | MergedOctree, size: str) -> str:
    """Return the line of the report, of an output of this size."""
    filled = "" if octree.fill == "none" else f" by {octree.fill}"
    volumes = volumes_of(octree)
    named = {"volume": "; volume", "mesh_volume": ", of the mesh"}
    volume = "".join(
        f"{text} {volumes[name]:.12g}" for name, text in named.items() if name in volumes
    )
    return (
        f"{octree.mode}{filled}, dim {octree.grid.dim}, pitch {pitch_of(octree.grid)}; "
        f"{octree.count:,} voxels in {size}{volume}"
    )


def pitch_of(grid: Grid) -> str:
    """Return 0.01, or 0.01 x 0.02 x 0.03 if the axes differ."""
    sizes = [f"{p:.6g}" for p in grid.pitch]
    return sizes[0] if len(set(grid.pitch)) == 1 else " x ".join(sizes)
