"""voxtool export: voxels, distances of fields and cells of volumes, for other programs."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import FLUIDS, LATTICES
from voxtool.cli import options, runner
from voxtool.cli.options import BYTES, POSITIVE, Parsed, flag, option, plane_of, together
from voxtool.cli.placing import POINT, SHAPE, SPACING, bbox_option, file_options, in_unit_of
from voxtool.errors import human
from voxtool.files.formats import EXPORTS, ending

if TYPE_CHECKING:
    from voxtool.files.exchange import Content, ExportJob

SLICE = Parsed(
    "slice", lambda text: plane_of(text, number_of), " is no plane of voxels: write z=128, or z=all"
)
KNOWN = ", ".join(map(ending, EXPORTS))
ALL = "all"
LAYERED = ("tif", "tiff", "%04d.png")  # formats of layers along an axis


def number_of(text: str) -> int | str:
    if text == ALL:
        return text
    if not text.isdecimal():
        raise ValueError
    return int(text)


@click.command("export")
@click.argument("file")
@together(
    option("--level", click.IntRange(0),
        "Cells of 2^N voxels a side; 0 is the voxels themselves.", 0, metavar="N"),
    bbox_option("Only the cells that this box touches, in world units."),
    flag("--invert", "Export what is not set instead of what is."),
    option("--dtype", ("bool", "uint8", "uint16", "uint32", "float32", "float64"),
        "bool: at least the share --isovalue of a cell is set; whole numbers: how many of its "
        "voxels; floats: the share of them.  [default: bool; with --level float32]"),
    option("--isovalue", float,
        "With --level: the cells of which at least this share is set, above 0 and at most 1, as "
        "bool.  [default with --dtype bool: 0.5]", metavar="V"),
    flag("--leaves",
        "For .vtu, .msh and .inp: a hexahedron for each of the largest cubes of cells instead of "
        "each cell, with the nodes that hang."),
    flag("--normals",
        "For .ply and .xyz: unit normals of the cells, to where less is set; 0 where there is no "
        "such direction, as deep inside."),
    option("--attribute attributes", str,
        "Octrees: the attributes that are written (label, colour, normal, area, "
        "fraction, faces), or none.  [default: all that the format can hold, the label if it "
        "holds one]",
        metavar="NAME[,NAME...]"),
    option("--band", POSITIVE,
        "Level sets of fields: the half-width, in voxels.  [default: 3]", metavar="VOXELS"),
    file_options("Fields: ", "the extent of the field"),
    option("--origin", POINT, "Fields: with --shape and --spacing, the low corner of the grid.",
        metavar="X,Y,Z"),
    option("--shape", SHAPE, "Fields: samples along each axis.", metavar="N|NX,NY,NZ"),
    option("--spacing", SPACING,
        "Fields: distance of the samples, in world units: one number or three.  [default: edge "
        "of its finest leaves, at most 256 samples a side]", metavar="S"),
    option("--slice plane", SLICE,
        "For .png: the plane of voxels to draw, or all for the layers of %04d.png.  [default: the "
        "middle along z]",
        metavar="AXIS=VALUE"),
    option("--axis", ("x", "y", "z"),
        "For .tif and %04d.png: the axis along which the layers follow each other.  [default: z]"),
    option("--dpi", POSITIVE, "For .tif and %04d.png: pixels an inch."),
    option("--links", tuple(LATTICES),
        "Octrees, for lattice Boltzmann methods: the links of this lattice from fluid voxels "
        "to others, and where they first meet --source; a .npz or .h5."),
    option("--source", str, "With --links: the mesh that the octree was made from.",
        metavar="MESH"),
    option("--fluid", FLUIDS,
        f"With --links: which voxels are the fluid.  [default: {FLUIDS[0]}]"),
    options.length_options("the mesh of --source"),
    option("--max-bytes", BYTES, "Refuse a larger output (800M, 8G).", metavar="BYTES"),
    option("--windows", ("auto", "never"),
        "auto: an octree that would take more than --max-memory is read window by window, with the "
        "same output; never: refuse.", "auto"),
)  # fmt: skip
@runner.run_options(
    options.output_options("OUT", f"Its ending says the format: {KNOWN}."),
    options.format_option(*EXPORTS, "h5"),
    options.plan_options,
    options.device_option,
    options.report_options,
)
def command(
    run: runner.Run, file: str, plane: tuple[str, int | str] | None, axis: str | None,
    dpi: float | None, like: str | None, lattice: str | None, origin: tuple[float, ...] | None,
    windows: str,
    links: str | None, source: str | None, fluid: str | None, units: str | None, scale: float,
    **image: Any,
) -> None:  # fmt: skip
    """Export the voxels of an octree FILE, the distances of a field, or the cells of a volume.

    A field (.adf.h5) becomes signed distances at the centres of a grid, by default one over its
    cube; in a .vdb or .nvdb those near its surface. A volume (.tet.h5) becomes a .vtkhdf of its
    cells. In a .vtu, .msh or .inp, set voxels are hexahedra for a solver (docs/solvers.md).
    docs/exchange.md has a table of the formats and of what each of them keeps. In the mesh's own
    units, the low corner of a voxel is origin + pitch * voxel.

    \b
    Examples:
      voxtool export bunny.svo.h5 -o bunny.vti
      voxtool export bunny.svo.h5 -o coarse.npy --level 2
      voxtool export bunny.svo.h5 -o bunny.inp
      voxtool export bunny.svo.h5 -o coarse.vox --level 1 --isovalue 0.25
      voxtool export bunny.svo.h5 -o links.npz --links D3Q19 --source bunny.obj
      voxtool export bunny.adf.h5 -o bunny.nii.gz --shape 128
      voxtool export bunny.adf.h5 -o bunny.vdb --band 3
    """
    from voxtool.adf.field.field import DistanceField
    from voxtool.files import open_scene
    from voxtool.files.exchange import plan_export

    if links:
        given = {"slice": plane, "axis": axis, "dpi": dpi, "like": like, "lattice": lattice}
        given |= {"origin": origin, **image}
        given["windows"] = windows != "auto"
        write_links(run, file, given, source, units, scale, links, fluid or FLUIDS[0])
        return
    if source or fluid or units or scale != 1:
        raise click.UsageError("--source, --fluid, --units and --scale go with --links")
    if run.output is None:
        raise click.UsageError(f"where to? Give -o OUT, ending in one of {KNOWN}")
    run.to(file, run.output, EXPORTS)
    image |= layers_of(run.file_format or "", plane, axis, dpi)
    image |= grid_of(like, lattice, origin, image)
    run.on_device = False  # an octree needs none
    with ExitStack() as stack:
        with run:
            content: Any = run.stage("read file", stack.enter_context, open_scene(file))
            run.on_device = isinstance(content, DistanceField)
            job = run.plan(
                plan_export, content, run.output, not run.no_clobber, run.file_format,
                windows=windows != "never", progress=run.progress.share, **image,
            )  # fmt: skip
            run.job(job)
        run.report(report_line(job, run.size), lambda: facts_of(job, content))


def write_links(
    run: runner.Run, file: str, given: dict[str, Any], source: str | None, units: str | None,
    scale: float, lattice: str, fluid: str,
) -> None:  # fmt: skip
    """Write the links of a lattice that cross the wall."""
    from voxtool.errors import FileError
    from voxtool.files import open_svo, write_wall_links
    from voxtool.files.formats import LINK_FORMATS
    from voxtool.files.meshes.mesh import load_mesh
    from voxtool.svo.solvers.wall_links import plan_wall_links
    from voxtool.svo.surface.sharp import source_of

    most = given.pop("max_bytes")
    if others := [f"--{name.replace('_', '-')}" for name, value in given.items() if value]:
        raise click.UsageError(f"{', '.join(others)}: not with --links")
    if source is None:
        raise click.UsageError("--links needs --source MESH, from which the octree was made")
    if source == file == "-":
        raise options.input_twice("FILE", "--source")
    run.to(file, options.output_of(file, f"{lattice.lower()}.npz"), LINK_FORMATS)
    with ExitStack() as stack, run:
        octree: Any = run.stage("read file", stack.enter_context, open_svo(file))
        mesh = run.stage("read source", load_mesh, source, units=units, scale=scale)
        mesh = in_unit_of(run, mesh, octree)
        with run.naming(file):
            job = run.plan(
                plan_wall_links, octree, source_of(octree, mesh), lattice, fluid,
                progress=run.progress.share,
            )  # fmt: skip
            size = job.plan.bytes
            if most is not None and size > most:
                raise FileError(
                    f"{run.output} would take {human(size)}, of {human(most)} allowed: choose a "
                    "smaller dim, or D3Q19"
                )
            found = run.job(job)
        run.write(write_wall_links, found)
    run.report(
        f"{found.lattice}, {found.count:,} links of {len(found.voxels):,} fluid voxels, "
        f"{found.uncrossed:,} that no triangle crosses, {run.size}",
        lambda: {
            "lattice": found.lattice,
            "fluid": found.fluid,
            "voxels": len(found.voxels),
            "links": found.count,
            "uncrossed": found.uncrossed,
            "digest": found.digest(),
        },
    )


def layers_of(
    name: str, plane: tuple[str, int | str] | None, axis: str | None, dpi: float | None
) -> dict[str, Any]:
    """Return the options of a format that say which layers are written, and how."""
    layered = name in LAYERED
    if (axis or dpi) and not layered:
        raise click.UsageError("--axis and --dpi go with .tif and %04d.png")
    if plane is None:
        given = {"axis": axis, "dpi": dpi}
        return {option: value for option, value in given.items() if value is not None}
    if plane[1] == ALL and layered and axis in (None, plane[0]):
        return {"axis": plane[0], "dpi": dpi}
    if plane[1] == ALL or name != "png":
        raise click.UsageError(
            "--slice goes with .png, and z=all with .tif and layers/%04d.png: the other formats "
            "hold all voxels"
        )
    return {"axis": plane[0], "value": plane[1]}


def grid_of(
    like: str | None, lattice: str | None, origin: Any, image: dict[str, Any]
) -> dict[str, Any]:
    """Return the options of a grid that a file gives, or its own numbers."""
    shape, spacing = image["shape"], image["spacing"]
    own = {"origin": origin, "shape": shape, "spacing": spacing}
    given = [name for name, value in own.items() if value is not None]
    if (like or lattice) and (given or (like and lattice)):
        others = [*given, *["lattice"] * bool(like and lattice)]
        what = "--like sets the grid" if like else "--lattice sets the voxels"
        raise click.UsageError(f"{what}: drop --{' and --'.join(others)}")
    if like or lattice:
        return {"grid": like, "lattice": lattice}
    if len(given) < 2 and origin is None:
        return {}
    if len(given) < 3:
        raise click.UsageError(
            "--origin, --shape and --spacing give a grid by its own numbers: give all three, or "
            "only --shape or --spacing"
        )
    from voxtool.grid import Grid

    return {"grid": Grid(shape, origin, spacing), "shape": None, "spacing": None}


def report_line(job: ExportJob, size: str) -> str:
    """Return the line of the report, of an output of this size."""
    return f"{ending(job.plan.name)}, {job.plan.text}, {size}"


def facts_of(job: ExportJob, content: Content) -> dict[str, Any]:
    """Return the facts of the report, in JSON types; the digest is that of the content."""
    return {
        "format": job.plan.name,
        **job.plan.about,
        "digest": content.digest(),
    }
