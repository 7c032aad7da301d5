"""voxtool diagnose: what is wrong with a mesh, where, and what to do about it."""

from __future__ import annotations

import click

from voxtool.choices import DEFAULT_DIM
from voxtool.cli import options, runner
from voxtool.cli.inputs import refuse_inputs
from voxtool.cli.many import mesh_argument
from voxtool.cli.options import DIM, flag, option, together
from voxtool.errors import CheckError, count_of

TUBE = 2e-3  # radius of a tube about a loop, of the mesh's longest side


@click.command("diagnose")
@mesh_argument()
@together(
    option("--dim", DIM,
        "Voxels along the longest side, for the rows that leak and the fill rules.", DEFAULT_DIM),
    option("--obj", str, "Write the boundary loops as thin tubes, a mesh that any viewer shows.",
        metavar="FILE.obj"),
    options.length_options(),
    options.clobber_options,
    flag("--strict faults_fail", "Exit 1 if something is wrong."),
)  # fmt: skip
@runner.run_options(options.device_option, options.report_options)  # fmt: skip
def command(
    run: runner.Run, mesh: str, dim: int, units: str | None, scale: float, obj: str | None,
    faults_fail: bool,
) -> None:  # fmt: skip
    """Report what is wrong with a triangle MESH, where, and what to do about it.

    MESH is an OBJ, STL, PLY, OFF, GLB or 3MF file, .gz too, or - for stdin. Lengths and places are
    in the mesh's own units, once scaled; sizes also in voxels of a grid of --dim, on which the fill
    rules of voxelize are compared. Vertices at one position are one; faces are counted from 0.

    \b
    Examples:
      voxtool diagnose open.obj
      voxtool diagnose open.obj --obj leaks.obj
      voxtool diagnose bunny.obj --json --strict
    """
    from voxtool.diagnosis.report import STAGES, diagnose
    from voxtool.files import check_target, format_of, write_mesh
    from voxtool.files.meshes.mesh import load_mesh
    from voxtool.grid import Grid
    from voxtool.mesh.loops import tubes

    if obj is not None:
        if run.item:
            raise click.UsageError("--obj is of one mesh: leave it out, or name one MESH")
        if obj == "-":
            raise click.UsageError("stdout has the report: name a file for --obj")
        format_of(obj, ("obj",))
        if not run.overwrite:
            refuse_inputs([obj])
        check_target(obj, not run.no_clobber)
    with run:
        run.progress.stages = ["read mesh", *STAGES]
        loaded = run.stage("read mesh", load_mesh, mesh, units=units, scale=scale)
        grid = Grid.fit(loaded, dim)
        report = diagnose(loaded, grid, device=run.device, progress=run.progress.enter)
        if obj is not None:
            low, high = loaded.bounds
            edges = loaded.vertices[report.boundary.edges]
            drawn = tubes(edges, TUBE * float((high - low).max()))
            run.stage("write file", write_mesh, drawn, obj, not run.no_clobber, "obj")
    run.answer(report.as_dict(), report.text())
    if obj is not None:
        what = count_of(len(report.boundary.closed), "boundary loop")
        options.tell(f"{options.shown(mesh)} -> {obj}: {what} as tubes")
    run.finish()
    if faults_fail and report.faults:
        faults = "; ".join(fault.what for fault in report.faults)
        raise CheckError(f"{loaded.name or 'mesh'}: {faults} (--strict)")
