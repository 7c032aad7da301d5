"""voxtool combine: union, intersection, difference and exclusive or of octrees."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import OPERATIONS
from voxtool.cli import options, runner
from voxtool.cli.in_windows import loaded, make_in_windows, opened, windows_options
from voxtool.cli.options import option
from voxtool.files.formats import EXPORTS, OCTREE_FORMATS

if TYPE_CHECKING:
    from voxtool.svo.octree.content import OctreeContent


@click.command("combine")
@click.argument("octrees", nargs=-1, required=True)
@option("--op operation", OPERATIONS,
    "union: set in one; intersection: set in all; difference: set in the first and in no other; "
    "xor: set in an odd number of them.", OPERATIONS[0])  # fmt: skip
@windows_options
@runner.job_options(
    "FILE",
    "Its ending says the format, of an octree or of an export (voxtool export -h).  Default the "
    "first name with the operation and .svo.h5, in this folder.",
    *OCTREE_FORMATS, *EXPORTS,
)  # fmt: skip
def command(
    run: runner.Run, octrees: tuple[str, ...], operation: str, windows: str, resume: bool,
    no_keep: bool,
) -> None:  # fmt: skip
    """Combine the voxels of OCTREES of one lattice.

    OCTREES are files that voxelize wrote; one of them may be - for stdin. Their voxels must have
    one size, and their origins be whole numbers of voxels apart: voxelize one of them with
    --lattice, naming the other. The grid of the result holds all of theirs, and its octree has a
    leaf wherever a block is wholly set or empty.

    \b
    Examples:
      voxtool combine bunny.svo.h5 box.svo.h5 --op difference -o part.svo.h5
      voxtool voxelize open.obj --lattice bunny.svo.h5 -o - | voxtool combine bunny.svo.h5 -
    """
    from voxtool.files import SVO_FORMATS, export, open_svo, write_svo
    from voxtool.svo.sets.attribute_transfer import check_kept, kept_of
    from voxtool.svo.sets.booleans import plan_combine
    from voxtool.tiles.combining import combine_windows

    if octrees.count("-") > 1:
        raise click.UsageError("only one of OCTREES can be stdin: name files for the others")
    default = options.output_of(octrees[0], f"{operation}.svo.h5")
    run.to(", ".join(octrees), default, (*SVO_FORMATS, *EXPORTS))
    with run, ExitStack() as stack:
        content = [opened(run, name, stack) for name in octrees]
        job = run.plan(plan_combine, content, operation)
        parts = None
        if windows != "never" and run.file_format == "svo.h5":
            parts = run.stage("plan windows", combine_windows, job, content)
        if parts:
            octree: Any = make_in_windows(run, parts, resume, no_keep)
        else:
            if not run.only_plan:
                sources = job.sources
                check_kept(sources, run.max_memory)
                kept, count = kept_of(sources), len(sources)
                job.octrees = [
                    loaded(run, octree, name, kept if number < count else ())
                    for number, (octree, name) in enumerate(zip(content, octrees, strict=True))
                ]
            octree = run.job(job)
            run.write(export if run.file_format in EXPORTS else write_svo, octree)
    text = f"{operation}, {octree.count:,} voxels in {run.size}"
    with ExitStack() as stack:
        if parts and run.as_json:  # for its digests
            octree = stack.enter_context(open_svo(str(run.output)))
        run.report(text, lambda: facts_of(octree, operation))


def facts_of(octree: OctreeContent, operation: str) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    grid = octree.grid
    return {
        "operation": operation,
        **{name: list(getattr(grid, name)) for name in ("shape", "origin", "pitch")},
        "voxels": octree.count,
        "volume": octree.count * grid.voxel_volume,
        "bricks": len(octree.bricks),
        "digest": octree.digest(),
        "set_digest": octree.set_digest(),
    }
