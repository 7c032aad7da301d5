"""voxtool repair: any mesh made closed and manifold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import DEFAULT_DIM, FILLS
from voxtool.cli import options, runner
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import COMPONENTS, DIM, POSITIVE, flag, option, together
from voxtool.cli.placing import mesh_origin
from voxtool.errors import CheckError, count_of

if TYPE_CHECKING:
    from voxtool.repairing.result import Repaired

WAYS = {
    "the result to the mesh": "result_to_mesh",
    "the mesh's outer surface": "outer_mesh_to_result",
    "all of the mesh": "mesh_to_result",
}
WALLS = ("offset", "shell", "thicken")


mesh_options = together(
    option("--dim", DIM, f"Voxels along the longest side.  [default: {DEFAULT_DIM}]"),
    option("--tolerance", POSITIVE,
        "Instead of --dim: the diagonal of a voxel in world units.  Where the mesh passes a voxel "
        "and is repaired there, the result is at most this far from it.", metavar="LENGTH"),
    option("--fill", FILLS,
        "What is inside, as for voxtool voxelize; auto unites parts that overlap.", FILLS[0]),
    option("--gap", click.IntRange(0),
        "With --fill flood: close openings of up to this many voxels first.", 0, metavar="VOXELS",
        show_default=False),
    option("--keep-components", COMPONENTS, "Keep the N largest connected components.",
        metavar="largest|N"),
)  # fmt: skip
result_options = together(
    option("--simplify", POSITIVE,
        "Leave out triangles, as far as the surface moves by at most this distance in world units; "
        "with the package manifold3d.", metavar="LENGTH"),
    flag("--normals", "Write vertex normals, too (.obj, .ply, .glb)."),
    mesh_origin,
    flag("--check",
        "Print the result's counts as JSON; exit with 1 if it is not closed and manifold, or if "
        "faces pass through others."),
    options.length_options(),
)  # fmt: skip


def file_options(name: str) -> options.Decorator:
    """Return the options of a command whose result is a mesh of this name."""
    return runner.job_options(
        "FILE", f"Default MESH's name with .{name}.obj or --format, in this folder.",
        "obj", "ply", "stl", "glb", "off",
    )  # fmt: skip


@click.command("repair")
@mesh_argument("repaired", "obj")
@together(
    mesh_options,
    option("--offset", float,
        "Move the surface by this distance in world units: outward, or inward if negative.",
        metavar="LENGTH"),
    option("--shell", POSITIVE,
        "Hollow the solid: a wall of this thickness inside the surface, in world units; see also "
        "voxtool hollow.", metavar="LENGTH"),
    option("--thicken", POSITIVE,
        "A wall of this thickness in the middle of which MESH lies, whatever is inside: for open "
        "surfaces.", metavar="LENGTH"),
    result_options,
)  # fmt: skip
@file_options("repaired")
def command(run: runner.Run, mesh: str, **request: Any) -> None:
    """Make a closed, consistently wound, manifold mesh of any triangle MESH.

    MESH is an OBJ, STL, PLY, OFF, GLB or 3MF file, .gz too, or - for stdin. It may have holes,
    flipped or repeated faces, open or intersecting parts. The voxels of a grid decide what is
    inside; the result follows MESH where it passes a voxel, and closes holes smoothly. Parts
    thinner than a voxel may be lost. The report says how far the two lie apart at most; with -v,
    and from where.

    \b
    Examples:
      voxtool repair open.obj -o closed.ply
      voxtool repair bunny.obj --dim 512 --keep-components largest --check -o fixed.stl
      voxtool repair bunny.obj --dim 128 --simplify 0.01 -o small.stl
    """
    if sum(request[name] is not None for name in WALLS) > 1:
        raise click.UsageError("--offset, --shell and --thicken exclude each other: choose one")
    if request["thicken"] and (request["fill"] != FILLS[0] or request["gap"]):
        raise click.UsageError("--thicken asks for no inside: drop --fill and --gap")
    execute(run, mesh, "repaired", **request)


def execute(
    run: runner.Run, mesh: str, name: str, *, dim: int | None, tolerance: float | None,
    normals: bool, check: bool, units: str | None, scale: float,
    origin: tuple[float, ...] | None, **request: Any,
) -> None:  # fmt: skip
    """Repair a mesh as requested, write the result, and report."""
    if dim is not None and tolerance is not None:
        raise click.UsageError("--dim and --tolerance both set the voxel size: drop one of them")
    if request["gap"] and request["fill"] != "flood":
        raise click.UsageError("--gap goes with --fill flood")
    from voxtool.files import MESH_FORMATS, write_mesh
    from voxtool.files.meshes.mesh import load_mesh
    from voxtool.repairing.job import grid_for, plan_repair

    run.to(mesh, options.output_of(mesh, f"{name}.{run.file_format or 'obj'}"), MESH_FORMATS)
    if normals:
        options.check_normals(run.file_format)
    with run:
        loaded = run.stage(
            "read mesh", load_mesh, mesh, max_memory=run.max_memory, units=units, scale=scale
        )
        given = {name: value for name, value in request.items() if value is not None}
        with run.naming(mesh):
            job = run.plan(plan_repair, loaded, grid_for(loaded, dim, tolerance), **given)
            result = run.job(job)
        own = result.normals if normals else None
        run.write(write_mesh, result.mesh(), normals=own, origin=origin)
    near = "" if any(request.get(name) for name in WALLS) else f"; {farthest(result)}"
    run.report(
        f"{report_line(result)}{near}, {run.size}",
        lambda: facts_of(result) | ({"origin": list(origin)} if origin else {}),
        distance_lines(result), json_too=check,
    )  # fmt: skip
    if check and result.faults:
        raise CheckError(f"{run.output}: {result.faults}")


def report_line(result: Repaired) -> str:
    """Return the line of the report."""
    found = result.checked
    kind = "closed and manifold" if found["closed"] else "not closed"
    line = (
        f"{kind}, {count_of(found['shells'], 'shell')}, genus {found['genus']}, "
        f"{count_of(len(result.vertices), 'vertex')}, {count_of(len(result.faces), 'triangle')}"
    )
    if wall := result.wall:
        line += (
            f"; thinnest wall {wall['thinnest']:.4g} of {wall['wanted']:.4g}, "
            f"{count_of(wall['cavities'], 'cavity')}, {wall['closed']:,} of them closed"
        )
    return line


def farthest(result: Repaired) -> str:
    """Return how far the result and the mesh's outer surface lie from each other at most."""
    ways = (result.distances[way] for way in ("result_to_mesh", "outer_mesh_to_result"))
    most = max(way["max_upper"] for way in ways if way)
    return f"at most {most:.3g} from the mesh, {most / result.distances['pitch']:.2f} voxels"


def distance_lines(result: Repaired) -> list[str]:
    """Return the lines on the distances between the mesh and the result."""
    found, lines = result.distances, []
    for name, way in WAYS.items():
        if way := found[way]:
            mean = f"mean {way['mean']:.3g}, " if "mean" in way else ""
            low, high = (way[end] / found["pitch"] for end in ("max", "max_upper"))
            lines.append(
                f"from {name}: {mean}largest {way['max']:.3g}, between {low:.2f} and {high:.2f} "
                "voxels"
            )
    return lines


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
        "vertices_on_target": result.on_target,
        "wall": result.wall,
        "simplified": result.simplified,
        "check": result.checked,
        "distances": result.distances,
        "digest": result.digest(),
    }
