"""voxtool bench: one command for each thing that is measured, and one for all of them.

Each command is a selection of benches and of the options that they read; all measure with one
engine and print alike.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from voxtool.bench.request import KINDS, QUICK, SETTINGS, TRANSFERS, Request
from voxtool.choices import (
    FILLS,
    FITS,
    METHODS,
    MODES,
    SEARCHES,
    SIGNS,
    STYLE_ALIASES,
    STYLES,
    VIEWS,
)
from voxtool.cli import bench_compare, options, reports
from voxtool.cli.options import DIM, flag, option

if TYPE_CHECKING:
    from collections.abc import Callable

FULL = Request()


def _choices(names: tuple[str, ...]) -> dict[str, Any]:
    return {"type": options.List(click.Choice(names)), "metavar": "NAME,..."}


def _numbers(each: click.ParamType, metavar: str) -> dict[str, Any]:
    return {"type": options.List(each), "metavar": metavar}


COUNT = click.IntRange(1, 100_000_000)
OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {  # by fields of a Request
    "dims": ("Voxels along the longest side.", _numbers(DIM, "DIM,...")),
    "modes": ("Modes, as of `voxtool voxelize`.", _choices(MODES)),
    "fills": ("Fill rules of solids, as of `voxtool voxelize`; surfaces take the first.",
              _choices(FILLS)),
    "fit": ("stretch: eq. (5.1) of [voCCeL], as its tables.", {"type": click.Choice(FITS)}),
    "samples": ("Points on each surface at which errors are measured.", {"type": COUNT}),
    "styles": ("Styles, as of `voxtool extract`, at their own levels.",
               _numbers(options.Alias(STYLES, STYLE_ALIASES), "NAME,...")),
    "isovalue": ("Between 0 and 1.", {"type": float}),
    "tolerances": ("Errors that leaves may have, in sides of the cube.",
                   _numbers(click.FloatRange(min=0), "LENGTH,...")),
    "levels": ("Finest levels of fields, as --max-level of `voxtool adf-build`.",
               _numbers(click.IntRange(1, 21), "LEVEL,...")),
    "band": ("As of `voxtool adf-build`.  [default: everywhere]", {"type": float}),
    "sign": ("As of `voxtool adf-build`.  [default: by the mesh]", {"type": click.Choice(SIGNS)}),
    "points": ("Points at which distances are asked for.", {"type": COUNT}),
    "kinds": ("Points: random, or along rays.", _choices(KINDS)),
    "searches": ("How the leaf of a point is found, as of `voxtool adf-query`.",
                 _choices(SEARCHES)),
    "grids": ("Voxels along the longest side of dense grids.", _numbers(DIM, "DIM,...")),
    "sizes": ("Pixels along each side; errors are of the largest.",
              _numbers(click.IntRange(1, 8192), "PIXELS,...")),
    "pixels": ("Pixels along each side at which errors are measured.", {"type": COUNT}),
    "view": ("As of `voxtool render`; orthographic.", {"type": click.Choice(VIEWS)}),
    "methods": ("As of `voxtool render`.", _choices(METHODS)),
    "integrators": ("As of `voxtool render`.", _numbers(click.STRING, "NAME,...")),
    "transfers": ("Transfer functions: five colours, times as opaque, or two slabs.",
                  _choices(TRANSFERS)),
    "scalar": ("As of `voxtool tet-build`.", {"metavar": "NAME"}),
    "component": ("As of `voxtool tet-build`.", {"metavar": "NAME"}),
}  # fmt: skip
ALIASES = {"levels": ("--max-level",), "sizes": ("--size",)}
COMMANDS = {
    "all": """Measure everything that voxtool does with MODELS: error against run time.

    Triangle meshes are voxelized, surfaces extracted, and distance fields built and asked; volume
    meshes are drawn. -o writes a page with charts and JSON.

    \b
    Examples:
      voxtool bench all bunny.obj volume.vtu --scalar density --quick -o report
      voxtool bench all bunny.obj --quick --budget-error 0.5
    """,
    "voxelize": """Measure voxelizing MODELS: error of the boundary, time, memory and stages.

    \b
    Examples:
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench voxelize bunny.obj --dims 512,1024 --modes solid --peers
      voxtool bench voxelize bunny.obj --dims 64 --modes solid --fills parity,winding,flood
    """,
    "extract": """Measure extracting surfaces from the solid octrees of MODELS.

    \b
    Examples:
      voxtool bench extract bunny.obj --dims 256,512
      voxtool bench extract bunny.obj --dims 512,1024 --styles marching-cubes,surface-nets --peers
    """,
    "adf": """Measure distance fields of MODELS: their build, hash and queries.

    Exact distances are measured at the same points.

    \b
    Examples:
      voxtool bench adf bunny.obj --tolerances 1e-2,1e-3 --levels 7
      voxtool bench adf bunny.obj --tolerances 1e-3 --band 0.01 --peers
    """,
    "distance": """Measure exact distances to MODELS, at points and on dense grids.

    Errors are measured in rational arithmetic at a few points.

    \b
    Examples:
      voxtool bench distance bunny.obj --points 1000 --grids 16
      voxtool bench distance bunny.obj --quick --peers
    """,
    "tets": """Measure pictures of MODELS, which are volume meshes, against pictures in float64.

    \b
    Examples:
      voxtool bench tets volume.vtu --scalar density --sizes 128 --peers
      voxtool bench tets volume.vtu --scalar density --sizes 64 --transfers x1 --methods raycast
    """,
}
UNITS = """
    Times are medians after a warm-up, in memory, kernels compiled; ± is their spread. Errors are in
    diagonals of the model (surfaces), sides of the field's cube (distances) or colours from 0 to 1
    (pictures). * marks the Pareto front. With a budget the exit code is 1 if nothing measured meets
    it.
"""


@click.group("bench")
def command() -> None:
    """Measure voxtool: error against run time, beside other tools on the same work.

    Times are in s, ms or µs, memory in MB.

    \b
    Examples:
      voxtool bench all bunny.obj --quick -o report
      voxtool bench voxelize bunny.obj --dims 64,512
      voxtool bench compare old/report.json new/report.json
    """


def _option(name: str) -> Callable[[Any], Any]:
    """The option of a field of a Request, whose default is None: the request's own."""
    words, about = OPTIONS[name]
    default = getattr(FULL, name)
    if default is not None and name != "band":
        each = default if isinstance(default, tuple) else (default,)
        words += f"  [default: {','.join(map(str, each))}]"
    return click.option(f"--{name}", *ALIASES.get(name, ()), name, help=words, **about)


def _bench(bench: str, selection: tuple[str, ...] | None) -> click.Command:
    """The command of a bench."""
    names = tuple(dict.fromkeys(n for one in selection or SETTINGS for n in SETTINGS[one]))

    def measure(
        models: tuple[str, ...], quick: bool, repeat: int | None, peers: bool,
        device_name: str | None, quiet: bool, **given: Any,
    ) -> None:  # fmt: skip
        chosen = {
            name: tuple(value) if isinstance(value, list) else value
            for name in names
            if (value := given.pop(name)) is not None
        }
        request = replace(QUICK if quick else FULL, **chosen, peers=peers, device=device_name)
        if repeat:
            request = replace(request, repeat=repeat, seconds=0.0)
        reports.measure_and_report(models, request, selection, words=sys.argv[1:], **given)

    head, examples = COMMANDS[bench].split("\n\n    \b", 1)
    measure.__doc__ = f"{head}\n{UNITS}\n    \b{examples}"
    decorate = options.together(
        click.argument("models", nargs=-1, required=True),
        flag("--quick", "Few and small settings: seconds, not minutes."),
        option("--repeat", click.IntRange(1), "Runs after a warm-up.  [default: 3, and up to 9 of "
               "short work; 2 with --quick]", metavar="N"),
        flag("--peers", "Other tools on the same work, those that are installed: VTK, Open3D, "
             "libigl, scikit-image, trimesh."),
        *map(_option, names),
        reports.report_options,
        options.device_option,
        options.quiet_option,
        options.json_option,
    )  # fmt: skip
    return click.command(bench)(decorate(measure))


for _name in COMMANDS:
    command.add_command(_bench(_name, None if _name == "all" else (_name,)))
command.add_command(bench_compare.command)
