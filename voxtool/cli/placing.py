"""Options that place a grid, and what they do."""

from __future__ import annotations

import string
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import FITS, LENGTH_UNITS
from voxtool.cli.options import Parsed, numbers_of, option, positive_of, together
from voxtool.errors import VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from voxtool.adf.field.field import DistanceField
    from voxtool.cli.options import Decorator
    from voxtool.cli.runner import Run
    from voxtool.files.lattices import PlacedMesh
    from voxtool.mesh.mesh import Mesh
    from voxtool.svo.octree.content import OctreeContent

OWN = ("origin", "shape", "spacing")  # options that give a grid by its own numbers
FILES = ("like", "lattice")  # options that name a file with a grid
BOX_WORDS = 6
VOXELS = "vox"  # the unit of a length in voxels


def shape_of(text: str) -> tuple[int, ...]:
    """Return three whole numbers, which commas separate, or one for all three."""
    numbers = tuple(map(int, text.split(",")))
    if len(numbers) not in (1, 3):
        raise ValueError
    return numbers if len(numbers) == 3 else numbers * 3


class BoxOption(click.Option):
    """An option that takes a box as one word with commas, or as six words."""

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        super().add_to_parser(parser, ctx)
        for name in self.opts:
            taken = parser._long_opt[name]
            process = taken.process

            def take(value: str, state: Any, process: Any = process) -> None:
                if "," not in value:
                    more = BOX_WORDS - 1
                    value = ",".join([value, *state.rargs[:more]])
                    del state.rargs[:more]
                process(value, state)

            taken.process = take


def length_of(text: str) -> tuple[float, str]:
    """Return a positive number and its unit: of LENGTH_UNITS, VOXELS, or "" for the world's."""
    number = text.rstrip(string.ascii_letters)
    unit = text[len(number) :]
    if unit not in ("", VOXELS, *LENGTH_UNITS):
        raise ValueError
    return positive_of(number), unit


def in_world(length: tuple[float, str], octree: OctreeContent) -> float:
    """Return the length of an option in the world units of an octree."""
    from voxtool.units import factor

    number, unit = length
    if unit == VOXELS:
        return number * max(octree.grid.pitch)
    if unit and not octree.units:
        raise VoxtoolError(f"{number:g}{unit}: the octree names no unit: give world units")
    return number * float(factor(unit, octree.units))


LENGTH = Parsed("length", length_of, " is no length: write 0.01 (world units), 0.5vox or 2mm")
POINT = Parsed("point", lambda text: numbers_of(text, 3), " is no point: write 0,1.5,-2")
mesh_origin = option(
    "--origin", POINT,
    "Subtract this point from the vertices: .ply, .stl and .glb hold float32, which is too little "
    "far from 0.",
    metavar="X,Y,Z",
)  # fmt: skip
SHAPE = Parsed("shape", shape_of, " is no shape: write 256, or 256,256,128")
SPACING = Parsed(
    "spacing",
    lambda text: numbers_of(text, 3) if "," in text else numbers_of(text, 1)[0],
    " is no size of a voxel: write 0.5, or 0.5,0.5,2",
)
BOX = Parsed(
    "box", lambda text: numbers_of(text, BOX_WORDS), " is no box: write 0,0,0,1,1,1 or 0 0 0 1 1 1"
)


def bbox_option(about: str) -> Decorator:
    """Add --bbox."""
    return option("--bbox", BOX, about, metavar="X0,Y0,Z0,X1,Y1,Z1", cls=BoxOption)


def file_options(
    whose: str = "Use ", own: str = "the mesh's own extent, so that octrees combine without loss"
) -> Decorator:
    """Add --like and --lattice."""
    return together(
        option("--like", str,
            f"{whose}the grid of another octree, or of an image or array that `voxtool import` "
            "reads.", metavar="FILE"),
        option("--lattice", str,
            f"{whose}the voxels of such a grid, with {own}.", metavar="FILE"),
    )  # fmt: skip


lattice_options = together(
    bbox_option("Box that the grid covers, in world units, instead of the mesh's; or six words."),
    file_options(),
    option("--origin", POINT, "With --shape and --spacing: the low corner of the grid.",
        metavar="X,Y,Z"),
    option("--shape", SHAPE, "Voxels along each axis.", metavar="N|NX,NY,NZ"),
    option("--spacing", SPACING, "Size of a voxel, in world units: one number or three.",
        metavar="S"),
)  # fmt: skip


def check_placing(placing: Mapping[str, Any]) -> None:
    """Refuse options that place the grid in two ways."""
    names = [name for name, value in placing.items() if value not in (None, FITS[0])]
    given = [f"--{name}" for name in names]
    own = [f"--{name}" for name in OWN if name in names]
    if own and len(own) < len(OWN):
        raise click.UsageError(
            "--origin, --shape and --spacing go together: give all three, or --dim around the mesh"
        )
    if own and len(given) > len(OWN):
        others = " and ".join(name for name in given if name not in own)
        raise click.UsageError(f"--origin, --shape and --spacing set the grid: drop {others}")
    for name, rest in (("--like", ()), ("--lattice", ("--lattice", "--bbox", "--margin"))):
        others = [one for one in given if one not in (name, *rest)]
        if name in given and others:
            what = "grid" if name == "--like" else "voxels"
            raise click.UsageError(f"{name} sets the {what}: drop {' and '.join(others)}")
    if {"--dim", "--pitch"} <= set(given):
        raise click.UsageError("--dim and --pitch both set the voxel size: drop one of them")
    if "--fit" in given and set(given) - {"--fit", "--dim"}:
        raise click.UsageError(
            "--fit stretch goes with --dim alone: drop --pitch, --bbox, --margin"
        )


def placed(run: Run, mesh: Mesh, placing: Mapping[str, Any]) -> PlacedMesh:
    """Return a mesh in the grid that the options place, or around it where they do not say; note
    whether it was scaled."""
    from voxtool.files.lattices import placed
    from voxtool.grid import Grid

    fit = {name: value for name, value in placing.items() if name not in (*OWN, *FILES)}
    grid, lattice = (placing[name] for name in FILES)
    if grid:
        fit = {}
    elif placing["shape"]:
        grid, fit = Grid(*(placing[name] for name in ("shape", "origin", "spacing"))), {}
    if grid or lattice or fit.get("bbox"):
        found = run.stage("read grid", placed, mesh, grid, lattice, **fit)
    else:
        found = placed(mesh, **fit)
    run.notes += filter(None, [found.scaled])
    return found


def in_unit_of(run: Run, mesh: Mesh, content: OctreeContent | DistanceField) -> Mesh:
    """Return a mesh in the unit of an octree or a field, and note whether it was scaled."""
    from voxtool.mesh.lengths import conversion, in_units

    found = in_units(mesh, content.units)
    what = "octree" if hasattr(content, "grid") else "field"
    run.notes += filter(None, [conversion(mesh, found, f"the {what}")])
    return found
