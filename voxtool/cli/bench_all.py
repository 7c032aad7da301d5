"""voxtool bench all: every bench for each model, and one page to decide from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import click

from voxtool.cli import options, reports


@click.command("all")
@click.argument("models", nargs=-1, required=True)
@reports.report_options
@click.option("--quick", is_flag=True, help="Few and small settings: seconds, not minutes.")
@click.option(
    "--repeat", type=click.IntRange(1), metavar="N",
    help="Runs after a warm-up; medians are compared.  [default: 3, and up to 9 of what is short; "
    "2 with --quick]",
)  # fmt: skip
@click.option(
    "--peers", is_flag=True,
    help="VTK, Open3D, libigl, scikit-image and trimesh on the same work, if installed.",
)  # fmt: skip
@click.option("--scalar", metavar="NAME", help="Of volumes; as of `voxtool tet-build`.")
@click.option("--component", metavar="NAME", help="Of volumes; as of `voxtool tet-build`.")
@options.device_option
@options.quiet_option
@options.json_option
def command(
    models: tuple[str, ...],
    quick: bool,
    repeat: int | None,
    peers: bool,
    scalar: str | None,
    component: str | None,
    device: str | None,
    quiet: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Measure all that voxtool does with MODELS, and print or draw error against run time.

    Triangle meshes are voxelized, surfaces extracted, and distance fields built and asked; meshes
    of volume cells are drawn. Times are in s, of work in memory whose kernels are compiled; errors
    of voxels and surfaces in diagonals of the model, of fields in sides of their cube, of pictures
    in colours from 0 to 1. Printed is what to choose; -o writes the page with the charts. With a
    budget the exit code is 1 where nothing that was measured meets it.

    \b
    Examples:
      voxtool bench all bunny.obj volume.vtu --scalar density --quick -o report
      voxtool bench all bunny.obj --quick --budget-error 0.5
    """
    from voxtool.bench.sweep import QUICK, Sweep

    asked = QUICK if quick else Sweep(fills=("auto", "parity"), seconds=0.2)
    asked = replace(
        asked, scalar=scalar, component=component, peers=peers, device=device,
        repeat=repeat or asked.repeat, seconds=0 if repeat else asked.seconds,
    )  # fmt: skip
    reports.measure_and_report(models, asked, None, as_json=as_json, **more)
