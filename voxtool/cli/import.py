"""voxtool import: other programs' voxels as an octree, or distances as a field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import OCTREE_MODES
from voxtool.cli import options, runner
from voxtool.cli.options import Parsed, flag, option, together
from voxtool.cli.placing import POINT, SPACING
from voxtool.files.formats import ADF_FORMATS, IMPORTS, OCTREE_FORMATS, SVO_FORMATS

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField

VOCCEL = "voccel.xml"


def number_of(text: str) -> float:
    """Return a number; a whole one as an int, which holds all labels of 64 bits."""
    try:
        return int(text)
    except ValueError:
        return float(text)


NUMBER = Parsed("float", number_of, " is not a valid float.")


@click.command("import")
@click.argument("file")
@together(
    option("--threshold", NUMBER, "Set what has this value or more.  [default: what is not 0]"),
    option("--label", NUMBER, "Set only what has exactly this value."),
    flag("--as-field", "Make a distance field: the values are signed distances, in world units."),
    option("--tolerance", float,
        "Fields: error at which a cell is no longer refined, in sides of its cube.  "
        "[default: 0.001]"),
    option("--max-level", int,
        "Fields: level at which leaves are no longer refined.  [default: that of the samples, "
        "2 more where voxels are no cubes]"),
    option("--origin", POINT, "Low corner, in world units, instead of the file's.",
        metavar="X,Y,Z"),
    option("--spacing pitch", SPACING, "Size of a voxel, in world units, instead of the file's.",
        metavar="S"),
    option("--grid", str, "The grid of a .vdb that holds several.", metavar="NAME"),
    option("--from from_format", (*IMPORTS, VOCCEL),
        "Format of FILE, instead of what its name says."),
    option("--like", str, "With a .voccel.xml: the grid of an octree, or of an image or array.",
        metavar="FILE"),
    option("--mode", OCTREE_MODES, "With a .voccel.xml: what its voxels are.  [default: solid]"),
)  # fmt: skip
@runner.run_options(
    options.output_options(
        "OUT", "Default FILE's name with .svo.h5, or .adf.h5 for a field, in this folder."
    ),
    options.format_option(*OCTREE_FORMATS, "adf.h5"),
    options.plan_options,
    options.report_options,
)
def command(
    run: runner.Run,
    file: str,
    from_format: str | None,
    as_field: bool,
    like: str | None,
    mode: str | None,
    **request: Any,
) -> None:
    """Make an octree of another program's voxels, or a field of an image of distances.

    docs/exchange.md has a table of the formats. Origin, spacing and axes are kept; a file without
    them lies at 0, with voxels of side 1. With --as-field the values at the centres of the voxels
    are distances, negative inside, and the field is their trilinear interpolation.

    \b
    Examples:
      voxtool import mask.npy -o mask.svo.h5
      voxtool import scan.npz --threshold 0.5 --spacing 0.7,0.7,1.5
      voxtool import distances.nii.gz --as-field -o distances.adf.h5
    """
    from voxtool.files import write_adf, write_svo
    from voxtool.files.imports import plan_import

    if from_format == VOCCEL or (not from_format and file.lower().endswith(f".{VOCCEL}")):
        given = {**request, "as_field": as_field or None, "plan": run.only_plan or None}
        import_voccel(run, file, like, mode, given)
        return
    if like or mode:
        raise click.UsageError(f"--like and --mode go with a .{VOCCEL}: give --from {VOCCEL}")
    if request["threshold"] is not None and request["label"] is not None:
        raise click.UsageError("--threshold and --label both say what is set: drop one of them")
    own = ("threshold", "label", "grid") if as_field else ("tolerance", "max_level")
    if given := [f"--{name.replace('_', '-')}" for name in own if request[name] is not None]:
        goes = "go without" if as_field else "goes with"
        raise click.UsageError(f"{' and '.join(given)} {goes} --as-field")
    formats, extension = (ADF_FORMATS, "adf.h5") if as_field else (SVO_FORMATS, "svo.h5")
    run.to(file, options.output_of(file, extension), formats)
    with run:
        job = run.plan(
            plan_import, file, as_field=as_field, format=from_format, progress=run.progress.share,
            **request,
        )  # fmt: skip
        found: Any = run.job(job)
        run.write(write_adf if as_field else write_svo, found)
    if as_field:
        from voxtool.cli.adf_build import facts_of

        run.report(line_of(found, run.size), lambda: facts_of(found))
    else:
        from voxtool.cli.voxelize import facts_of, report_line

        run.report(report_line(found, run.size), lambda: facts_of(found))


def import_voccel(
    run: runner.Run, file: str, like: str | None, mode: str | None, given: dict[str, Any]
) -> None:
    """Read an octree of voCCeL's, and write it with the place and the mode that are asked for."""
    if named := [f"--{k.replace('_', '-')}" for k, value in given.items() if value is not None]:
        raise click.UsageError(
            f"a .{VOCCEL} is read as it is, with --like and --mode: drop {' and '.join(named)}"
        )
    from voxtool.cli.voxelize import facts_of, report_line
    from voxtool.files import read_svo, write_svo
    from voxtool.files.lattices import Lattice, read_lattice
    from voxtool.files.octrees.voccel import placed

    run.to(file, options.output_of(file, "svo.h5"), SVO_FORMATS)
    with run:
        octree = run.stage("read octree", read_svo, file)
        other = run.stage("read grid", read_lattice, like) if like else Lattice(octree.grid)
        with run.naming(file):
            octree = placed(octree, other.grid, mode, other.units)
        run.write(write_svo, octree)
    run.report(report_line(octree, run.size), lambda: facts_of(octree))


def line_of(field: DistanceField, size: str) -> str:
    """Return the line of the report of a field, of an output of this size."""
    leaves, missed = field.reached["leaves"], field.reached["missed"]
    return f"tolerance {field.tolerance:.3g}, sign {field.sign}; {leaves:,} leaves in {size}" + (
        f", of which {missed:,} miss the tolerance" if missed else ""
    )
