"""voxtool svo-query: whether points lie in set voxels, and the coverage around them."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import FACE_NAMES
from voxtool.cli import options, runner
from voxtool.cli.options import LEVEL, flag, option
from voxtool.errors import count_of

if TYPE_CHECKING:
    from voxtool.svo.queries.query import QueryJob

ATTRIBUTES = {
    "label": [("label", "i8")],
    "colour": [(name, "u1") for name in ("red", "green", "blue", "alpha")],
    "normal": [(name, "f4") for name in ("nx", "ny", "nz")],
    "area": [("area", "f4")],
    "fraction": [("fraction", "f8")],
    "faces": [(name, "f8") for name in FACE_NAMES],
}
NEAREST = [("voxel_x", "i8"), ("voxel_y", "i8"), ("voxel_z", "i8"), ("distance", "f8")]


@click.command("svo-query")
@click.argument("octree")
@click.argument("points", required=False)
@option("--level", LEVEL,
    "Write the coverage, too: the share of set voxels in the node of level N around each point; 0 "
    "are bricks of 4 x 4 x 4 voxels.")  # fmt: skip
@flag("--nearest", "Write the nearest set voxel, too: voxel_x, _y, _z, and its centre's distance.")
@option("--attributes", str,
    "Write these attributes of the voxels, too: label (an index of the names that svo-info lists), "
    "colour, normal, area, fraction, faces.", metavar="NAME[,NAME...]")  # fmt: skip
@runner.job_options(
    "FILE", "Default POINTS's name with .voxels.npy or --format, in this folder; stdout, as CSV, "
    "for stdin.",
    "npy", "csv",
)  # fmt: skip
def command(
    run: runner.Run, octree: str, points: str | None, level: int | str | None, nearest: bool,
    attributes: str | None,
) -> None:  # fmt: skip
    """Tell which POINTS lie in set voxels of an OCTREE: 1 if so, otherwise 0.

    OCTREE is .svo.h5 or .svo.xml; POINTS is a .npy, .npz, .csv, .xyz or .ply file, in world units.
    Each can be - for stdin, which is the default of POINTS. A point on a plane between voxels is in
    the upper one; outside the grid nothing is set. The columns are contains; with --level
    coverage; with --nearest voxel_x, voxel_y, voxel_z, distance: -1 and inf if no voxel is set;
    with --attributes label, -1 where nothing is set, red, green, blue, alpha, nx, ny, nz, area,
    fraction, and face_x0 to face_z1 for the faces at low x, high x, low y, ...

    \b
    Examples:
      voxtool svo-query bunny.svo.h5 points.csv -o answers.csv
      voxtool svo-query bunny.svo.h5 points.csv --level 0 -o -
    """
    points = options.points_of(points, "OCTREE", octree, "name a file, or pipe them in")
    from voxtool.files import open_svo
    from voxtool.svo.octree.content import StoredOctree
    from voxtool.svo.octree.octree import in_memory
    from voxtool.svo.queries.query import plan_query

    run.to_table(points, "voxels")
    names = tuple(attributes.split(",")) if attributes else ()
    with run, ExitStack() as stack:
        source: Any = run.stage("read octree", stack.enter_context, open_svo(octree))
        with run.naming(octree):
            if isinstance(source, StoredOctree):
                source = run.stage("read octree", in_memory, source, run.max_memory, names)
            job = run.plan(plan_query, source, level=level, nearest=nearest, attributes=names)
        facts = answer(run, job, points)
    outside = facts["outside"]
    if outside:
        run.notes.append(
            f"{count_of(outside, 'point')} {'is' if outside == 1 else 'are'} outside the grid"
        )
    run.report(
        f"{count_of(facts['points'], 'point')}, {facts['contained']:,} in set voxels, {run.size}",
        lambda: facts,
    )


def answer(run: runner.Run, job: QueryJob, points: str) -> dict[str, Any]:
    """Write the values at points, block by block; return the facts of the report."""
    import numpy as np

    from voxtool.files.tables.points import read_points

    query = run.job(job)
    columns = [("contains", "?")] + [("coverage", "f8")] * (job.plan.level is not None)
    columns += NEAREST if job.plan.nearest else []
    names = job.plan.attributes
    columns += [column for name in names for column in ATTRIBUTES[name]]
    contained = outside = 0
    run.enter("query")
    with run.table(columns) as answers:
        for block in read_points(points):
            after = f", after {answers.count:,} points" if answers.count else ""
            with run.naming(f"{options.shown(points)}{after}"):
                found = query(block)
            contained += int(np.count_nonzero(found.contains))
            outside += int(np.count_nonzero(found.outside))
            values = [found.contains, found.coverage, found.nearest, found.distance]
            values += [getattr(found, name) for name in names]
            answers.write([part for part in values if part is not None])
    return {"points": answers.count, "contained": contained, "outside": outside}
