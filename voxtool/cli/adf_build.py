"""voxtool adf-build: triangle mesh to adaptively sampled distance field."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import (
    DEFAULT_MAX_LEVEL,
    DEFAULT_TEXTURE_3D,
    DEFAULT_TOLERANCE,
    MAX_LEVEL,
    MAX_TEXTURE_3D,
    MIN_TEXTURE_3D,
    POINT_FILLS,
)
from voxtool.cli import options, runner
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import BYTES, flag, option, together
from voxtool.errors import CheckError, count_of, human

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field.field import DistanceField


@click.command("adf-build")
@mesh_argument("", "adf.h5")
@together(
    option("--tolerance", float,
        f"Error that leaves may have, in sides of the cube.  [default: {DEFAULT_TOLERANCE}]"),
    option("--tolerance-world", float, "Error that leaves may have, in the mesh's own units."),
    option("--max-level", click.IntRange(1, MAX_LEVEL),
        "Level at which leaves are no longer refined.  The root has level 0.", DEFAULT_MAX_LEVEL),
    option("--band", float,
        "Refine only within WIDTH of the surface, in sides of the cube.  [default: everywhere]",
        math.inf, metavar="WIDTH"),
    flag("--guarantee",
        "Refine by the error bound of a leaf, not by samples of its error, down to --max-level."),
    flag("--everywhere",
        "Refine along the medial axis, too, where --max-level does not reach the tolerance."),
    option("--max-bytes", BYTES,
        "Approximate size of the field (60M).  The largest errors are refined first.",
        metavar="BYTES"),
    option("--max-texture", click.IntRange(MIN_TEXTURE_3D, MAX_TEXTURE_3D),
        "Texels along an axis of a 3-D texture on the device that shall take the field.  A field "
        "that does not fit is refused.", DEFAULT_TEXTURE_3D, metavar="TEXELS"),
    option("--fill", tuple(fill for fill in POINT_FILLS if fill != "flood"),
        "What is inside, as for voxelize; none: no distance is negative.  parity and nonzero go "
        "with closed meshes whose parts do not overlap.", POINT_FILLS[0]),
    option("--continuous/--cracks", bool,
        "Leaves of different levels agree on their common faces, or are exact at all corners.",
        True),
    option("--bounds/--no-bounds", bool, "Store a bound of each leaf's error, or not.", True,
        show_default=False),
    option("--errors/--no-errors measure", bool,
        "Measure the field's errors, at up to 32,768 points in the cube and as many near the "
        "surface, or not.", True, show_default=False),
    option("--windows", ("auto", "never"),
        "auto: if the field would take more than --max-memory, its blocks and levels wait on the "
        "disk, with the same content; never: refuse.", "auto"),
    options.length_options(),
    options.normalize_option("stored"),
)  # fmt: skip
@runner.job_options("FILE", "Default MESH's name with .adf.h5, in this folder.", "adf.h5")
def command(
    run: runner.Run, mesh: str, tolerance: float | None, tolerance_world: float | None,
    windows: str, units: str | None, scale: float, normalize: str | None, **request: Any,
) -> None:  # fmt: skip
    """Build the adaptively sampled distance field of a triangle MESH.

    MESH is an OBJ, STL, PLY, OFF, GLB or 3MF file, .gz too, or - for stdin. The field fills a cube
    whose side is 8/7 of the mesh's longest side. Its place is given in the mesh's own units, errors
    in sides of the cube. The report has the error near the surface, with -v all errors, and names
    leaves over the tolerance that a higher --max-level helps; --strict counts these, too.

    \b
    Examples:
      voxtool adf-build bunny.obj --tolerance 1e-4 --max-level 9
      voxtool adf-build bunny.obj --tolerance 1e-4 --band 0.05 -o near.adf.h5
    """
    if tolerance is not None and tolerance_world is not None:
        raise click.UsageError("--tolerance and --tolerance-world say the same: drop one of them")
    if tolerance_world is not None and not 0 <= tolerance_world < math.inf:
        raise click.UsageError(f"--tolerance-world {tolerance_world:g}: give a length from 0 on")
    from voxtool.adf.construction.survey import cube_of
    from voxtool.distances import plan_field
    from voxtool.files import ADF_FORMATS, write_adf
    from voxtool.files.storage.spool import Spool

    run.to(mesh, options.output_of(mesh, "adf.h5"), ADF_FORMATS)
    with run:
        loaded = run.mesh(mesh, units, scale, normalize)
        if tolerance_world is not None:
            tolerance = tolerance_world / cube_of(loaded)[1]
        request["tolerance"] = DEFAULT_TOLERANCE if tolerance is None else tolerance
        stores = None if windows == "never" else partial(Spool, str(run.output))
        job = run.plan(plan_field, loaded, stores=stores, **request)
        if run.only_plan and (uncertain := job.sign_finding()):
            options.warn(uncertain)
        field = run.job(job)
        run.write(write_adf, field)
    reached = field.reached
    run.report(
        f"tolerance {field.tolerance:.3g}, sign {field.sign}; {reached['leaves']:,} leaves in "
        f"{run.size}{error_near(field)}{missed(field, request['max_bytes'] is not None)}"
        f"{left(field)}",
        lambda: facts_of(field),
        details_of(field),
    )
    if run.strict and (over := reached["missed"] or reached.get("unproved")):
        raise CheckError(
            f"{run.output}: {over:,} leaves miss the tolerance (--strict): choose a "
            "higher --max-level, a larger --tolerance or more --max-bytes"
        )


def facts_of(field: DistanceField) -> dict[str, Any]:
    """Return the facts of the report, in JSON types."""
    n = len(field.voxels)
    return {
        "tolerance": field.tolerance,
        "max_level": field.max_level,
        "sign": field.sign,
        "origin": list(field.origin),
        "side": field.side,
        "transform": list(field.transform),
        "blocks": n,
        "cells_by_level": field.cells_by_level(),
        "leaves_by_level": field.leaves_by_level(),
        "textures": field.sizes(),
        "hash_load": field.hash.load(n),
        "hash_bits_a_key": field.hash.bits_a_key(n),
        "lipschitz": field.lipschitz,
        **field.reached,
        "digest": field.digest(),
    }


def error_near(field: DistanceField) -> str:
    """Return the error near the surface, if it was measured."""
    errors = field.reached.get("errors", {}).get("near the surface")
    if not errors or not errors["points"]:
        return ""
    points = count_of(errors["points"], "point")
    return f"; error near the surface rms {errors['rms']:.2g} sides at {points}"


def missed(field: DistanceField, limited: bool) -> str:
    """Return how many leaves could have met the tolerance, if any, and what helps; `limited`: the
    bytes of the field were."""
    if not field.reached["missed"]:
        return ""
    worst = field.reached["worst"]
    helps = "more --max-bytes" if limited else "a higher --max-level"
    if field.continuous and 0.5 ** worst["level"] < 2 * field.tolerance:
        # at the edge between two planes, leaves so small err by less than that on their own; these
        # take the values of coarser ones beside them
        helps = "--cracks"
    return (
        f"; {count_of(field.reached['missed'], 'leaf')} over the tolerance by up to "
        f"{worst['error'] - field.tolerance:.2g} sides: {helps} helps"
    )


def left(field: DistanceField) -> str:
    """Return how many leaves along the medial axis were left before the last level, if any."""
    medial = field.reached.get("medial", {})
    if not medial.get("left"):
        return ""
    return (
        f"; {count_of(medial['left'], 'leaf')} along the medial axis left at errors of up to "
        f"{medial['error']:.2g}: --everywhere refines them"
    )


def details_of(field: DistanceField) -> Iterator[str]:
    """Yield lines of the errors, cells and textures of a field."""
    n, reached = len(field.voxels), field.reached
    for where, errors in reached.get("errors", {}).items():
        if errors["points"]:
            yield (
                f"error {where}: 99 % within {errors['p99']:.3g}, rms {errors['rms']:.3g}, max "
                f"{errors['max']:.3g} sides; {100 * errors['within']:.2f} % of "
                f"{errors['points']:,} points within the tolerance"
            )
    if worst := reached.get("worst"):
        place = ", ".join(f"{x:.6g}" for x in worst["where"])
        yield (
            f"missed    {count_of(reached['missed'], 'leaf')} that could have met the tolerance, "
            f"the worst at level {worst['level']} near ({place})"
        )
    if medial := reached.get("medial"):
        place = ", ".join(f"{x:.6g}" for x in medial["where"])
        yield (
            f"medial    {count_of(medial['leaves'], 'leaf')} over the tolerance along the medial "
            f"axis, by up to {medial['error'] - field.tolerance:.3g} sides near ({place})"
        )
    if unproved := reached.get("unproved"):
        yield f"unproved  {count_of(unproved, 'leaf')} whose bound is over the tolerance"
    if kept := reached.get("kept"):
        yield (
            f"kept      {kept:,} hanging vertices exact, where coarser leaves have the other sign"
        )
    if reached["jumps"]:
        yield f"jumps     {reached['jumps']:,} leaves, where the sign jumps, as across a hole"
    leaves = [0, *field.leaves_by_level()]
    cells = [sum(pair) for pair in zip(field.cells_by_level(), leaves, strict=True)]
    first = next(level for level, count in enumerate(leaves) if count)
    balance = {None: "", True: "; balanced 2:1", False: "; not balanced 2:1"}
    yield f"cells     {', '.join(f'{n:,}' for n in cells)}, of level 0, 1, ..."
    yield (
        f"leaves    {', '.join(f'{n:,}' for n in leaves[first:])}, of level {first}, "
        f"{first + 1}, ...{balance[reached.get('balanced')]}"
    )
    yield (
        "textures  "
        + ", ".join(f"{name} {human(size)}" for name, size in field.sizes().items())
        + f"; hash {100 * field.hash.load(n):.1f} % full, {field.hash.bits_a_key(n):.2f} bits a key"
    )
