"""voxtool import: other programs' voxels as an octree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options, runner
from voxtool.cli.options import POINT, SPACING, option, together
from voxtool.files.formats import IMPORTS, SVO_FORMATS

if TYPE_CHECKING:
    from voxtool.svo.octree import Octree

KNOWN = ", ".join(f".{name}" for name in IMPORTS)


@click.command("import")
@click.argument("file")
@together(
    option("--threshold", float, "Set what has this value or more.  [default: what is not 0]"),
    option("--label", float, "Set what has this value alone."),
    option("--origin", POINT, "Low corner, in world units, instead of the file's.",
        metavar="X,Y,Z"),
    option("--spacing pitch", SPACING, "Size of a voxel, in world units, instead of the file's.",
        metavar="S"),
    option("--grid", str, "The grid of a .vdb that holds several.", metavar="NAME"),
    option("--from from_format", IMPORTS, "Format of FILE, instead of what its name says."),
)  # fmt: skip
@runner.run_options(
    options.output_options("OUT", "Default FILE's name with .svo.h5, in this folder."),
    options.format_option("svo.h5", "svo.xml", "svo.xml.gz"),
    options.report_options,
)
def command(run: runner.Run, file: str, from_format: str | None, **rule: Any) -> None:
    """Make an octree of another program's voxels.

    docs/exchange.md has a table of the formats. Origin, spacing and axes are kept; a file without
    them lies at 0, with voxels of side 1.

    \b
    Examples:
      voxtool import mask.npy -o mask.svo.h5
      voxtool import scan.npz --threshold 0.5 --spacing 0.7,0.7,1.5
    """
    from voxtool.files import write_svo
    from voxtool.files.exchange import read_voxels

    if rule["threshold"] is not None and rule["label"] is not None:
        raise click.UsageError("--threshold and --label both say what is set: drop one of them")
    run.to(file, options.output_of(file, "svo.h5"), SVO_FORMATS)
    with run:
        octree: Octree = run.stage(
            "read voxels", read_voxels, file, format=from_format, progress=run.progress.share,
            **rule,
        )  # fmt: skip
        run.write(write_svo, octree)
    from voxtool.cli.voxelize import facts_of, report_line

    run.report(report_line(octree), lambda: facts_of(octree))
