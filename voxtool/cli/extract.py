"""voxtool extract: octree or distance field to triangle mesh."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import (
    BY,
    DEFAULT_STYLE,
    MARCHING_CUBES,
    SHARP,
    STYLE_ALIASES,
    STYLES,
    SURFACE_NETS,
    VOXEL_FACES,
    VOXEL_LEVEL,
)
from voxtool.cli import options, runner
from voxtool.cli.options import LEVEL, POSITIVE, flag, option, output_of, together
from voxtool.cli.placing import LENGTH, in_unit_of, in_world, mesh_origin
from voxtool.errors import CheckError, MemoryLimitError, count_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.field import DistanceField
    from voxtool.job import Job
    from voxtool.svo.octree.content import OctreeContent
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.surface.isosurface import Adaptive, Isosurface
    from voxtool.tiles.surface import SurfaceWindowsJob
MUCH = 0.02  # of the volume
ROUNDED = "the surface rounds off what is only a few samples wide: {} keeps its volume"
ISOVALUE = 0.5
SAMPLES = 100_000  # points on each surface at which distances are measured


@click.command("extract")
@click.argument("octree")
@together(
    option("--style", options.Alias(STYLES, STYLE_ALIASES),
        "surface-nets: smooth, with every vertex inside its cell; marching-cubes: triangles in "
        "each cut cube; voxel-faces: the exact boundary of the voxels; sharp: with the edges and "
        f"corners of --source.  [default: {DEFAULT_STYLE}]"),
    option("--by", BY,
        "label: a closed mesh for each label, by name, in one .obj, .glb or .3mf; meshes side by "
        "side have the same vertices and triangles where they meet (surface-nets, voxel-faces)."),
    option("--level", LEVEL,
        "voxel: the samples are voxels; N: the shares of set voxels of nodes of level N (0: bricks "
        "of 4 x 4 x 4 voxels; higher: coarser), for fewer triangles, which round off more.",
        VOXEL_LEVEL, metavar="N|voxel"),
    option("--isovalue", float,
        "A sample is inside if at least this share of its voxels is set, between 0 and 1.",
        ISOVALUE),
    option("--source", str, "sharp: the mesh that the octree or the field was made from.",
        metavar="MESH"),
    option("--adaptive", LENGTH,
        "Larger cells where the surface is flat, for fewer triangles: nowhere further from the "
        "surface without it than this, in world units or voxels (0.5vox); not sharp.",
        metavar="TOLERANCE"),
    option("--offset", float,
        "Fields: the surface at this distance, in world units; negative inside.", metavar="D"),
    option("--shell", POSITIVE,
        "Fields: hollow, with a wall of this thickness inward of the surface.", metavar="T"),
    option("--windows", ("auto", "never"),
        "auto: if the extraction would take more than --max-memory, a .ply is made window by "
        "window, the same; never: refuse.", "auto"),
    flag("--merge", "voxel-faces: join coplanar squares (greedy meshing); leaves T-junctions."),
    flag("--naive",
        "Visit every cube of the grid, not only those that matter: the same mesh, for comparison."),
    flag("--normals", "Write vertex normals, too (.obj, .ply, .glb)."),
    mesh_origin,
    flag("--check",
        "Print as JSON whether the mesh is closed and manifold, its genus, shells and volume; "
        "exit with 1 if it is not closed."),
    option("--against", str,
        "Print as JSON the distances between the surface and this mesh, both ways.  Their memory "
        "does not count for --max-memory.", metavar="MESH"),
    option("--samples", click.IntRange(1, 100_000_000),
        f"With --against: points on each surface.  [default: {SAMPLES}]"),
    options.length_options("the meshes of --against and --source"),
)  # fmt: skip
@runner.job_options(
    "FILE", "Default OCTREE's name with the style, and .obj or --format, in this folder.",
    "obj", "ply", "stl", "glb", "off",
)  # fmt: skip
def command(
    run: runner.Run, octree: str, source: str | None, normals: bool, check: bool,
    against: str | None, samples: int | None, naive: bool, units: str | None, scale: float,
    windows: str, by: str | None, origin: tuple[float, ...] | None, **request: Any,
) -> None:  # fmt: skip
    """Extract a closed triangle mesh from an OCTREE or a distance field, visiting only the cubes
    that matter.

    OCTREE is a file that voxelize or adf-build wrote, or - for stdin. The mesh is in world units,
    where the voxels or the field lie; write it as .obj, .ply, .stl, .glb or .off. An octree with
    colours gives a mesh with colours of vertices in .ply, .glb and .obj. Distances of --against are
    in world units and in voxels, or edges of the field's deepest leaves.

    \b
    Examples:
      voxtool voxelize bunny.obj --dim 512 -o - | voxtool extract - -o smooth.obj
      voxtool extract bunny.svo.h5 --check --against bunny.obj
      voxtool extract bunny.svo.h5 --style sharp --source bunny.obj -o sharp.ply
      voxtool extract bunny.svo.h5 --style marching-cubes --level 0 -o coarse.obj
      voxtool extract bunny.svo.h5 --adaptive 0.5vox -o fewer.ply
      voxtool voxelize parts.glb --attributes colour -o - | voxtool extract - -o coloured.glb
      voxtool voxelize parts.glb --labels part -o - | voxtool extract - --by label -o labels.glb
      voxtool extract bunny.adf.h5 --offset 0.002 --shell 0.001 --check -o hollow.stl
    """
    style = request["style"] or DEFAULT_STYLE
    if by is None and request["merge"] and style != VOXEL_FACES:
        raise click.UsageError(f"--merge goes with --style {VOXEL_FACES}: {style} has no squares")
    if samples is not None and against is None:
        raise click.UsageError("--samples goes with --against MESH: there is nothing to measure")
    if by is None:
        check_names(style, octree, source, against, bool(units or scale != 1))
    from voxtool.files import MESH_FORMATS, PART_FORMATS, open_shape, write_blocks, write_mesh
    from voxtool.svo.octree.attributes import COLOUR
    from voxtool.svo.octree.content import OctreeContent
    from voxtool.svo.octree.octree import Octree, in_memory
    from voxtool.svo.surface.isosurface import Isosurface

    # named after its style: bunny.obj is the mesh that the octree was made from
    kind = "surface" if octree.endswith(".adf.h5") else style
    formats = MESH_FORMATS if by is None else MESH_FORMATS | PART_FORMATS
    run.to(octree, output_of(octree, f"{kind}.{run.file_format or 'obj'}"), formats)
    if by is not None:
        from voxtool.cli.extract_labels import extract_labels

        request |= {"source": source, "against": against, "naive": naive, "normals": normals}
        request |= {"units": units, "scale": scale}
        del request["style"]
        extract_labels(run, octree, by, style, check, origin, request)
        return
    if normals:
        options.check_normals(run.file_format)
    more: dict[str, Any] = {}
    with run, ExitStack() as stack:
        content = run.stage("read file", stack.enter_context, open_shape(octree))
        parts = possible = None
        if isinstance(content, OctreeContent) and not isinstance(content, Octree):
            if windows != "never" and not (source or naive):
                with run.naming(octree):
                    possible = windows_of(run, content, request)
            if run.file_format == "ply" and not (check or normals or against):
                parts = possible
            if parts is None:
                content, used = content.only(("fraction", COLOUR)), used_of(run, request)
                with run.naming(octree):
                    content = run.stage("read file", in_memory, content, run.max_memory, used)
        shape: Any = content
        if source is not None or against is not None:
            from voxtool.files.meshes.mesh import load_mesh
        if source is not None:
            found = run.stage("read source", load_mesh, source, units=units, scale=scale)
            request["source"] = in_unit_of(run, found, shape)
        reference = None
        if against is not None:
            reference = in_unit_of(run, load_mesh(against, units=units, scale=scale), shape)
        after = ["check"] * check + ["measure"] * bool(against)
        with run.naming(octree):
            job: Job[Any] = parts or planned(run, shape, request, naive)
            if parts and not run.only_plan:
                from voxtool.files.storage.spool import Spool

                parts.store = stack.enter_context(Spool(str(run.output)))
            try:
                surface: Any = run.job(job, after, empty=lambda surface: not len(surface.faces))
            except MemoryLimitError as error:
                if parts or not possible:
                    raise
                hint = "a .ply without other options is made in windows"
                raise MemoryLimitError(f"{error}; {hint}") from error
        if check:
            more["check"] = run.stage("check", surface.check)
        if reference is not None:
            from voxtool.spatial.deviation import deviation

            more["against"] = run.stage(
                "measure", deviation, surface.mesh(), reference, samples or SAMPLES,
                pitch=surface.pitch, device=run.device,
            )  # fmt: skip
        if parts:
            run.write(write_blocks, surface, origin=origin)
        else:
            found = surface if isinstance(surface, Isosurface) else surface.mesh()
            own = surface.normals if normals else None
            run.write(write_mesh, found, normals=own, origin=origin)
        text = f"{surface.text}; {count_of(len(surface.vertices), 'vertex')}, "
        text += count_of(len(surface.faces), "triangle")
        if isinstance(shape, OctreeContent):
            volumes = volumes_of(surface.volume, shape.volume)
            if check:
                more["check"] |= volumes
            text += f"; {volume_text(volumes, shape.units)}"
            run.notes += rounded_off(volumes, surface)
        if saved := getattr(surface, "adaptive", None):
            text += f"; {saved_text(saved, len(surface.faces), shape.units)}"
        facts = facts_of(shape, surface) if run.as_json or more else {}
        facts |= {"origin": list(origin)} if origin else {}
    run.report(
        f"{text}, {run.size}",
        lambda: {**facts, **more},
        json_too=bool(more),
    )
    if check and not more["check"]["closed"]:
        raise CheckError(f"{run.output}: the surface is not closed: report this file")


def windows_of(
    run: runner.Run, octree: OctreeContent, request: dict[str, Any]
) -> SurfaceWindowsJob | None:
    """Return the extraction in windows of an octree that does not fit in memory, or
    None if it fits, or cannot be written in windows, as with fractions or colours."""
    from voxtool.svo.surface.extract import fits_whole, plan_unread

    of_octree = {name: request[name] for name in ("level", "isovalue", "merge")}
    of_octree["style"] = request["style"] or DEFAULT_STYLE
    if used_of(run, request) & {one.name for one in octree.attributes}:
        return None
    if any(request[name] is not None for name in ("adaptive", "offset", "shell")):
        return None
    if fits_whole(octree, plan_unread(octree, **of_octree), run.device, run.max_memory):
        return None
    from voxtool.tiles.surface import plan_windows

    return run.plan(plan_windows, octree, **of_octree)


def used_of(run: runner.Run, request: dict[str, Any]) -> set[str]:
    """Return the attributes of an octree that its surface needs."""
    from voxtool.files.formats import COLOUR_FORMATS
    from voxtool.svo.octree.attributes import COLOUR

    coloured = run.file_format in COLOUR_FORMATS and not (request["merge"] or request["adaptive"])
    return {"fraction", COLOUR} if coloured else {"fraction"}


def planned(
    run: runner.Run, source: Octree | DistanceField, request: dict[str, Any], naive: bool
) -> Job[Any]:
    """Return the job for an octree or a field; refuse options of the other."""
    from voxtool.files.formats import COLOUR_FORMATS
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.surface.extract import plan_extract

    of_field = {name: request.pop(name) for name in ("offset", "shell")}
    if not isinstance(source, Octree):
        from voxtool.adf.surface.extract import plan_field_surface

        usual = {"style": None, "level": VOXEL_LEVEL, "isovalue": ISOVALUE}
        usual |= {"merge": False, "naive": False}
        if "source" in request:
            of_field["source"] = request.pop("source")
            usual["style"] = SHARP
        for name, value in {**request, "naive": naive}.items():
            if value != usual.get(name):
                raise click.UsageError(f"--{name} is of octrees: a field has leaves, no samples")
        of_field["offset"] = of_field["offset"] or 0.0
        return run.plan(plan_field_surface, source, **of_field)
    for name, value in of_field.items():
        if value is not None:
            raise click.UsageError(f"--{name} is of fields: build one with voxtool adf-build")
    if "source" in request:
        from voxtool.svo.surface.sharp import source_of

        request["source"] = source_of(source, request["source"])
    if request["adaptive"] is not None:
        request["adaptive"] = in_world(request["adaptive"], source)
    request["style"] = request["style"] or DEFAULT_STYLE
    job = run.plan(plan_extract, source, **request)
    if job.plan.colours and run.file_format not in COLOUR_FORMATS:
        held = ", ".join(f".{name}" for name in COLOUR_FORMATS)
        run.notes.append(f"colours are left out: .{run.file_format} holds none: write {held}")
        job = job.with_(colours=False)
    return job.with_(naive=True) if naive else job


def check_names(
    style: str, octree: str, source: str | None, against: str | None, scaled: bool
) -> None:
    """Refuse names of meshes that do not go with the style, or units without such a mesh."""
    if (source is None) == (style == SHARP):
        raise click.UsageError(
            f"--style {SHARP} keeps the edges of --source MESH: name the mesh that it was made from"
            if style == SHARP
            else f"--source goes with --style {SHARP}: {style} needs no mesh"
        )
    if scaled and against is None and source is None:
        raise click.UsageError(
            "--units and --scale are those of the meshes of --against and --source: name one"
        )
    for name, other in (("--against", against), ("--source", source)):
        if octree == other == "-":
            raise options.input_twice("OCTREE", name)
    if against == source == "-":
        raise options.input_twice("--source", "--against")


def saved_text(adaptive: Adaptive, triangles: int, units: str) -> str:
    """Return what cells of different size save, and how far they take the surface, for people."""
    unit = f" {units}" if units else ""
    return (
        f"{100 * (1 - triangles / adaptive.uniform):.1f} % of {adaptive.uniform:,} triangles "
        f"saved, {adaptive.furthest:.3g}{unit} away, at most {adaptive.tolerance:.3g}{unit}"
    )


def volumes_of(within: float, of_voxels: float) -> dict[str, float]:
    """Return the volume within a surface, that of the voxels, and the first as a share of it."""
    return {"volume": within, "octree_volume": of_voxels, "volume_ratio": within / of_voxels}


def volume_text(volumes: dict[str, float], units: str) -> str:
    """Return the volumes for people."""
    unit = f" {units}^3" if units else ""
    return (
        f"volume {volumes['volume']:.6g}{unit}, of the voxels {volumes['octree_volume']:.6g}{unit} "
        f"({percent_off(volumes)})"
    )


def percent_off(volumes: dict[str, float]) -> str:
    """Return by how much the volume within a surface differs from that of the voxels."""
    return f"{round(100 * (volumes['volume_ratio'] - 1), 2) + 0.0:+.2f} %"


def rounded_off(volumes: dict[str, float], surface: Any) -> Iterator[str]:
    """Yield what keeps the volume, if samples or relaxation have changed it much."""
    if abs(volumes["volume_ratio"] - 1) <= MUCH or surface.isovalue != ISOVALUE:
        return
    if surface.lost.vanished:  # which has a note or a warning of its own
        return
    if surface.level != VOXEL_LEVEL:
        yield ROUNDED.format(f"--level {VOXEL_LEVEL}")
    elif surface.style == SURFACE_NETS:
        yield ROUNDED.format(f"--style {MARCHING_CUBES}")


def saved_facts(surface: Isosurface) -> dict[str, Any]:
    """Return what cells of different size save, in JSON types; lengths in world units."""
    found = surface.adaptive
    assert found is not None
    return {
        "adaptive": {
            "tolerance": found.tolerance,
            "furthest": found.furthest,
            "uniform_triangles": found.uniform,
            "triangles_saved": found.uniform - len(surface.faces),
            "rounds": found.rounds,
        }
    }


def facts_of(source: OctreeContent | DistanceField, surface: Any) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    from voxtool.svo.octree.content import OctreeContent

    if not isinstance(source, OctreeContent):
        return surface.facts
    features = surface.features
    return {
        "dim": source.grid.dim,
        "style": surface.style,
        "level": surface.level,
        "isovalue": surface.isovalue,
        "vertices": len(surface.points),
        "triangles": len(surface.faces),
        "cubes_cut": surface.cubes,
        "voxels": source.count,
        "voxels_below_isovalue": surface.lost.below,
        "voxels_vanished": surface.lost.vanished,
        **volumes_of(surface.volume, source.volume),
        "coloured": getattr(surface, "colours", None) is not None,
        **(saved_facts(surface) if getattr(surface, "adaptive", None) else {}),
        **(
            {}
            if features is None
            else {
                "vertices_constrained": features.constrained,
                "vertices_without_crossing": features.open,
                "vertices_moved": features.moved,
                "sharp_edges_farthest": features.farthest and features.farthest[0],
            }
        ),
        "digest": surface.digest(),
    }
