"""Commands that make an octree window by window if it does not fit in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.cli import runner
from voxtool.cli.options import flag, option, together

if TYPE_CHECKING:
    from collections.abc import Collection
    from contextlib import ExitStack

    from voxtool.svo.octree.content import OctreeContent
    from voxtool.svo.octree.octree import Octree
    from voxtool.tiles.octree import BlockOctree
    from voxtool.tiles.operations import OperationJob
    from voxtool.tiles.windows import WindowsJob

windows_options = together(
    option("--windows", ("auto", "never"),
        "auto: if the octree would take more than --max-memory, make it in windows, with the same "
        "content; never: refuse.", "auto"),
    flag("--resume", "Go on with the windows that a killed run left in FILE.windows."),
    flag("--no-keep", "Leave no windows if the run is killed or fails."),
)  # fmt: skip


def opened(run: runner.Run, name: str, stack: ExitStack) -> OctreeContent:
    """Return an octree whose nodes and attributes stay in its file, where that is possible."""
    from voxtool.files import open_svo

    octree: Any = run.stage("read octree", stack.enter_context, open_svo(name))
    return octree


def loaded(
    run: runner.Run, octree: OctreeContent, name: str, attributes: Collection[str] = ()
) -> Octree:
    """Return the octree of a file with this name in memory, with these attributes; the others stay
    in the file."""
    from voxtool.svo.octree.octree import in_memory

    with run.naming(name):
        return run.stage("read octree", in_memory, octree, run.max_memory, attributes)


def refuse_stdout(run: runner.Run) -> None:
    """Refuse windows without a file beside which they can wait."""
    if run.to_stdout and not run.only_plan:
        raise click.UsageError("windows wait beside the output: name a file with -o")


def make_in_windows(
    run: runner.Run, job: WindowsJob | OperationJob, resume: bool, no_keep: bool, **facts: Any
) -> BlockOctree:
    """Run a job in windows, and write the octree that they make together."""
    from voxtool.files import write_svo
    from voxtool.files.octrees.windows import Windows

    if run.only_plan:
        run.job(job, **facts)
    refuse_stdout(run)
    with Windows(
        str(run.output), job.request, job.plan.disk, resume=resume, keep=not no_keep
    ) as job.store:
        octree = run.job(job, **facts)
        run.write(write_svo, octree)
    return octree
