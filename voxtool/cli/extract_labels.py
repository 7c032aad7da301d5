"""voxtool extract --by label: one mesh for each label of an octree."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from voxtool.choices import LABEL, VOXEL_FACES, VOXEL_LEVEL
from voxtool.cli import runner
from voxtool.cli.extract import MUCH, ROUNDED, percent_off, volume_text, volumes_of
from voxtool.errors import CheckError, VoxtoolError, count_of, printable

if TYPE_CHECKING:
    from voxtool.svo.octree.content import AttributedContent

SHOWN = 10  # labels that the report lists
COLOURED = "glb"  # the format whose meshes have vertices of their own, with colours


def extract_labels(
    run: runner.Run,
    octree: str,
    by: str,
    style: str,
    check: bool,
    origin: tuple[float, ...] | None,
    request: dict[str, Any],
) -> None:
    """Extract and write a mesh for each label; refuse options of single surfaces, which `request`
    has by name.

    Raises
    ------
    CheckError : a mesh is not closed.
    """
    from voxtool.adf.field.field import DistanceField
    from voxtool.files import check_holds_parts, open_shape, write_mesh
    from voxtool.svo.octree.attributes import COLOUR, has_colours
    from voxtool.svo.octree.octree import in_memory
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
        total = with_voxels(labels, shape)
        if abs(total["volume_ratio"] - 1) > MUCH:
            run.notes.append(ROUNDED.format(f"--style {VOXEL_FACES}"))
        run.write(write_mesh, surface, origin=origin)
        if run.as_json or check:
            facts = {
                "dim": surface.grid.dim,
                "style": surface.style,
                "by": by,
                "vertices": len(surface.points),
                "triangles": len(surface.faces),
                **total,
                "labels": labels,
                "coloured": len(surface.colours) > 0,
                "digest": surface.digest(),
                **({"origin": list(origin)} if origin else {}),
            }
    run.report(
        f"{surface.text}; {count_of(len(surface.vertices), 'vertex')}, "
        f"{count_of(len(surface.faces), 'triangle')}; {volume_text(total, surface.units)}"
        f"{_most_off(labels)}, {run.size}",
        lambda: facts,
        _details(labels, surface.units),
        json_too=check,
    )
    if check and (bad := [one["name"] for one in labels if not one["closed"]]):
        raise CheckError(f"{run.output}: the mesh of {bad[0]} is not closed: report this file")


def with_voxels(labels: list[dict[str, Any]], octree: AttributedContent) -> dict[str, float]:
    """Add to the facts of labels the volumes of their voxels; return the volumes of all."""
    from voxtool.svo.octree.label_counts import label_counts

    counts, cell = label_counts(octree)[0], octree.grid.voxel_volume
    for one in labels:
        one |= volumes_of(one["volume"], float(counts[one["label"]]) * cell)
    return volumes_of(*(sum(one[name] for one in labels) for name in ("volume", "octree_volume")))


def _most_off(labels: list[dict[str, Any]]) -> str:
    """Return the label whose volume differs most from that of its voxels, if there are several."""
    most = max(labels, key=lambda one: abs(one["volume_ratio"] - 1))
    return f", at worst {printable(most['name'])} {percent_off(most)}" if len(labels) > 1 else ""


def _details(labels: list[dict[str, Any]], units: str) -> list[str]:
    """Return the triangles and volumes of the first labels, for people."""
    shown = [
        f"{printable(one['name'])}: {count_of(one['triangles'], 'triangle')}, "
        f"{volume_text(one, units)}"
        for one in labels[:SHOWN]
    ]
    more = len(labels) - len(shown)
    return [*shown, *([f"and {more:,} others: see --json"] if more else [])]
