"""voxtool extract --by label: one mesh for each label of an octree."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import click

from voxtool.choices import LABEL, VOXEL_LEVEL
from voxtool.cli import runner
from voxtool.errors import CheckError, VoxtoolError, printable

SHOWN = 10  # labels that the report lists
COLOURED = "glb"  # the format whose meshes have vertices of their own, with colours


def extract_labels(
    run: runner.Run, octree: str, by: str, style: str, check: bool, request: dict[str, Any]
) -> None:
    """Extract and write a mesh for each label; refuse options of single surfaces, which `request`
    has by name.

    Raises
    ------
    CheckError : a mesh is not closed.
    """
    from voxtool.adf.field import DistanceField
    from voxtool.files import check_holds_parts, open_shape, write_mesh
    from voxtool.svo.merged import in_memory
    from voxtool.svo.surface.colours import COLOUR, has_colours
    from voxtool.svo.surface.labelled import LabelledSurface, plan_labelled

    usual = {"isovalue": 0.5, "level": VOXEL_LEVEL, "scale": 1}
    for name, value in request.items():
        if value is not None and value is not False and value != usual.get(name):
            raise click.UsageError(f"--{name} is of a single surface: drop it, or --by {by}")
    check_holds_parts(str(run.file_format))
    run.on_device = False
    facts: dict[str, Any] = {}
    with run, ExitStack() as stack:
        shape: Any = run.stage("read file", stack.enter_context, open_shape(octree))
        with run.naming(octree):
            if isinstance(shape, DistanceField):
                raise VoxtoolError("a field has no labels: --by is of octrees")
            used = (LABEL, COLOUR) if run.file_format == COLOURED else (LABEL,)
            shape = shape.only((LABEL, COLOUR))
            shape = run.stage("read file", in_memory, shape, run.max_memory, used)
            run.on_device = run.file_format == COLOURED and has_colours(shape)
            job = run.plan(plan_labelled, shape, by=by, style=style)
            if job.plan.colours and not run.on_device:
                run.notes.append(f"colours are left out: meshes of labels have them in .{COLOURED}")
                job = job.with_(colours=False)
            surface: LabelledSurface = run.job(
                job, ["check"] * check, empty=lambda surface: not len(surface.faces)
            )
        labels = run.stage("check", surface.facts, True) if check else surface.facts()
        run.write(write_mesh, surface)
        if run.as_json or check:
            facts = {
                "dim": surface.grid.dim,
                "style": surface.style,
                "by": by,
                "vertices": len(surface.points),
                "triangles": len(surface.faces),
                "labels": labels,
                "coloured": len(surface.colours) > 0,
                "digest": surface.digest(),
            }
    run.report(
        f"{surface.text}; {len(surface.vertices):,} vertices, {len(surface.faces):,} triangles",
        lambda: facts,
        _details(labels),
        json_too=check,
    )
    if check and (bad := [one["name"] for one in labels if not one["closed"]]):
        raise CheckError(f"{run.output}: the mesh of {bad[0]} is not closed: report this file")


def _details(labels: list[dict[str, Any]]) -> list[str]:
    """Return the triangles of the first labels, for people."""
    shown = [f"{printable(one['name'])}: {one['triangles']:,} triangles" for one in labels[:SHOWN]]
    more = len(labels) - len(shown)
    return [*shown, *([f"and {more:,} others: see --json"] if more else [])]
