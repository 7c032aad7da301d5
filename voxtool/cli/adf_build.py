"""voxtool adf-build: triangle mesh to adaptively sampled distance field."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import SIGNS
from voxtool.cli import options
from voxtool.errors import CheckError

if TYPE_CHECKING:
    from voxtool.adf.field import DistanceField
    from voxtool.adf.plan import FieldPlan


@click.command("adf-build")
@click.argument("mesh")
@options.output_options("FILE", "Default MESH's name with .adf.h5, in this folder.")
@click.option(
    "--tolerance",
    type=float,
    help="Error that leaves may have, in sides of the cube.  [default: 0.001]",
)
@click.option("--tolerance-world", type=float, help="The same in the mesh's own units.")
@click.option(
    "--max-level",
    type=click.IntRange(1, 21),
    default=9,
    show_default=True,
    help="Level at which leaves are refined no more; the root's is 0.",
)
@click.option(
    "--band",
    type=float,
    metavar="WIDTH",
    help="Refine only within WIDTH of the surface, in sides of the cube.",
)
@click.option(
    "--max-bytes",
    type=options.Bytes(),
    metavar="BYTES",
    help="Size of the field at most, about (60M): the largest errors are refined first.",
)
@click.option(
    "--sign",
    type=click.Choice(SIGNS),
    help="How inside is told from outside.  [default: pseudonormal if the mesh is closed and "
    "does not pass through itself, or else winding]",
)
@click.option(
    "--continuous/--cracks",
    default=True,
    show_default=True,
    help="Leaves of different level agree on what they share, or are exact at all their corners.",
)
@click.option("--no-bounds", is_flag=True, help="Do not store each leaf's own error bound.")
@click.option("--strict", is_flag=True, help="Exit 1 if leaves miss the tolerance.")
@options.format_option("adf.h5")
@options.plan_options
@options.device_option
@options.json_option
@options.quiet_option
@options.verbose_option
def command(
    mesh: str,
    output: str | None,
    no_clobber: bool,
    tolerance: float | None,
    tolerance_world: float | None,
    max_level: int,
    band: float | None,
    max_bytes: int | None,
    sign: str | None,
    continuous: bool,
    no_bounds: bool,
    strict: bool,
    file_format: str | None,
    only_plan: bool,
    max_memory: int | None,
    device: str | None,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Build the adaptively sampled distance field of a triangle MESH.

    MESH is an OBJ, STL, PLY, OFF or GLB file, .gz too, or - for stdin. The field fills a cube whose
    side is 8/7 of the mesh's longest; its place is told in the mesh's own units, errors in sides of
    this cube. Ends with the errors that it reached.

    \b
    Examples:
      voxtool adf-build bunny.obj --tolerance 1e-4 --max-level 9
      voxtool adf-build bunny.obj --tolerance 1e-4 --band 0.05 -o near.adf.h5
    """
    if tolerance is not None and tolerance_world is not None:
        raise click.UsageError("--tolerance and --tolerance-world say the same: drop one of them")
    if tolerance_world is not None and not 0 <= tolerance_world < math.inf:
        raise click.UsageError(f"--tolerance-world {tolerance_world:g}: give a length from 0 on")
    started = time.perf_counter()
    from voxtool.adf.build import plan_adf
    from voxtool.adf.plan import TOLERANCE
    from voxtool.adf.survey import cube_of
    from voxtool.files import ADF_FORMATS, check_target, format_of, write_adf
    from voxtool.files.mesh import load_mesh
    from voxtool.opencl import open_device

    if output is None:
        output = options.output_of(mesh, "adf.h5")
    file_format = file_format or format_of(output, ADF_FORMATS)
    if not only_plan:
        if output != "-":
            check_target(output, not no_clobber)
        elif sys.stdout.isatty():
            raise click.UsageError("stdout is a terminal: redirect it, or name a file with -o")
    with options.Progress(["read mesh"]) as progress:
        progress.enter("read mesh")
        loaded = load_mesh(mesh)
        if tolerance_world is not None:
            tolerance = tolerance_world / cube_of(loaded)[1]
        chosen = open_device(device, profile=True)
        chosen.on_stage = progress.enter
        request: dict[str, Any] = {
            "tolerance": TOLERANCE if tolerance is None else tolerance,
            "max_level": max_level,
            "band": math.inf if band is None else band,
            "sign": sign,
            "continuous": continuous,
            "bounds": not no_bounds,
            "max_bytes": max_bytes,
        }
        job = plan_adf(loaded, device=chosen, max_memory=max_memory, **request)
        if only_plan:
            plan = job.plan
            progress.erase()
            if uncertain := job.sign_finding():
                options.tell(f"warning: {uncertain}")
            print_plan(plan, as_json)
            options.warn_if_refused(plan, max_memory, chosen)
            return
        field = job.run(progress.enter)
        progress.enter("write file")
        write_adf(field, output, not no_clobber, file_format)
    seconds = time.perf_counter() - started
    stages = chosen.stage_times()
    if as_json:
        result = {**summary(field, output, seconds), "stages": stages}
        if output != "-" or not quiet:
            options.print_json(result, err=output == "-")
    else:
        source, target = mesh if mesh != "-" else "stdin", output if output != "-" else "stdout"
        tell_field(field, f"{source} -> {target}", seconds)
        stages["other"] = seconds - sum(stages.values()) + stages.get("other", 0)
        spent = ", ".join(f"{stage} {time:.2f}" for stage, time in stages.items() if time >= 5e-3)
        options.tell(f"  seconds   {spent}")
    if verbose:
        options.tell(f"{chosen.info.name} ({chosen.info.platform})")
    if strict and field.reached["missed"]:
        raise CheckError(
            f"{output}: {field.reached['missed']:,} leaves miss the tolerance (--strict): choose a "
            "higher --max-level, a larger --tolerance or more --max-bytes"
        )


def summary(field: DistanceField, output: str, seconds: float) -> dict[str, Any]:
    """What was made, in JSON types."""
    n = len(field.voxels)
    return {
        "output": output,
        "tolerance": field.tolerance,
        "max_level": field.max_level,
        "sign": field.sign,
        "origin": list(field.origin),
        "side": field.side,
        "blocks": n,
        "cells_by_level": field.cells_by_level(),
        "leaves_by_level": field.leaves_by_level(),
        "bytes": field.sizes(),
        "hash_load": field.hash.load(n),
        "hash_bits_a_key": field.hash.bits_a_key(n),
        "lipschitz": field.lipschitz,
        **field.reached,
        "digest": field.digest(),
        "seconds": round(seconds, 3),
    }


def tell_field(field: DistanceField, what: str, seconds: float) -> None:
    """What was made, and what it reached."""
    from voxtool.errors import human

    n, sizes, reached = len(field.voxels), field.sizes(), field.reached
    tell = options.tell
    tell(
        f"{what}: tolerance {field.tolerance:.3g}, sign {field.sign}; {reached['leaves']:,} leaves "
        f"in {human(sum(sizes.values()))}, {seconds:.2f} s"
    )
    for where, errors in reached["errors"].items():
        if errors["points"]:
            tell(
                f"  error {where}: 99 % within {errors['p99']:.3g}, rms {errors['rms']:.3g}, max "
                f"{errors['max']:.3g} sides; {100 * errors['within']:.2f} % of "
                f"{errors['points']:,} points within the tolerance"
            )
    if reached["missed"]:
        worst = reached["worst"]
        place = ", ".join(f"{x:.6g}" for x in worst["where"])
        tell(
            f"  missed    {reached['missed']:,} leaves are over the tolerance, by up to "
            f"{worst['error'] - field.tolerance:.3g} sides, at level {worst['level']} near "
            f"({place})"
        )
    if reached["jumps"]:
        tell(f"  jumps     {reached['jumps']:,} leaves, where the sign jumps, as across a hole")
    leaves = [0, *field.leaves_by_level()]
    cells = [sum(pair) for pair in zip(field.cells_by_level(), leaves, strict=True)]
    first = next(level for level, count in enumerate(leaves) if count)
    balance = {None: "", True: "; balanced 2:1", False: "; not balanced 2:1"}
    tell(f"  cells     {', '.join(f'{n:,}' for n in cells)}, of level 0, 1, ...")
    tell(
        f"  leaves    {', '.join(f'{n:,}' for n in leaves[first:])}, of level {first}, "
        f"{first + 1}, ...{balance[reached.get('balanced')]}"
    )
    tell(
        "  bytes     "
        + ", ".join(f"{name} {human(size)}" for name, size in sizes.items())
        + f"; hash {100 * field.hash.load(n):.1f} % full, {field.hash.bits_a_key(n):.2f} bits a key"
    )


def print_plan(plan: FieldPlan, as_json: bool) -> None:
    """What will be done, what is left out and why, and what it will cost."""
    if as_json:
        options.print_json(plan.as_dict())
        return
    from voxtool.errors import human

    rows = [
        *plan.rows(),
        ("stages", ", ".join(plan.stages)),
        *(("left out", f"{what}: {why}") for what, why in plan.left_out.items()),
        ("predicted", f"at most about {plan.blocks:,} blocks, {human(plan.field_bytes)}; "
         f"{human(plan.cost.device)} in work"),
    ]  # fmt: skip
    for name, text in rows:
        click.echo(f"{name:<10} {text}")
