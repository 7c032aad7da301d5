"""voxtool distance: exact signed distances from points, or at the voxel centres of a grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import POINT_FILLS
from voxtool.cli import options, runner
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import DIM, flag, option, together
from voxtool.cli.placing import FILES, OWN, check_placing, lattice_options, placed
from voxtool.errors import count_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh

TABLES = (".npy", ".npz", ".csv", ".xyz")  # POINTS, and no meshes
COLUMNS = {
    "gradient": [("gx", "f8"), ("gy", "f8"), ("gz", "f8")],
    "nearest": [("nearest_x", "f8"), ("nearest_y", "f8"), ("nearest_z", "f8")],
    "face": [("face", "i8")],
}


def on_grid(values: Mapping[str, Any]) -> bool:
    """Return whether the options ask for the distances of a grid."""
    names = ("dim", "pitch", "bbox", "margin", *FILES, *OWN)
    return any(values[name] is not None for name in names)


def arranged(words: Sequence[str], values: dict[str, Any]) -> tuple[Sequence[str], dict[str, Any]]:
    """Return the meshes among the arguments, and the options with the points."""
    if on_grid(values):
        if found := [word for word in words[1:] if word == "-" or word.endswith(TABLES)]:
            raise click.UsageError(f"POINTS ({found[0]}) and a grid: give one of them")
        return words, {**values, "points": None}
    if len(words) > 2:
        raise click.UsageError("many meshes go with a grid: give --dim, or one MESH and POINTS")
    return words[:1], {**values, "points": words[1] if len(words) == 2 else None}


@click.command("distance")
@mesh_argument("sdf", "npy", arranged)
@together(
    flag("--gradient", "Write the gradient, too: gx, gy, gz."),
    flag("--nearest", "Write the nearest point: nearest_x, _y, _z."),
    flag("--face", "Write the number of the nearest face, from 0."),
    option("--fill", POINT_FILLS,
        "What is inside, as for voxelize; none: no distance is negative.  flood goes with a grid.",
        POINT_FILLS[0]),
    option("--dim", DIM, "Measure a grid of this size."),
    option("--pitch", float, "Measure a grid of voxels of this size."),
    option("--margin", click.IntRange(0), "Empty voxels on each side of the grid."),
    lattice_options,
    options.length_options(),
    options.normalize_option("in the report"),
    flag("--float32", "Write a grid as float32 rather than float64."),
)  # fmt: skip
@runner.job_options(
    "FILE", "Default POINTS's name with .distance.npy, or MESH's name with .sdf.npy, in this "
    "folder; stdout, as CSV, for points from stdin.",
    "npy", "csv",
)  # fmt: skip
def command(
    run: runner.Run, mesh: str, points: str | None, fill: str,
    units: str | None, scale: float, normalize: str | None, float32: bool,
    gradient: bool, nearest: bool, face: bool, **placing: Any,
) -> None:  # fmt: skip
    """Measure exact signed distances from POINTS, or from the voxel centres of a grid, to a MESH.

    Distances are negative inside, in the mesh's own units, once scaled. POINTS is a .npy, .npz,
    .csv, .xyz or .ply file, or - for stdin. With --dim, --pitch, --bbox, --like or --lattice the
    result is an array [x, y, z], negative exactly where voxelize sets the voxel on the same grid.

    \b
    Examples:
      voxtool distance bunny.obj points.csv --gradient --nearest --face -o distances.csv
      voxtool distance bunny.obj --dim 64 -o sdf.npy
    """
    check_placing(placing)
    whole_grid = on_grid(placing)
    asked = {"gradient": gradient, "nearest": nearest, "face": face}
    if whole_grid:
        if any(asked.values()):
            raise click.UsageError("--gradient, --nearest and --face go with POINTS")
    elif float32:
        raise click.UsageError("--float32 goes with a grid: give --dim")
    elif fill == "flood":
        raise click.UsageError(
            "--fill flood fills whole voxels, and a point is in none: choose auto or winding, or "
            "measure a grid (--dim)"
        )
    else:
        if run.item:
            raise click.UsageError("--workers and --shard go with a grid: give --dim")
        points = options.points_of(points, "MESH", mesh, "name a file, pipe them in, or give --dim")
    if whole_grid:
        run.to(mesh, options.output_of(mesh, "sdf.npy"), ("npy",))
    else:
        run.to_table(points or "-")
    with run:
        loaded = run.mesh(mesh, units, scale, normalize)
        if whole_grid:
            loaded, grid, beyond, _ = placed(run, loaded, placing)
            facts = measure_grid(run, loaded, grid, fill, "float32" if float32 else "float64")
            facts["beyond"] = beyond
        else:
            facts = measure_points(run, loaded, points or "-", fill, asked)
    count, facts["units"] = facts["points"], loaded.units
    facts["transform"] = list(loaded.transform)
    run.report(
        f"{count_of(count, 'distance')}, {facts['negative']:,} negative, {run.size}", lambda: facts
    )


def measure_grid(run: runner.Run, mesh: Mesh, grid: Grid, fill: str, dtype: str) -> dict[str, Any]:
    """Write the distances of a grid; return the facts of the report."""
    import numpy as np

    from voxtool.distances import plan_distance_grid
    from voxtool.files.grids.npy import write_array

    job = run.plan(plan_distance_grid, mesh, grid, fill=fill, dtype=dtype)
    place: dict[str, Any] = {"origin": list(grid.origin), "pitch": list(grid.pitch)}
    found = run.job(job, **place)
    run.write(write_array, found)
    return {
        "points": found.size,
        "negative": int(np.count_nonzero(found < 0)),
        "shape": list(grid.shape),
        **place,
        "fill": job.octree.fill if job.octree else "none",
        "low": float(found.min()),
        "high": float(found.max()),
    }


def measure_points(
    run: runner.Run, mesh: Mesh, points: str, fill: str, asked: dict[str, bool]
) -> dict[str, Any]:
    """Write the distances of points, block by block; return the facts of the report."""
    import numpy as np

    from voxtool.distances import plan_distance
    from voxtool.files.tables.points import read_points

    job = run.plan(plan_distance, mesh, fill=fill, located=any(asked.values()))
    measure = run.job(job)
    columns = [("distance", "f8")]
    columns += [column for what, of in COLUMNS.items() if asked[what] for column in of]
    negative = 0
    run.enter("distance")
    with run.table(columns) as answers:
        for block in read_points(points):
            after = f", after {answers.count:,} points" if answers.count else ""
            with run.naming(f"{options.shown(points)}{after}"):
                found: Any = measure(block, **asked)
            parts = found if any(asked.values()) else [found]
            negative += int(np.count_nonzero(parts[0] < 0))
            answers.write([part for part in parts if part is not None])
    decided = {"fill": job.inside.fill, "sign": measure.sign}
    return {"points": answers.count, "negative": negative, **decided}
