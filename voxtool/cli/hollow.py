"""voxtool hollow: a solid made hollow, with drain holes, for printing."""

from __future__ import annotations

from typing import Any

import click

from voxtool.cli import runner
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import POSITIVE, Parsed, numbers_of, option, together
from voxtool.cli.repair import execute, file_options, mesh_options, result_options

DRAIN = Parsed(
    "drain", lambda text: numbers_of(text, 4), " is no drain: write its place and radius, 0,1.5,2,3"
)


@click.command("hollow")
@mesh_argument("hollow", "obj")
@together(
    option("--wall", POSITIVE, "Thickness of the wall, in world units; 2 voxels at least.",
        metavar="LENGTH", required=True),
    option("--drain drains", DRAIN,
        "A hole to the cavity, from the surface at the place nearest to this one, with this "
        "radius, in world units; may be repeated.", metavar="X,Y,Z,R", multiple=True),
    mesh_options,
    result_options,
)  # fmt: skip
@file_options("hollow")
def command(run: runner.Run, mesh: str, wall: float, **request: Any) -> None:
    """Make a triangle MESH hollow for printing: voxtool repair, with a cavity and drain holes.

    The outer surface is that of voxtool repair; a cavity lies wherever MESH is thicker than twice
    the wall, but for cavities smaller than a cube of the wall's side. Lengths are in world units.
    The report says how thin the wall is between cavity and outside, and which cavities have no
    drain.

    \b
    Examples:
      voxtool hollow bunny.obj --wall 0.05 -o print.stl
      voxtool hollow bunny.obj --wall 0.05 --drain 0,0,0,0.03 --dim 200 --check
    """
    execute(run, mesh, "hollow", shell=wall, **request)
