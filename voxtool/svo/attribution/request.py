"""The choice of the job that makes an octree with the attributes that are asked for. Modules of
attributes are imported where they are needed: most octrees have none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from voxtool.choices import COLOURS, FILLS, FRACTION, FRACTION_TYPES, NAMED, PRIORITIES
from voxtool.errors import VoxtoolError
from voxtool.grid import Grid
from voxtool.svo.voxelization.voxelize import check_connected, plan_voxelize

if TYPE_CHECKING:
    from voxtool.mesh.appearance import Parts
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.svo.attribution.colours import SurfaceAttributesJob
    from voxtool.svo.attribution.fraction import FractionJob
    from voxtool.svo.attribution.labels import PartLabelsJob
    from voxtool.svo.voxelization.voxelize import VoxelizeJob, Window


def plan_octree(
    mesh: Mesh,
    grid: Grid,
    mode: str,
    *,
    fill: str = FILLS[0],
    gap: int = 0,
    with_surface: bool = False,
    connected: bool = False,
    fraction_type: str | None = None,
    face_fractions: bool = False,
    labels: str | Parts | None = None,
    priority: str | Sequence[str] = PRIORITIES[0],
    attributes: Sequence[str] = (),
    colour: str = COLOURS[0],
    window: Window | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VoxelizeJob | PartLabelsJob | SurfaceAttributesJob | FractionJob:
    """Return the planned job of a voxelization; the parameters are those of `voxtool.voxelize`, and
    the job returns an Octree. VoxtoolError names what does not go together; MeshError and GridError
    as plan_voxelize."""
    if mode == FRACTION:
        check_connected(connected, mode, with_surface, window)
        if with_surface or gap or attributes:
            raise VoxtoolError("mode 'fraction' has no surface, gap and attributes: drop them")
        options: Any = {"fill": fill, "kind": fraction_type or FRACTION_TYPES[0]}
        options |= {"device": device, "max_memory": max_memory}
        if labels is None:
            from voxtool.svo.attribution.fraction import plan_fractions

            return plan_fractions(mesh, grid, faces=face_fractions, window=window, **options)
        if face_fractions or window is not None:
            raise VoxtoolError("fractions of labels are of whole grids, and not of faces: drop "
                               "face_fractions and the window")  # fmt: skip
        from voxtool.svo.attribution.part_fractions import plan_part_fractions

        return plan_part_fractions(mesh, grid, labels=labels, priority=priority, **options)
    if fraction_type is not None or face_fractions:
        name = "face_fractions" if face_fractions else "fraction_type"
        raise VoxtoolError(f"{name} goes with mode 'fraction', not {mode!r}")
    if labels is not None:
        if window is not None:
            raise VoxtoolError("labels take the whole grid: drop the window")
        from voxtool.svo.attribution.labels import plan_labels

        job = plan_labels(
            mesh, grid, mode, labels=labels, priority=priority, fill=fill, gap=gap,
            with_surface=with_surface, connected=connected, device=device, max_memory=max_memory,
        )  # fmt: skip
    else:
        job = plan_voxelize(
            mesh, grid, mode, fill=fill, gap=gap, with_surface=with_surface, connected=connected,
            window=window, device=device, max_memory=max_memory,
        )  # fmt: skip
    if not attributes:
        return job
    from voxtool.svo.attribution.colours import plan_attributes

    return plan_attributes(job, mesh, attributes, colour=colour, max_memory=max_memory)


def kept_for(labels: str | Parts | None, attributes: Sequence[str]) -> tuple[str, ...]:
    """Return what has to be read of a mesh for labels and attributes beside its triangles."""
    return ("appearance",) * ("colour" in attributes) + ("parts",) * (labels in NAMED)
