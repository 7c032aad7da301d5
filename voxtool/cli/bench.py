"""voxtool bench: a group of one command for each thing that is measured."""

from __future__ import annotations

import click

from voxtool.cli import (
    bench_adf,
    bench_all,
    bench_compare,
    bench_extract,
    bench_tets,
    bench_voxelize,
)


@click.group("bench")
def command() -> None:
    """Measure voxtool, and its peers on the same work.

    Times are in ns, ms or s, memory in MB.

    \b
    Examples:
      voxtool bench all bunny.obj --quick -o report
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench extract bunny.obj --dims 512,1024 --peers
      voxtool bench adf bunny.obj --tolerances 1e-2,1e-3 --max-level 7
      voxtool bench tets volume.vtu --scalar density
    """


command.add_command(bench_all.command)
command.add_command(bench_compare.command)
command.add_command(bench_voxelize.command)
command.add_command(bench_extract.command)
command.add_command(bench_adf.command)
command.add_command(bench_tets.command)
