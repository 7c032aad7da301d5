"""voxtool morph: dilate, erode, open, close or hollow the voxels of an octree."""

from __future__ import annotations

import click

from voxtool.choices import ELEMENTS, MORPHOLOGY
from voxtool.cli import runner
from voxtool.cli.options import RADIUS, flag, option, output_of, together

EXTENSION = "svo.h5"


@click.command("morph")
@click.argument("octree")
@together(
    option("--dilate", RADIUS,
        "Add the voxels within R of a set one; the grid grows where they lie beyond it.",
        metavar="R"),
    option("--erode", RADIUS, "Remove the voxels within R of an unset one, or of the grid's end.",
        metavar="R"),
    option("--open", RADIUS, "Erode, then dilate: removes what a ball of R does not fit into.",
        metavar="R"),
    option("--close", RADIUS, "Dilate, then erode: fills gaps that a ball of R does not fit into.",
        metavar="R"),
    option("--shell", RADIUS, "Keep the voxels within R of an unset one: a wall of thickness R.",
        metavar="R"),
    flag("--world", "R is in world units instead of voxels."),
    option("--shape", ELEMENTS,
        "What is within R: by Euclidean distance; by the largest distance along an axis; along the "
        "axes only.", ELEMENTS[0]),
)  # fmt: skip
@runner.job_options(
    "FILE", f"Default OCTREE's name with .morph.{EXTENSION}, in this folder.", "svo.h5", "svo.xml"
)
def command(
    run: runner.Run, octree: str, world: bool, shape: str, **radii: float | None
) -> None:  # fmt: skip
    """Dilate, erode, open, close or hollow an OCTREE, exactly.

    OCTREE is a file that voxelize wrote, or - for stdin. R is in voxels, from centre to centre,
    and need not be whole. What lies beyond the grid is unset.

    \b
    Examples:
      voxtool morph bunny.svo.h5 --close 8 -o closed.svo.h5
      voxtool morph bunny.svo.h5 --shell 0.002 --world -o hollow.svo.h5
    """
    given = {name: radius for name in MORPHOLOGY if (radius := radii[name]) is not None}
    if len(given) != 1:
        every = ", ".join(f"--{name}" for name in MORPHOLOGY)
        raise click.UsageError(f"what is to be done? Give one of {every}")
    from voxtool.files import SVO_FORMATS, read_svo, write_svo
    from voxtool.svo.morphology import plan_morph

    ((operation, radius),) = given.items()
    run.to(octree, output_of(octree, f"morph.{EXTENSION}"), SVO_FORMATS)
    with run:
        source = run.stage("read octree", read_svo, octree)
        with run.naming(octree):
            job = run.plan(plan_morph, source, operation, radius, world=world, shape=shape)
            result = run.job(job)
        run.write(write_svo, result)
    run.report(
        f"{operation} {radius:g}, {source.count:,} voxels became {result.count:,}",
        lambda: {
            "operation": operation,
            "radius": radius,
            "shape": shape,
            "grid": list(result.grid.shape),
            "low": list(job.plan.low),
            "voxels_before": source.count,
            "voxels": result.count,
            "volume": result.count * result.grid.voxel_volume,
            "digest": result.digest(),
        },
    )
