"""voxtool bench extract: cubes, times, memory and error, and beside whom."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import MARCHING_CUBES, STYLE_ALIASES, STYLES
from voxtool.cli import options, reports
from voxtool.errors import count_of
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.bench.extract import Row

STAGES = ("tiles", "samples", "classify", "lost voxels", "vertices", "relax", "histopyramid",
          "quads", "triangles")  # fmt: skip
SHORT = {"lost voxels": "lost", "histopyramid": "pyramid", "triangles": "faces"}


@click.command("extract")
@options.bench_options("128,256,512,1024,2048", "VTK and scikit-image (marching cubes)")
@click.option(
    "--styles",
    type=options.List(options.Alias(STYLES, STYLE_ALIASES)),
    metavar="STYLE,...",
    default=MARCHING_CUBES,
    show_default=True,
    help="As of `voxtool extract`, at their own levels.",
)
@click.option("--isovalue", type=float, default=0.5, show_default=True, help="Between 0 and 1.")
@click.option(
    "--samples",
    type=click.IntRange(1, 100_000_000),
    default=options.SAMPLES,
    show_default=True,
    help="Points on each surface at which the error is measured.",
)
@reports.report_options
def command(
    models: tuple[str, ...],
    dims: list[int],
    styles: list[str],
    isovalue: float,
    repeat: int,
    samples: int,
    peers: bool,
    device: str | None,
    as_json: bool,
    **more: Any,
) -> None:
    """Time each stage of extracting surfaces from the solid octrees of MODELS; measure the error.

    First cubes, in % of the grid's samples: those with a corner in a node, which the thesis looks
    at (nodes), those in the tiles that are looked at 64 at once (tiles), and those that are cut and
    looked at one by one (cut). Stages, device (their sum), host (what Python adds) and memory
    (octree in memory to surface in memory, and the runs' spread in %) are in ms; command (the whole
    command in a process of its own, to a PLY) is in s and its peak of memory in MB; RMS and largest
    distance between surface and model in voxels. A peer's time has that of its dense grid in it.

    \b
    Examples:
      voxtool bench extract bunny.obj --dims 256,512
      voxtool bench extract bunny.obj --dims 512,1024 --styles marching-cubes,surface-nets --peers
    """
    if reports.wanted(more):
        from voxtool.bench.sweep import Sweep

        asked = Sweep(
            dims=tuple(dims), styles=tuple(styles), isovalue=isovalue, samples=samples,
            repeat=repeat, peers=peers, device=device,
        )  # fmt: skip
        reports.measure_and_report(models, asked, ("extract",), as_json=as_json, **more)
        return

    from voxtool.bench.extract import sweep
    from voxtool.opencl import open_device

    info = open_device(device).info
    rows = sweep(
        list(models), dims, styles, isovalue=isovalue, repeat=repeat, samples=samples,
        device=str(info.index), with_peers=peers,
    )  # fmt: skip
    if as_json:
        options.print_bench(info, rows, isovalue=isovalue, repeat=repeat, samples=samples)
        return
    model = None
    compared = False
    for row in rows:
        if model is None:
            click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
        if row.model != model:
            model = row.model
            about = f"isovalue {isovalue:g}, error at {count_of(samples, 'point')} a surface"
            click.echo(f"\n{model}: {about}\n{header()}")
        click.echo(line(row))
        compared |= bool(row.peers)
    if peers and not compared:
        options.tell("no peer is installed, or none of the styles is smooth: pip install vtk, "
                     "scikit-image")  # fmt: skip


def header() -> str:
    stages = "".join(f"{SHORT.get(s, s):>9}" for s in STAGES)
    totals = "   device    host  memory +-%  command  peak MB   triangles    RMS    max"
    return f" dim style   nodes %  tiles %   cut %{stages}{totals}"


def line(row: Row) -> str:
    whole = row.samples**3 / 100
    nodes = f"{row.cubes / whole:9.2f}" if row.cubes is not None else f"{'-':>9}"
    stages = "".join(
        f"{1e3 * row.stages[s]:9.2f}" if s in row.stages else f"{'-':>9}" for s in STAGES
    )
    peers = "".join(
        f"  {name}: {1e3 * row.peers[name]:.0f} ms, {ratio:.1f} times"
        for name, ratio in row.ratios.items()
    )
    voxels = row.error["voxels"]
    ways = (voxels["surface_to_reference"], voxels["reference_to_surface"])
    return (
        f"{row.dim:>4} {row.style:<6}{nodes}{row.tiles / whole:9.2f}{row.cut / whole:8.2f}{stages}"
        f"{1e3 * row.device:9.2f}{1e3 * row.host:8.2f}{1e3 * row.memory:8.2f}"
        f"{100 * row.spread:4.0f}{row.command:9.2f}{row.peak / 1e6:9.0f}{row.triangles:12,}"
        f"{max(way['rms'] for way in ways):7.2f}{max(way['max'] for way in ways):7.2f}{peers}"
    )
