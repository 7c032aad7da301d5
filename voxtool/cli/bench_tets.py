"""voxtool bench tets: how long and how wrong pictures of volumes are, and beside whom."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import METHODS, VIEWS
from voxtool.cli import options, reports
from voxtool.version import __version__

if TYPE_CHECKING:
    from voxtool.bench.tets import Frame

INTEGRATORS = ("linear", "average", "preintegrated", "sampled:1", "sampled:4", "sampled:16")
TRANSFERS = ("x1", "x10", "x100", "steps")
HEADER = "method              integrator      first ms  frame ms +-%        rms        max    times"


@click.command("tets")
@options.measure_options("VTK's ray caster with its linear integrator")
@click.option("--scalar", metavar="NAME", help="As of `voxtool tet-build`.")
@click.option("--component", metavar="NAME", help="As of `voxtool tet-build`.")
@click.option(
    "--size", type=click.IntRange(1, 8192), default=512, show_default=True, help="Pixels a side."
)
@click.option("--view", type=click.Choice(VIEWS), default="iso", show_default=True,
              help="As of `voxtool render`; orthographic.")  # fmt: skip
@click.option(
    "--every",
    type=click.IntRange(1),
    default=4,
    show_default=True,
    help="Errors are of every so many pixels, in both directions.",
)
@click.option(
    "--methods",
    type=options.List(click.Choice(METHODS)),
    metavar="METHOD,...",
    default=",".join(METHODS),
    show_default=True,
    help="As of `voxtool render`.",
)
@click.option(
    "--integrators",
    type=options.List(click.STRING),
    metavar="NAME,...",
    default=",".join(INTEGRATORS),
    show_default=True,
    help="As of `voxtool render`.",
)
@click.option(
    "--transfers",
    type=options.List(click.Choice(TRANSFERS)),
    metavar="NAME,...",
    default=",".join(TRANSFERS),
    show_default=True,
    help="Transfer functions: a ramp of five colours, times as opaque; or two slabs with jumps.",
)
@reports.report_options
def command(
    models: tuple[str, ...],
    scalar: str | None,
    component: str | None,
    size: int,
    view: str,
    every: int,
    methods: list[str],
    integrators: list[str],
    transfers: list[str],
    repeat: int,
    peers: bool,
    device: str | None,
    as_json: bool,
    **more: Any,
) -> None:
    """Time drawing MODELS, meshes of volume cells, and measure the pictures' errors.

    First is from textures in memory to the first picture, frame a later picture (and the runs'
    spread in %), in ms, with kernels compiled. RMS and the largest error are of premultiplied red,
    green, blue and alpha, 0 to 1, against a picture in float64 of the mesh as it is, over the
    pixels with something in them. A peer is measured as it is shown, in 8 bits, and by what its
    rays find, in float32; times says how many times the first line's time a frame takes. With
    --json times are in s.

    \b
    Examples:
      voxtool bench tets volume.vtu --scalar density --size 128 --peers
      voxtool bench tets volume.vtu --scalar density --size 64 --transfers x1,x100 --methods raycast
    """
    if reports.wanted(more):
        from voxtool.bench.sweep import Sweep

        asked = Sweep(
            sizes=(size,), view=view, pixels=-(-size // every), methods=tuple(methods),
            integrators=tuple(integrators), transfers=tuple(transfers), scalar=scalar,
            component=component, repeat=repeat, peers=peers, device=device,
        )  # fmt: skip
        reports.measure_and_report(models, asked, ("tets",), as_json=as_json, **more)
        return

    from voxtool.bench.peers import missing
    from voxtool.bench.tets import sweep
    from voxtool.opencl import open_device

    info = open_device(device).info
    if peers:
        for package in missing("vtk"):
            options.tell(f"peer {package} is not installed: pip install {package}")
    rows = sweep(
        list(models), scalar, component, size=size, view=view, every=every, methods=methods,
        integrators=integrators, transfers=transfers, repeat=repeat, device=str(info.index),
        with_peers=peers,
    )  # fmt: skip
    if as_json:
        options.print_bench(
            info, rows, component=component, size=size, view=view, every=every, repeat=repeat
        )
        return
    model = None
    for row in rows:
        if model is None:
            click.echo(f"voxtool {__version__}; {info.name}, {info.platform} {info.driver}")
        if row.model != model:
            model = row.model
            click.echo(f"\n{model}: {row.cells:,} cells, {row.scalar}, {size} x {size}, {view}")
        about = f"{row.pixels:,} pixels, alpha to {row.alpha:.3g}"
        click.echo(f"\n{row.transfer}: {about}\n{HEADER}")
        for frame in (*row.frames, *row.peers):
            click.echo(line(frame, row.frames[0]))


def line(frame: Frame, unit: Frame) -> str:
    return (
        f"{frame.name:<20}{frame.integrator:<14}{1e3 * frame.first:10.1f}"
        f"{1e3 * frame.seconds:10.1f}{100 * frame.spread:4.0f}{frame.rms:11.2e}{frame.max:11.2e}"
        f"{frame.seconds / unit.seconds:9.2f}"
    )
