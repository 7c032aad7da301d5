"""voxtool tet-build: unstructured mesh of volume cells to the textures of a tetrahedral volume."""

from __future__ import annotations

import sys
import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import LAYOUTS
from voxtool.cli import options
from voxtool.errors import MemoryLimitError

if TYPE_CHECKING:
    from voxtool.tets.plan import VolumePlan
    from voxtool.tets.volume import TetVolume

# Bytes a tetrahedron of what the text compares with (section 4.1).
COMPARED = {
    "raycast": "table 5; 144 before it (Weiler et al. 2003), 119 and 912 for projection",
    "projection": "table 4, 119 with OpenGL's vertex attributes; 912 before it, 96 for ray casting",
    "hexahedra": "table 5 with two more faces",
}


@click.command("tet-build")
@click.argument("file")
@options.output_options("OUT", "Default FILE's name with .tet.h5, in this folder.")
@click.option(
    "--scalar",
    metavar="NAME",
    help="Array at points, or else at cells.  [default: the only one there is]",
)
@click.option(
    "--component", metavar="C", help="Of an array of vectors: x, y, z, 0, 1, ... or magnitude."
)
@click.option(
    "--layout",
    type=click.Choice(LAYOUTS),
    default="raycast",
    show_default=True,
    help="Textures for ray casting, for cell projection, or for hexahedra that stay whole.",
)
@click.option(
    "--merge-distance",
    type=float,
    metavar="D",
    default=0.0,
    help="Points within D of each other become one, in the mesh's own units.  [default: only "
    "points at one place]",
)
@options.format_option("tet.h5")
@click.option(
    "--plan",
    "only_plan",
    is_flag=True,
    help="Print what would be done, left out and needed, and stop.",
)
@click.option(
    "--max-memory",
    type=options.Bytes(),
    metavar="BYTES",
    help="Refuse to use more for the work (800M, 8G).  [default: what is free]",
)
@options.json_option
@options.quiet_option
@click.option("-v", "--verbose", is_flag=True, help="The time of each stage, on stderr.")
def command(
    file: str,
    output: str | None,
    no_clobber: bool,
    scalar: str | None,
    component: str | None,
    layout: str,
    merge_distance: float,
    file_format: str | None,
    only_plan: bool,
    max_memory: int | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Build the textures of a tetrahedral volume from a mesh of volume cells.

    FILE is .vtu, .vtk, .msh (Gmsh), .mesh (Medit), .inp (Abaqus, AVS UCD) or .ex2 (Exodus II).
    Hexahedra, wedges and pyramids are split. Lengths and scalars keep the mesh's own units.

    \b
    Examples:
      voxtool tet-build volume.vtu --scalar density
      voxtool tet-build volume.vtu --scalar momentum --component magnitude -o speed.tet.h5
    """
    started = time.perf_counter()
    from voxtool.files import TET_FORMATS, check_target, format_of, read_unstructured, write_tet
    from voxtool.memory import available_memory
    from voxtool.tets.textures import build_tet, plan_tet

    if output is None:
        output = options.output_of(file, "tet.h5")
    file_format = file_format or format_of(output, TET_FORMATS)
    if not only_plan:
        if output != "-":
            check_target(output, not no_clobber)
        elif sys.stdout.isatty():
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")
    allowed = max_memory or available_memory()
    stages: list[tuple[str, float]] = []
    with options.Progress(["read mesh"]) as progress:

        def enter(stage: str) -> None:
            stages.append((stage, time.perf_counter()))
            progress.enter(stage)

        enter("read mesh")
        mesh = read_unstructured(file, scalar, component)
        plan = plan_tet(mesh, layout, merge_distance)
        if only_plan:
            progress.erase()
            print_plan(plan, as_json)
            try:
                plan.refuse_beyond(allowed)
            except MemoryLimitError as error:
                options.tell(f"warning: this will be refused: {error}")
            return
        progress.stages = ["read mesh", *plan.stages, "write file"]
        volume = build_tet(mesh, layout, merge_distance, max_memory=allowed, on_stage=enter)
        enter("write file")
        write_tet(volume, output, not no_clobber, file_format)
    ended = time.perf_counter()
    seconds = ended - started
    spent = {stage: end - begin for (stage, begin), (_, end) in pairwise([*stages, ("", ended)])}
    if as_json:
        result = {**summary(volume, output, seconds), "stages": spent}
        if output != "-" or not quiet:
            options.print_json(result, err=output == "-")
        return
    tell_volume(volume, f"{file} -> {output if output != '-' else 'stdout'}", seconds)
    if verbose:
        told = ", ".join(f"{stage} {taken:.2f}" for stage, taken in spent.items())
        options.tell(f"  seconds   {told}")


def summary(volume: TetVolume, output: str, seconds: float) -> dict[str, Any]:
    """What was made, in JSON types."""
    return {
        "output": output,
        "layout": volume.layout,
        "scalar": volume.scalar,
        "scalar_range": list(volume.scalar_range),
        "constant": volume.constant,
        "origin": list(volume.origin),
        "scale": volume.scale,
        "tetrahedra" if volume.cells.shape[1] == 4 else "hexahedra": len(volume.cells),
        "vertices": len(volume.vertices),
        "bytes": volume.sizes(),
        "bytes_a_cell": volume.bytes_a_cell(),
        "compared": COMPARED[volume.layout],
        **volume.report,
        "digest": volume.digest(),
        "seconds": round(seconds, 3),
    }


def tell_volume(volume: TetVolume, what: str, seconds: float) -> None:
    """What was made, and what was done to the mesh."""
    from voxtool.errors import human

    tell, report, sizes = options.tell, volume.report, volume.sizes()
    count = len(volume.cells)
    noun = "tetrahedra" if volume.cells.shape[1] == 4 else "hexahedra"
    tell(
        f"{what}: {count:,} {noun} of {volume.scalar}, {len(volume.vertices):,} vertices in "
        f"{human(sum(sizes.values()))}, {seconds:.2f} s"
    )
    read = ", ".join(f"{n:,} {kind}" for kind, n in report["cells"].items())
    tell(f"  cells     {read}; {', '.join(changes(report))}")
    tell(
        f"  points    {report['merged_points']:,} of {report['points']:,} merged into others"
        + (f", {report['merged_scalars']:,} of another scalar" if report["merged_scalars"] else "")
    )
    tell(
        f"  faces     {report['boundary_faces']:,} without a neighbour, of these "
        f"{report['non_manifold_faces']:,} of more than two cells, {report['folded_faces']:,} of "
        "two on one side"
    )
    low, high = volume.scalar_range
    each = "one a cell" if volume.constant else "linear in a cell"
    tell(f"  scalar    {volume.scalar}, {each}, {low:.6g} to {high:.6g}")
    tell(
        f"  rounding  vertices within {report['plane_error']:.2g} of their planes, scalars within "
        f"{report['scalar_error']:.2g}, where the mesh is about 2 long and scalars are 0 to 1"
    )
    table = volume.bytes_a_cell()
    beside = sum(sizes.values()) / count - table
    tell(
        f"  bytes     {table:.1f} a cell of {COMPARED[volume.layout]}; {beside:.1f} beside: "
        + ", ".join(f"{name} {human(size)}" for name, size in sizes.items())
    )


def changes(report: dict[str, Any]) -> list[str]:
    """What became of cells that could not stay as they were."""
    counted = [
        (sum(report["ignored"].values()), "are no volumes and left out"),
        (report["curved"], "taken by their corners"),
        (report["collapsed"], "with coincident points"),
        (report["turned"], "turned"),
        (report["duplicates"], "dropped as there already"),
        (
            report["zero_volume"],
            f"of zero volume dropped ({report['coincident']:,} with coincident points)",
        ),
        (report["flat"], "too flat or too small and dropped"),
    ]
    return [f"{count:,} {done}" for count, done in counted if count] or ["none turned or dropped"]


def print_plan(plan: VolumePlan, as_json: bool) -> None:
    """What will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(plan.as_dict())
        return
    from voxtool.errors import human

    read = ", ".join(f"{count:,} {kind}" for kind, count in plan.cells.items())
    rows = [
        ("volume", f"layout {plan.layout}, merge distance {plan.merge_distance:g}"),
        ("mesh", f"{read}, {plan.points:,} points"),
        ("stages", ", ".join(plan.stages)),
        *(("left out", f"{what}: {why}") for what, why in plan.left_out().items()),
        ("predicted", f"at most {plan.predicted_cells:,} cells, {human(plan.volume_bytes)}; "
         f"{human(plan.work_bytes)} in work"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<10} {text}")
