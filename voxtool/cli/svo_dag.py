"""voxtool svo-dag: equal subtrees of an octree stored once, and back."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import options, runner
from voxtool.cli.options import flag
from voxtool.files.formats import MERGED_FORMATS

if TYPE_CHECKING:
    from voxtool.svo.octree.content import OctreeContent


@click.command("svo-dag")
@click.argument("file")
@flag("--expand", "Write the octree that merged subtrees stand for.")
@runner.run_options(
    options.output_options(
        "OUT",
        "Its ending says the format.  Default FILE's name with .dag.svo.h5, with --expand "
        ".expanded.svo.h5, in this folder.",
    ),
    options.report_options,
)
def command(run: runner.Run, file: str, expand: bool) -> None:
    """Store equal subtrees of an octree FILE once (SVO 2.0), as `voxelize --dag` does.

    FILE is .svo.h5 or .svo.xml, or - for stdin. All commands read merged subtrees. The voxels, the
    digest and the set digest stay the same.

    \b
    Examples:
      voxtool svo-dag bunny.svo.h5 -o small.svo.h5
      voxtool voxelize bunny.obj --dag -o - | voxtool svo-dag - --expand -o bunny.svo.xml
    """
    from voxtool.files import SVO_FORMATS, open_svo, read_svo, write_svo
    from voxtool.svo.dag.merged import MergedOctree
    from voxtool.svo.sets.attribute_transfer import lost

    extension = "expanded.svo.h5" if expand else "dag.svo.h5"
    formats = SVO_FORMATS if expand else MERGED_FORMATS
    run.to(file, options.output_of(file, extension), formats)
    with run, ExitStack() as stack:
        if expand:
            octree = run.stage("read octree", read_svo, file)
        else:
            octree: Any = run.stage("read octree", stack.enter_context, open_svo(file))
            if not isinstance(octree, MergedOctree):
                whole, octree = octree, run.stage("merge subtrees", MergedOctree.of, octree)
                run.notes += lost([whole])
        run.write(write_svo, octree)
    run.report(report_line(octree, run.size), lambda: facts_of(octree))


def report_line(octree: OctreeContent, size: str) -> str:
    """Return the line of the report, of an output of this size."""
    info = octree.summary()
    if "subtrees" not in info:
        return f"{info['nodes']:,} nodes in {size}"
    return f"{info['nodes']:,} nodes became {info['subtrees']:,} subtrees in {size}"


def facts_of(octree: OctreeContent) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    names = ("nodes", "bricks", "memory_bytes", "subtrees", "merged_bytes")
    info = octree.summary()
    return {name: info[name] for name in names if name in info} | {"digest": octree.digest()}
