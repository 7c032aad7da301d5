"""voxtool repair: any mesh made closed and manifold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import DEFAULT_DIM, FILLS
from voxtool.cli import options, runner
from voxtool.cli.options import COMPONENTS, DIM, POSITIVE, flag, option, together
from voxtool.errors import CheckError, count_of

if TYPE_CHECKING:
    from voxtool.repairing.job import Repaired


@click.command("repair")
@click.argument("mesh")
@together(
    option("--dim", DIM, f"Voxels along the longest side.  [default: {DEFAULT_DIM}]"),
    option("--tolerance", POSITIVE,
        "Instead of --dim: the diagonal of a voxel in world units.  Where the mesh passes a voxel "
        "and is repaired there, the result is at most this far from it.", metavar="LENGTH"),
    option("--fill", FILLS,
        "What is inside, as of voxtool voxelize; auto unites parts that overlap.", FILLS[0]),
    option("--gap", click.IntRange(0),
        "With --fill flood: close openings of up to this many voxels first.", 0, metavar="VOXELS",
        show_default=False),
    option("--keep-components", COMPONENTS, "Keep the N largest connected components.",
        metavar="largest|N"),
    flag("--normals", "Write vertex normals, too (.obj, .ply, .glb)."),
    flag("--check",
        "Print the result's counts as JSON; exit with 1 if it is not closed and manifold, or if "
        "faces pass through others."),
    options.length_options(),
)  # fmt: skip
@runner.job_options(
    "FILE", "Default MESH's name with .repaired.obj or --format, in this folder.",
    "obj", "ply", "stl", "glb", "off",
)  # fmt: skip
def command(
    run: runner.Run, mesh: str, dim: int | None, tolerance: float | None, fill: str, gap: int,
    keep_components: int | None, normals: bool, check: bool, units: str | None, scale: float,
) -> None:  # fmt: skip
    """Make a closed, consistently wound, manifold mesh of any triangle MESH.

    MESH is an OBJ, STL, PLY, OFF, GLB or 3MF file, .gz too, or - for stdin. It may have holes,
    flipped or repeated faces, open or intersecting parts. The voxels of a grid decide what is
    inside; the result follows MESH where it passes a voxel, and closes holes smoothly. Parts
    thinner than a voxel may be lost. The report ends with the distances between the two.

    \b
    Examples:
      voxtool repair open.obj -o closed.ply
      voxtool repair bunny.obj --dim 512 --keep-components largest --check -o fixed.stl
    """
    if dim is not None and tolerance is not None:
        raise click.UsageError("--dim and --tolerance both set the voxel size: drop one of them")
    if gap and fill != "flood":
        raise click.UsageError("--gap goes with --fill flood")
    from voxtool.files import MESH_FORMATS, write_mesh
    from voxtool.files.mesh import load_mesh
    from voxtool.repairing.job import grid_for, plan_repair

    run.to(mesh, options.output_of(mesh, f"repaired.{run.file_format or 'obj'}"), MESH_FORMATS)
    if normals:
        options.check_normals(run.file_format)
    with run:
        loaded = run.stage(
            "read mesh", load_mesh, mesh, max_memory=run.max_memory, units=units, scale=scale
        )
        grid = grid_for(loaded, dim, tolerance)
        with run.naming(mesh):
            job = run.plan(
                plan_repair, loaded, grid, fill=fill, gap=gap, keep_components=keep_components
            )
            result = run.job(job)
        run.write(write_mesh, result.mesh(), normals=result.normals if normals else None)
    run.report(
        report_line(result), lambda: facts_of(result), distance_lines(result), json_too=check
    )
    if check and result.faults:
        raise CheckError(f"{run.output}: {result.faults}")


def report_line(result: Repaired) -> str:
    """Return the line of the report."""
    found = result.checked
    kind = "closed and manifold" if found["closed"] else "not closed"
    return (
        f"{kind}, {count_of(found['shells'], 'shell')}, genus {found['genus']}, "
        f"{len(result.vertices):,} vertices, {len(result.faces):,} triangles"
    )


def distance_lines(result: Repaired) -> list[str]:
    """Return the lines on the distances between the mesh and the result."""
    units, voxels = result.distances, result.distances["voxels"]
    return [
        f"from {name}: mean {units[way]['mean']:.3g} ({voxels[way]['mean']:.2f} voxels), at least "
        f"{units[way]['max']:.3g} ({voxels[way]['max']:.2f}) at most"
        for name, way in (
            ("the result to the mesh", "surface_to_reference"),
            ("the mesh to the result", "reference_to_surface"),
        )
    ]


def facts_of(result: Repaired) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    grid = result.grid
    return {
        "grid": {name: list(getattr(grid, name)) for name in ("shape", "origin", "pitch")},
        "dim": grid.dim,
        "fill": result.fill,
        "voxels": result.voxels,
        "components": result.components,
        "vertices": len(result.vertices),
        "triangles": len(result.faces),
        "vertices_on_mesh": result.on_mesh,
        "check": result.checked,
        "distances": result.distances,
        "digest": result.digest(),
    }
