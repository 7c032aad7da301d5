"""voxtool distance: exact signed distances from points, or at the voxel centres of a grid."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import FILLS, SIGNS
from voxtool.cli import options, runner
from voxtool.cli.options import DIM, bbox_option, flag, option, together
from voxtool.errors import VoxtoolError, count_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np

    from voxtool.files.answers import Answers
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.spatial.signed_distance import SignedDistance

COLUMNS = {
    "gradient": [("gx", "f8"), ("gy", "f8"), ("gz", "f8")],
    "nearest": [("nearest_x", "f8"), ("nearest_y", "f8"), ("nearest_z", "f8")],
    "face": [("face", "i8")],
}


@click.command("distance")
@click.argument("mesh")
@click.argument("points", required=False)
@together(
    flag("--gradient", "Write the gradient, too: gx, gy, gz."),
    flag("--nearest", "Write the nearest point: nearest_x, _y, _z."),
    flag("--face", "Write the number of the nearest face, from 0."),
    option("--sign", SIGNS,
        "How the sign of points is found.  [default: pseudonormal if the mesh is closed and "
        "consistently wound, otherwise winding]"),
    option("--fill", FILLS, "What counts as inside on a grid, as for voxelize.", FILLS[0]),
    option("--dim", DIM, "Measure a grid of this size."),
    option("--pitch", float, "Measure a grid of voxels of this size."),
    bbox_option,
    option("--margin", click.IntRange(0), "Empty voxels on each side of the grid."),
    option("--like", str, "Measure the grid of an octree.", metavar="FILE.svo.h5"),
    flag("--float32", "Write a grid as float32 rather than float64."),
)  # fmt: skip
@runner.job_options(
    "FILE", "Default POINTS's name with .distance.npy, or MESH's name with .sdf.npy, in this "
    "folder; stdout, as CSV, for points from stdin.",
    "npy", "csv",
)  # fmt: skip
def command(
    run: runner.Run, mesh: str, points: str | None, sign: str | None, fill: str,
    like: str | None, float32: bool, gradient: bool, nearest: bool, face: bool, **placing: Any,
) -> None:  # fmt: skip
    """Measure exact signed distances from POINTS, or from the voxel centres of a grid, to a MESH.

    Distances are negative inside, in the mesh's own units. POINTS is a .npy, .npz, .csv, .xyz or
    .ply file, or - for stdin. With --dim, --pitch, --bbox or --like the result is an array
    [x, y, z], negative exactly where voxelize sets the voxel on the same grid.

    \b
    Examples:
      voxtool distance bunny.obj points.csv --gradient --nearest --face -o distances.csv
      voxtool distance bunny.obj --dim 64 -o sdf.npy
    """
    on_grid = bool(like) or any(value is not None for value in placing.values())
    asked = {"gradient": gradient, "nearest": nearest, "face": face}
    check_usage(on_grid, mesh, points, sign, fill, float32, asked)
    if like and any(value is not None for value in placing.values()):
        raise click.UsageError("--like sets the grid: drop --dim, --pitch, --bbox and --margin")
    if placing["dim"] and placing["pitch"]:
        raise click.UsageError("--dim and --pitch both set the voxel size: drop one of them")
    from voxtool.files import read_svo
    from voxtool.files.mesh import load_mesh
    from voxtool.grid import Grid

    if on_grid:
        run.to(mesh, options.output_of(mesh, "sdf.npy"), ("npy",))
    else:
        run.to_table(points or "-")
    with run:
        loaded = run.stage("read mesh", load_mesh, mesh)
        if on_grid:
            grid = read_svo(like).grid if like else Grid.fit(loaded, **placing)
            facts = measure_grid(run, loaded, grid, fill, "float32" if float32 else "float64")
        else:
            facts = measure_points(run, loaded, points or "-", sign, asked)
    count = facts["points"]
    run.report(f"{count_of(count, 'distance')}, {facts['negative']:,} negative", lambda: facts)


def check_usage(
    on_grid: bool, mesh: str, points: str | None, sign: str | None, fill: str, float32: bool,
    asked: dict[str, bool],
) -> None:  # fmt: skip
    """Refuse options that do not go with points, or with a grid."""
    if on_grid:
        if points:
            raise click.UsageError("POINTS and a grid: give one of them")
        if sign not in (None, "none"):
            raise click.UsageError("a grid has the signs of voxelize: give --fill, not --sign")
        if any(asked.values()):
            raise click.UsageError("--gradient, --nearest and --face go with POINTS")
        return
    if fill != FILLS[0] or float32:
        raise click.UsageError("--fill and --float32 go with a grid: give --dim")
    if mesh == (points or "-") == "-":
        raise options.input_twice("MESH", "POINTS")
    if points is None and sys.stdin.isatty():
        raise click.UsageError("there are no POINTS: name a file, pipe them in, or give --dim")


def measure_grid(run: runner.Run, mesh: Mesh, grid: Grid, fill: str, dtype: str) -> dict[str, Any]:
    """Write the distances of a grid; return what the report says."""
    import numpy as np

    from voxtool.distances import plan_distance_grid
    from voxtool.files.exports import write_array

    job = run.plan(plan_distance_grid, mesh, grid, fill=fill, dtype=dtype)
    place: dict[str, Any] = {"origin": list(grid.origin), "pitch": list(grid.pitch)}
    found = run.job(job, **place)
    run.write(write_array, found)
    fill = job.plan.voxels.fill if job.plan.voxels else "none"
    extremes = {"low": float(found.min()), "high": float(found.max())}
    negative = int(np.count_nonzero(found < 0))
    shape = {"shape": list(grid.shape), **place, "fill": fill}
    return {"points": found.size, "negative": negative, **shape, **extremes}


def measure_points(
    run: runner.Run, mesh: Mesh, points: str, sign: str | None, asked: dict[str, bool]
) -> dict[str, Any]:
    """Write the distances of points, block by block; return what the report says."""
    from voxtool.distances import plan_distance
    from voxtool.files.answers import open_answers
    from voxtool.files.points import read_points

    job = run.plan(plan_distance, mesh, sign=sign, located=any(asked.values()))
    measure = run.job(job)
    run.enter("distance")
    columns = [("distance", "f8")]
    columns += [column for what, of in COLUMNS.items() if asked[what] for column in of]
    with open_answers(run.output or "-", columns, run.file_format, not run.no_clobber) as answers:
        negative = answer(measure, read_points(points), points, answers, asked)
    run.enter(None)
    return {"points": answers.count, "negative": negative, "sign": measure.sign}


def answer(
    measure: SignedDistance, blocks: Iterable[np.ndarray], name: str, answers: Answers,
    asked: dict[str, bool],
) -> int:  # fmt: skip
    """Write the distances of blocks of points; return how many are negative."""
    import numpy as np

    negative = 0
    for block in blocks:
        finite = np.isfinite(block).all(axis=1)
        if not finite.all():
            first = answers.count + int(np.argmin(finite))
            raise VoxtoolError(f"{name}: point {first} is not finite: remove it")
        found: Any = measure(block, **asked)
        parts = [found] if not any(asked.values()) else [p for p in found if p is not None]
        negative += int(np.count_nonzero(parts[0] < 0))
        answers.write(parts)
    return negative
