"""voxtool morph: morphology, components and cavities of the voxels of an octree; resampling."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import ELEMENTS, MORPHOLOGY, NEIGHBOURS
from voxtool.cli import options, runner
from voxtool.cli.in_windows import loaded, make_in_windows, opened, windows_options
from voxtool.cli.info import place, table
from voxtool.cli.options import COMPONENTS, DIM, RADIUS, flag, option, together
from voxtool.cli.placing import FILES, bbox_option, check_placing, file_options
from voxtool.files.formats import EXPORTS, OCTREE_FORMATS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.svo.octree.content import OctreeContent
    from voxtool.svo.octree.octree import Octree
    from voxtool.svo.sets.components import ComponentsJob
    from voxtool.svo.sets.labels import Labels
    from voxtool.svo.sets.morphology import MorphJob
    from voxtool.svo.sets.resample import ResampleJob
    from voxtool.svo.sets.thin import ThinJob
    from voxtool.tiles.morphing import MorphWindowsJob

EXTENSION = "svo.h5"
PLACING = ("dim", "pitch", "bbox", *FILES)  # options of a grid
SHOWN = 20  # components in a report as text


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
    flag("--components",
        "Report the connected components, the largest first; -o writes their labels."),
    option("--neighbours", tuple(map(str, NEIGHBOURS)),
        "Components are connected across faces (6), also edges (18), or corners too (26).  "
        f"[default: {NEIGHBOURS[0]}]"),
    flag("--fill-cavities", "Set what the outside does not reach across faces."),
    flag("--thin", "Surfaces: remove voxels without which they still separate."),
    flag("--resample", "Resample to another grid, of --dim, --pitch, --bbox, --like or --lattice."),
    option("--threshold", float,
        "With --resample: the share of a voxel that is covered, at least, if it is set.  [default: "
        "0.5]"),
    option("--dim", DIM, "With --resample: voxels along the longest side."),
    option("--pitch", float, "With --resample: voxel size in world units."),
    bbox_option(
        "With --resample: box that the grid covers, in world units, instead of the octree's."),
    file_options("With --resample: ", "the octree's box, or that of --bbox"),
    windows_options,
)  # fmt: skip
@runner.job_options(
    "FILE",
    "Its ending says the format, of an octree or of an export (voxtool export -h); with "
    f"--components of a dense array.  Default OCTREE's name with .morph.{EXTENSION}, in this "
    "folder; with --components nowhere.",
    *OCTREE_FORMATS, *EXPORTS,
)  # fmt: skip
def command(
    run: runner.Run, octree: str, windows: str, resume: bool, no_keep: bool, **request: Any
) -> None:
    """Dilate, erode, open, close, hollow, thin or resample an OCTREE, or keep its components.

    OCTREE is a file that voxelize wrote, or - for stdin. One operation a call. R is in voxels, from
    centre to centre, and need not be whole. What lies beyond the grid is unset.

    \b
    Examples:
      voxtool morph bunny.svo.h5 --close 8 -o closed.svo.h5
      voxtool morph bunny.svo.h5 --shell 0.02 --world -o hollow.svo.h5
      voxtool morph bunny.svo.h5 --keep largest -o body.svo.h5
      voxtool morph bunny.svo.h5 --components -o labels.npy
      voxtool morph bunny.svo.h5 --resample --dim 64 -o coarse.svo.h5
    """
    check_request(request)
    if request["components"]:
        report_components(run, octree, neighbours_of(request))
        return
    from voxtool.files import SVO_FORMATS, export, write_svo
    from voxtool.svo.sets.attribute_transfer import check_kept, kept_of

    default = options.output_of(octree, f"morph.{EXTENSION}")
    run.to(octree, default, (*SVO_FORMATS, *EXPORTS))
    with run, ExitStack() as stack:
        source: Any = opened(run, octree, stack)
        job = None
        with run.naming(octree):
            if windows != "never" and run.file_format == "svo.h5":
                job = windows_of(run, source, request)
            if job:
                result: Any = make_in_windows(run, job, resume, no_keep)
            else:
                kept = () if request["thin"] or request["resample"] else kept_of([source])
                if kept:
                    check_kept([source], run.max_memory)
                source = loaded(run, source, octree, kept)
                job = planned(run, source, request)
                result = run.job(job)
                run.write(export if run.file_format in EXPORTS else write_svo, result)
        before = source.count
    run.report(
        f"{before:,} voxels became {result.count:,}, {run.size}",
        lambda: facts_of(job, before, result),
    )


def check_request(request: dict[str, Any]) -> None:
    """Refuse a request of no operation, of several, or with options of another one."""

    def given_of(*names: str) -> list[str]:
        given = [n for n in names if request[n] is not None and request[n] is not False]
        return [f"--{name.replace('_', '-')}" for name in given]

    by_radius, by_size = given_of(*MORPHOLOGY), given_of("keep", "min_size")
    asked = [*by_radius, *by_size[:1], *given_of("components", "fill_cavities", "thin", "resample")]
    if len(asked) > 1:
        *first, last = asked
        raise click.UsageError(f"one operation a call: drop {', '.join(first)} or {last}")
    if not asked:
        every = ", ".join(f"--{name}" for name in MORPHOLOGY)
        raise click.UsageError(
            f"what is to be done? Give one of {every}, --keep or --min-size, --components, "
            "--fill-cavities, --thin, --resample"
        )
    if not by_radius and (request["world"] or request["shape"]):
        raise click.UsageError("--world and --shape go with a radius, as of --close")
    if request["neighbours"] and not (by_size or request["components"]):
        raise click.UsageError("--neighbours goes with --keep, --min-size and --components")
    given = given_of(*PLACING, "threshold")
    if given and not request["resample"]:
        raise click.UsageError(f"{given[0]} goes with --resample")
    if request["resample"]:
        if not {*given} - {"--threshold"}:
            raise click.UsageError(
                "resample to what? Give --dim, --pitch, --bbox, --like or --lattice"
            )
        check_placing({name: request[name] for name in PLACING})


def neighbours_of(request: dict[str, Any]) -> int:
    """Return which voxels are connected."""
    return int(request["neighbours"] or NEIGHBOURS[0])


def report_components(run: runner.Run, octree: str, neighbours: int) -> None:
    """Report the components of an octree, and write their labels if there is an output."""
    from voxtool.files import export
    from voxtool.files.formats import IMAGES
    from voxtool.svo.sets.labels import plan_components

    if run.output:
        run.to(octree, run.output, IMAGES)
    run.on_device = False
    with run, ExitStack() as stack:
        source = loaded(run, opened(run, octree, stack), octree)
        found = run.job(run.plan(plan_components, source, neighbours))
        if run.output:
            run.write(export, found)
    if run.as_json:
        run.print_facts(found.summary())
    elif not run.quiet:
        for line in lines_of(found):
            click.echo(line, err=run.to_stdout)
    run.finish()


def lines_of(found: Labels) -> Iterator[str]:
    """Yield the lines of a report of components, in world units."""
    summary, units = found.summary(), found.units
    rows = [("components", f"{len(found):,}, by {found.neighbours} neighbours")]
    for part in summary["components"][:SHOWN]:
        low, high = part["bounds"]
        volume = f"{part['volume']:.9g}{f' {units}^3' if units else ''}"
        rows.append((
            str(part["label"]),
            f"{part['voxels']:,} voxels, volume {volume}, centre ({place(part['center'])}), from "
            f"({place(low)}) to ({place(high)})",
        ))  # fmt: skip
    yield from table(rows)
    if len(found) > SHOWN:
        yield f"and {len(found) - SHOWN:,} smaller ones: --json lists all"


def windows_of(
    run: runner.Run, octree: OctreeContent, request: dict[str, Any]
) -> MorphWindowsJob | None:
    """Return the job in windows of a request whose octree does not fit in memory, or None if it
    fits, or if the operation is not local."""
    from voxtool.tiles.morphing import morph_windows

    for operation in MORPHOLOGY:
        if (radius := request[operation]) is not None:
            return run.plan(morph_windows, octree, operation, radius, **by_radius(request))
    return None


def by_radius(request: dict[str, Any]) -> dict[str, Any]:
    """Return the options of what is within a radius."""
    return {"world": request["world"], "shape": request["shape"] or ELEMENTS[0]}


def planned(
    run: runner.Run, octree: Octree, request: dict[str, Any]
) -> MorphJob | ComponentsJob | ResampleJob | ThinJob:
    """Return the planned job of a request."""
    from voxtool.files.lattices import unit_checked
    from voxtool.svo.sets.components import plan_fill_cavities, plan_keep_components
    from voxtool.svo.sets.morphology import plan_morph
    from voxtool.svo.sets.resample import DEFAULT_THRESHOLD, plan_resample
    from voxtool.svo.sets.thin import plan_thin

    if request["resample"]:
        threshold = DEFAULT_THRESHOLD if request["threshold"] is None else request["threshold"]
        placing = {name: request[name] for name in PLACING}
        for name in FILES:
            placing[name] = unit_checked(placing[name], octree)
        grid = placing.pop("like")
        return run.plan(plan_resample, octree, grid, threshold=threshold, **placing)
    for operation in MORPHOLOGY:
        if (radius := request[operation]) is not None:
            return run.plan(plan_morph, octree, operation, radius, **by_radius(request))
    run.on_device = False
    if request["thin"]:
        return run.plan(plan_thin, octree)
    if request["fill_cavities"]:
        return run.plan(plan_fill_cavities, octree)
    return run.plan(
        plan_keep_components, octree, request["keep"], min_size=request["min_size"] or 1,
        neighbours=neighbours_of(request),
    )  # fmt: skip


def facts_of(
    job: MorphJob | MorphWindowsJob | ComponentsJob | ResampleJob | ThinJob,
    before: int,
    result: Any,
) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    from voxtool.svo.sets.morphology import MorphJob
    from voxtool.svo.sets.resample import ResampleJob
    from voxtool.svo.sets.thin import ThinJob
    from voxtool.tiles.morphing import MorphWindowsJob

    if isinstance(job, (MorphJob, MorphWindowsJob)):
        names = ("operation", "radius", "world", "shape", "grid", "low")
        found = {name: job.describe()[name] for name in names}
    elif isinstance(job, ResampleJob):
        names = ("operation", "shape", "origin", "pitch", "threshold", "exact", "beyond")
        found = {name: job.describe()[name] for name in names}
    elif isinstance(job, ThinJob):
        found = {name: job.describe()[name] for name in ("operation", "neighbours")}
    else:
        found: dict[str, Any] = {"operation": job.plan.operation}
        if len(job.sizes):
            found["component_sizes"] = job.sizes.tolist()
    return {
        **found,
        "voxels_before": before,
        "voxels": result.count,
        "volume": result.count * result.grid.voxel_volume,
        "digest": result.digest(),
    }
