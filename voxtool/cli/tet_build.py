"""voxtool tet-build: unstructured mesh of volume cells to the textures of a tetrahedral volume."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import LAYOUTS, MAX_TEXTURE_2D, MIN_TEXTURE_2D
from voxtool.cli import options, runner
from voxtool.cli.options import option, together
from voxtool.errors import human

if TYPE_CHECKING:
    from voxtool.tets.volume.volume import TetVolume


@click.command("tet-build")
@click.argument("file")
@together(
    option("--scalar", str, "Array at points, or else at cells.  [default: the only one there is]",
        metavar="NAME"),
    option("--component", str, "Component of an array of vectors: x, y, z, 0, 1, ... or magnitude.",
        metavar="C"),
    option("--layout", LAYOUTS,
        "Textures for ray casting, for cell projection, or for hexahedra that stay whole.",
        "raycast"),
    option("--merge-distance", float,
        "Points within D of each other become one, in the mesh's own units.  [default: only "
        "points at one place]", 0.0, metavar="D"),
    option("--max-texture", click.IntRange(MIN_TEXTURE_2D, MAX_TEXTURE_2D),
        "Texels along an axis of a 2-D texture on the device that shall take the volume.  A volume "
        "that does not fit is refused.", MAX_TEXTURE_2D, metavar="TEXELS"),
)  # fmt: skip
@runner.job_options("OUT", "Default FILE's name with .tet.h5, in this folder.", "tet.h5")
def command(
    run: runner.Run, file: str, scalar: str | None, component: str | None, layout: str,
    merge_distance: float, max_texture: int,
) -> None:  # fmt: skip
    """Build the textures of a tetrahedral volume from a mesh of volume cells.

    FILE is .vtu, .vtk, .msh (Gmsh), .mesh (Medit), .inp (Abaqus, AVS UCD) or .ex2 (Exodus II).
    Hexahedra, wedges and pyramids are split. Lengths and scalars keep the mesh's own units.

    \b
    Examples:
      voxtool tet-build volume.vtu --scalar density
      voxtool tet-build volume.vtu --scalar momentum --component magnitude -o speed.tet.h5
    """
    from voxtool.files import TET_FORMATS, read_unstructured, write_tet
    from voxtool.tets.construction.textures import plan_tet

    run.to(file, options.output_of(file, "tet.h5"), TET_FORMATS)
    with run:
        mesh = run.stage("read mesh", read_unstructured, file, scalar, component, run.max_memory)
        volume = run.job(run.plan(plan_tet, mesh, layout, merge_distance, max_texture=max_texture))
        run.write(write_tet, volume)
    run.report(
        f"{len(volume.cells):,} {volume.noun} of {volume.scalar}, {len(volume.vertices):,} "
        f"vertices in {run.size}",
        volume.summary,
        details(volume),
    )


def details(volume: TetVolume) -> list[str]:
    """Return lines that say what was done to the mesh, and how accurate the result is."""
    from voxtool.tets.volume.volume import COMPARED

    report, sizes = volume.report, volume.sizes()
    read = ", ".join(f"{n:,} {kind}" for kind, n in report["cells"].items())
    other = report["merged_scalars"]
    low, high = volume.scalar_range
    each = "one a cell" if volume.constant else "linear in a cell"
    table = volume.bytes_a_cell()
    beside = sum(sizes.values()) / len(volume.cells) - table
    return [
        f"cells     {read}; {', '.join(changes(report))}",
        f"points    {report['merged_points']:,} of {report['points']:,} merged into others"
        + (f", {other:,} of another scalar" if other else ""),
        f"faces     {report['boundary_faces']:,} without a neighbour, of these "
        f"{report['non_manifold_faces']:,} of more than two cells, {report['folded_faces']:,} of "
        "two on one side",
        f"scalar    {volume.scalar}, {each}, {low:.6g} to {high:.6g}",
        f"rounding  vertices within {report['plane_error']:.2g} of their planes, scalars within "
        f"{report['scalar_error']:.2g}, where the mesh is about 2 long and scalars are 0 to 1",
        "texels    "
        + ", ".join(f"{name} {shape[0]} x {shape[1]}" for name, shape in volume.shapes().items()),
        f"bytes     {table:.1f} a cell of {COMPARED[volume.layout]}; {beside:.1f} beside: "
        + ", ".join(f"{name} {human(size)}" for name, size in sizes.items()),
    ]


def _held(report: dict[str, Any]) -> str:
    """Return what the tetrahedra held that are dropped as too flat."""
    if "flat_scalars" not in report:
        return ""
    low, high = report["flat_scalars"]
    return f" (of volume {report['flat_volume']:.3g}, scalars {low:.6g} to {high:.6g})"


def changes(report: dict[str, Any]) -> list[str]:
    """Return phrases that count the cells that were changed or dropped."""
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
        (report["flat"], f"too flat or too small and dropped{_held(report)}"),
    ]
    return [f"{count:,} {done}" for count, done in counted if count] or ["none turned or dropped"]
