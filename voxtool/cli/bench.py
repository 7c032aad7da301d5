"""voxtool bench: how long, how large, and beside whom."""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING

import click

from voxtool.cli import options
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.bench.voxelize import Row

STAGES = ("active nodes", "octree", "surface26", "surface6", "crossings", "rows",
          "refine open rows", "fill")  # fmt: skip
SHORT = {"active nodes": "active", "surface26": "26-sep", "surface6": "6-sep",
         "crossings": "cross", "refine open rows": "refine"}  # fmt: skip


class NumberList(click.ParamType):
    """64,128,256."""

    name = "numbers"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> list[int]:
        if isinstance(value, list):
            return value
        words = str(value).split(",")
        if not all(w.strip().isdecimal() for w in words):
            self.fail(f"{value!r} is no list of numbers: write 64,128,256", param, ctx)
        return [int(w) for w in words]


@click.group("bench")
def command() -> None:
    """Measure voxtool, and its peers on the same work.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench voxelize bunny.obj --dims 512 --modes solid --peers --json
    """


@command.command("voxelize")
@click.argument("models", nargs=-1, required=True)
@click.option("--dims", type=NumberList(), default="64,128,256,512,1024,2048", show_default=True)
@click.option("--modes", default="surface26,surface6,solid", show_default=True)
@click.option(
    "--fit",
    type=click.Choice(["uniform", "stretch"]),
    default="uniform",
    show_default=True,
    help="stretch: as the thesis's tables, eq. (5.1).",
)
@click.option(
    "--repeat",
    type=click.IntRange(1),
    default=5,
    show_default=True,
    help="Runs after a warm-up; medians are printed.",
)
@click.option("--peers", is_flag=True, help="VTK (solid) and Open3D (surface26), if installed.")
@options.device_option
@options.json_option
def bench_voxelize(
    models: tuple[str, ...],
    dims: list[int],
    modes: str,
    fit: str,
    repeat: int,
    peers: bool,
    device: str | None,
    as_json: bool,
) -> None:
    """Time each stage of voxelizing MODELS; milliseconds, but command: seconds.

    device: sum of the stages by the device's events; host: what Python adds; memory: mesh in memory
    to octree in memory; command: the whole command in a process of its own, and its peak of memory.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench voxelize bunny.obj --dims 512,1024 --modes solid --peers
    """
    from voxtool.bench.voxelize import sweep
    from voxtool.opencl import open_device

    info = open_device(device).info
    rows = sweep(
        list(models), dims, modes.split(","), fit=fit, repeat=repeat, device=str(info.index),
        with_peers=peers,
    )  # fmt: skip
    if as_json:
        options.print_json(
            {
                "voxtool": __version__,
                "device": info.as_dict(),
                "machine": platform.machine(),
                "python": platform.python_version(),
                "fit": fit,
                "repeat": repeat,
                "rows": [row.as_dict() for row in rows],
            }
        )
        return
    click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
    model = None
    for row in rows:
        if row.model != model:
            model = row.model
            click.echo(f"\n{model}: {row.triangles:,} triangles, fit {fit}\n{header()}")
        click.echo(line(row))


def header() -> str:
    stages = "".join(f"{SHORT.get(s, s):>8}" for s in STAGES)
    return f" dim mode     {stages}  device   host  memory +-%  command  peak MB  octree kB      voxels"


def line(row: Row) -> str:
    stages = "".join(
        f"{1e3 * row.stages[s]:8.2f}" if s in row.stages else f"{'-':>8}" for s in STAGES
    )
    peers = "".join(
        f"  {name}: {row.peers[name]:.3f} s, {ratio:.1f} times"
        for name, ratio in row.ratios.items()
    )
    return (
        f"{row.dim:>4} {row.mode:<9}{stages}{1e3 * row.device:8.2f}{1e3 * row.host:7.2f}"
        f"{1e3 * row.memory:8.2f}{100 * row.spread:4.0f}{row.command:9.2f}{row.peak / 1e6:9.0f}"
        f"{row.octree_bytes / 1e3:11,.0f}{row.voxels:12,}{peers}"
    )
