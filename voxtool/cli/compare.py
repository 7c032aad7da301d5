"""voxtool compare: what two octrees have in common."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options, runner
from voxtool.cli.in_windows import loaded, opened
from voxtool.cli.info import place, table
from voxtool.errors import CheckError
from voxtool.files.formats import EXPORTS, OCTREE_FORMATS

if TYPE_CHECKING:
    from collections.abc import Iterator


@click.command("compare")
@click.argument("first")
@click.argument("second")
@runner.job_options(
    "FILE",
    "It gets the voxels that are set in only one of the two, as an octree or an export.  "
    "[default: nowhere]",
    *OCTREE_FORMATS, *EXPORTS,
)  # fmt: skip
def command(run: runner.Run, first: str, second: str) -> None:
    """Compare the voxels of two octrees; exit with 1 if they differ.

    FIRST and SECOND are files that voxelize wrote, of one lattice; one of them may be - for stdin.
    Volumes and boxes are in the mesh's own units. What lies beyond a grid is not set; mode, fill
    and refinement do not count.

    \b
    Examples:
      voxtool compare bunny.svo.h5 bunny.svo.h5 --json
      voxtool voxelize bunny.obj --dim 128 -o - | voxtool compare bunny.svo.h5 -
    """
    from voxtool.files import SVO_FORMATS, export, write_svo
    from voxtool.svo.sets.booleans import combine
    from voxtool.svo.sets.compare import plan_compare

    if first == second == "-":
        raise options.input_twice("FIRST", "SECOND")
    if run.output:
        run.to(first, run.output, (*SVO_FORMATS, *EXPORTS))
    with run, ExitStack() as stack:
        octrees = [loaded(run, opened(run, name, stack), name) for name in (first, second)]
        found = run.job(run.plan(plan_compare, *octrees))
        if run.output:
            apart = combine([found.first, found.second], device=run.device)
            run.write(export if run.file_format in EXPORTS else write_svo, apart)
    summary = found.summary()
    if run.as_json:
        run.print_facts(summary)
    elif not run.quiet:
        for line in lines_of(summary, octrees[0].units):
            click.echo(line, err=run.to_stdout)
    run.finish()
    if not found.equal:
        apart = found.first.count + found.second.count
        names = " and ".join(map(options.shown, (first, second)))
        raise CheckError(f"{names} differ in {apart:,} voxels")


def lines_of(summary: dict[str, Any], units: str) -> Iterator[str]:
    """Yield the lines of a comparison."""
    yield from table(
        (name.replace("_", " "), _line(summary[name], units))
        for name in ("only_first", "only_second", "both")
    )
    yield f"{'jaccard':<12} {summary['jaccard']:.9g}"


def _line(part: dict[str, Any], units: str) -> str:
    if not part["voxels"]:
        return "0 voxels"
    low, high = part["bounds"]
    unit = f" {units}^3" if units else ""
    return (
        f"{part['voxels']:,} voxels, volume {part['volume']:.9g}{unit}, "
        f"from ({place(low)}) to ({place(high)})"
    )
