"""voxtool morph: morphology, components and cavities of the voxels of an octree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import ELEMENTS, MORPHOLOGY, NEIGHBOURS
from voxtool.cli import runner
from voxtool.cli.options import COMPONENTS, RADIUS, flag, option, output_of, together

if TYPE_CHECKING:
    from voxtool.svo.components import ComponentsJob
    from voxtool.svo.morphology import MorphJob
    from voxtool.svo.octree import Octree

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
        f"axes only.  [default: {ELEMENTS[0]}]"),
    option("--keep", COMPONENTS, "Keep the N largest connected components.", metavar="largest|N"),
    option("--min-size", click.IntRange(1), "Keep the components of at least this many voxels.",
        metavar="VOXELS"),
    option("--neighbours", tuple(map(str, NEIGHBOURS)),
        "With --keep or --min-size: connected across faces, or also across edges and corners.  "
        f"[default: {NEIGHBOURS[0]}]"),
    flag("--fill-cavities", "Set what the outside does not reach across faces."),
)  # fmt: skip
@runner.job_options(
    "FILE", f"Default OCTREE's name with .morph.{EXTENSION}, in this folder.", "svo.h5", "svo.xml"
)
def command(run: runner.Run, octree: str, **request: Any) -> None:
    """Dilate, erode, open, close or hollow an OCTREE exactly, or keep its components.

    OCTREE is a file that voxelize wrote, or - for stdin. One operation a call. R is in voxels, from
    centre to centre, and need not be whole. What lies beyond the grid is unset.

    \b
    Examples:
      voxtool morph bunny.svo.h5 --close 8 -o closed.svo.h5
      voxtool morph bunny.svo.h5 --shell 0.002 --world -o hollow.svo.h5
      voxtool morph bunny.svo.h5 --keep largest -o body.svo.h5
    """
    check_request(request)
    from voxtool.files import SVO_FORMATS, read_svo, write_svo

    run.to(octree, output_of(octree, f"morph.{EXTENSION}"), SVO_FORMATS)
    with run:
        source = run.stage("read octree", read_svo, octree)
        with run.naming(octree):
            job = planned(run, source, request)
            result = run.job(job)
        run.write(write_svo, result)
    run.report(
        f"{source.count:,} voxels became {result.count:,}", lambda: facts_of(job, source, result)
    )


def check_request(request: dict[str, Any]) -> None:
    """Refuse a request of no operation, of several, or with options of another one."""
    by_radius = [f"--{name}" for name in MORPHOLOGY if request[name] is not None]
    by_size = ["--keep", "--min-size"] if request["keep"] or request["min_size"] else []
    cavities = ["--fill-cavities"] * request["fill_cavities"]
    if len(by_radius) + bool(by_size) + len(cavities) != 1:
        every = ", ".join(f"--{name}" for name in MORPHOLOGY)
        raise click.UsageError(
            f"what is to be done? Give one of {every}, --keep or --min-size, --fill-cavities"
        )
    if not by_radius and (request["world"] or request["shape"]):
        raise click.UsageError("--world and --shape go with a radius, as of --close")
    if not by_size and request["neighbours"]:
        raise click.UsageError("--neighbours goes with --keep and --min-size")


def planned(run: runner.Run, octree: Octree, request: dict[str, Any]) -> MorphJob | ComponentsJob:
    """Return the planned job of a request."""
    from voxtool.svo.components import plan_fill_cavities, plan_keep_components
    from voxtool.svo.morphology import plan_morph

    for operation in MORPHOLOGY:
        if (radius := request[operation]) is not None:
            shape = request["shape"] or ELEMENTS[0]
            return run.plan(
                plan_morph, octree, operation, radius, world=request["world"], shape=shape
            )
    if request["fill_cavities"]:
        return run.stage(runner.PLAN, plan_fill_cavities, octree, max_memory=run.max_memory)
    return run.stage(
        runner.PLAN, plan_keep_components, octree, request["keep"],
        min_size=request["min_size"] or 1, neighbours=int(request["neighbours"] or NEIGHBOURS[0]),
        max_memory=run.max_memory,
    )  # fmt: skip


def facts_of(job: MorphJob | ComponentsJob, source: Octree, result: Octree) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    from voxtool.svo.morphology import MorphJob

    if isinstance(job, MorphJob):
        names = ("operation", "radius", "world", "shape", "grid", "low")
        found = {name: job.describe()[name] for name in names}
    elif job.plan.cavities:
        found = {"operation": "fill-cavities"}
    else:
        found = {"operation": "keep", "component_sizes": job.sizes.tolist()}
    return {
        **found,
        "voxels_before": source.count,
        "voxels": result.count,
        "volume": result.count * result.grid.voxel_volume,
        "digest": result.digest(),
    }
