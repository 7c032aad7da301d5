"""voxtool bench voxelize: how long, how large, and beside whom."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import FILLS, FITS, MODES
from voxtool.cli import options, reports
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.bench.voxelize import Row

STAGES = ("active nodes", "octree", "surface26", "surface6", "crossings", "rows",
          "refine open rows", "fill")  # fmt: skip
SAID = (*STAGES, "survey", "read back")  # the others are winding numbers near holes, and flood
SHORT = {"active nodes": "active", "surface26": "26-sep", "surface6": "6-sep",
         "crossings": "cross", "refine open rows": "refine"}  # fmt: skip


@click.command("voxelize")
@options.bench_options("64,128,256,512,1024,2048", "VTK (solid), Open3D (surface26) and trimesh")
@click.option(
    "--modes",
    type=options.List(click.Choice(MODES)),
    metavar="MODE,...",
    default="surface26,surface6,solid",
    show_default=True,
    help="As of `voxtool voxelize`.",
)
@click.option(
    "--fills",
    type=options.List(click.Choice(FILLS)),
    metavar="RULE,...",
    default="auto",
    show_default=True,
    help="What is inside of solids, as --fill of `voxtool voxelize`.",
)
@click.option(
    "--fit",
    type=click.Choice(FITS),
    default="uniform",
    show_default=True,
    help="stretch: as the thesis's tables, eq. (5.1).",
)
@reports.samples_option
@reports.report_options
def command(
    models: tuple[str, ...],
    dims: list[int],
    modes: list[str],
    fills: list[str],
    fit: str,
    samples: int,
    repeat: int,
    peers: bool,
    device: str | None,
    as_json: bool,
    **more: Any,
) -> None:
    """Time each stage of voxelizing MODELS.

    Stages (other: flood, and winding numbers near holes), device (their sum with survey and read
    back, by the device's events), host (what Python adds) and memory (mesh in memory to octree in
    memory, and the runs' spread in %) are in ms; command (the whole command in a process of its
    own) is in s and its peak of memory in MB. With -o or a budget, the error is measured instead,
    and set against the time.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench voxelize bunny.obj --dims 512,1024 --modes solid --peers
      voxtool bench voxelize bunny.obj --dims 64 --modes solid --fills parity,winding,flood
    """
    if reports.wanted(more):
        from voxtool.bench.sweep import Sweep

        asked = Sweep(
            dims=tuple(dims), modes=tuple(modes), fills=tuple(fills), fit=fit, samples=samples,
            repeat=repeat, peers=peers, device=device,
        )  # fmt: skip
        reports.measure_and_report(models, asked, ("voxelize",), as_json=as_json, **more)
        return

    from voxtool.bench.voxelize import sweep
    from voxtool.opencl import open_device

    info = open_device(device).info
    rows = sweep(
        list(models), dims, modes, fills=fills, fit=fit, repeat=repeat, device=str(info.index),
        with_peers=peers,
    )  # fmt: skip
    if as_json:
        options.print_bench(info, rows, fit=fit, repeat=repeat)
        return
    model = None
    compared = False
    for row in rows:
        if model is None:
            click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
        if row.model != model:
            model = row.model
            click.echo(f"\n{model}: {row.triangles:,} triangles, fit {fit}\n{header()}")
        click.echo(line(row))
        compared |= bool(row.peers)
    if peers and not compared:
        options.tell(
            "no peer does these modes here: pip install vtk (solid), open3d (surface26), scipy "
            "(for trimesh)"
        )


def header() -> str:
    stages = "".join(f"{SHORT.get(s, s):>8}" for s in STAGES)
    totals = "  device   host  memory +-%  command  peak MB  octree kB          voxels"
    return f" dim mode      fill   {stages}   other{totals}"


def line(row: Row) -> str:
    stages = "".join(
        f"{1e3 * row.stages[s]:8.2f}" if s in row.stages else f"{'-':>8}" for s in STAGES
    )
    other = sum(seconds for stage, seconds in row.stages.items() if stage not in SAID)
    rest = f"{1e3 * other:8.2f}" if other else f"{'-':>8}"
    peers = "".join(
        f"  {name}: {row.peers[name]:.3f} s, {ratio:.1f} times"
        for name, ratio in row.ratios.items()
    )
    return (
        f"{row.dim:>4} {row.mode:<9} {row.fill.replace('none', '-'):<7}{stages}{rest}"
        f"{1e3 * row.device:8.2f}{1e3 * row.host:7.2f}"
        f"{1e3 * row.memory:8.2f}{100 * row.spread:4.0f}{row.command:9.2f}{row.peak / 1e6:9.0f}"
        f"{row.octree_bytes / 1e3:11,.0f}{row.voxels:16,}{peers}"
    )
