"""Repair of meshes."""

from __future__ import annotations

from collections.abc import Sequence

from voxtool.api.octrees import MeshLike
from voxtool.choices import FILLS
from voxtool.files.meshes.mesh import as_mesh
from voxtool.grid import Grid
from voxtool.job import one_call
from voxtool.opencl import Device
from voxtool.repairing import job as repairs
from voxtool.repairing.job import RepairJob
from voxtool.repairing.result import Repaired


def plan_repair(
    mesh: MeshLike,
    grid: Grid | None = None,
    *,
    dim: int | None = None,
    tolerance: float | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    keep_components: int | None = None,
    offset: float = 0.0,
    shell: float = 0.0,
    thicken: float = 0.0,
    drains: Sequence[Sequence[float]] = (),
    simplify: float = 0.0,
    device: Device | None = None,
    max_memory: int | None = None,
) -> RepairJob:
    """Make a closed, consistently wound, manifold mesh of any triangle mesh.

    The voxels of a grid decide what is inside. The result is a net around them with a vertex in
    each cell between eight centres that are not all inside; the vertex lies on the mesh where the
    mesh passes its cell.

    Parameters
    ----------
    mesh
        as voxelize; it may have holes, flipped or repeated faces, open or intersecting parts.
    grid
        where the voxels lie, which are cubes; by default one around the mesh, of `dim` or
        `tolerance`.
    dim
        voxels along the longest side, without a grid; 256 by default.
    tolerance
        diagonal of a voxel in world units, instead of dim.
    fill, gap
        what is inside, as voxelize; but "auto" takes "nonzero" for watertight meshes, with their
        outermost shells turned outward, so that parts that overlap are united.
    keep_components
        connected components of voxels that are kept, the largest first; by default all.
    offset
        distance in world units by which the repaired surface is moved, outward or, if negative,
        inward.
    shell
        wall in world units, at least 2 voxels: the solid is hollow, with the repaired surface
        outside. Cavities smaller than a cube of the wall's side stay solid.
    thicken
        wall in world units, at least 2 voxels: the result is what lies within half of it of the
        mesh, whatever is inside; for open surfaces. Excludes offset and shell, as they do.
    drains
        with shell, holes from outside to the cavity: x, y, z and a radius each, in world units, at
        least 1.5 voxels. A hole goes along the normal at the surface's nearest point.
    simplify
        largest distance in world units by which the surface may move to have fewer triangles,
        with the package manifold3d; 0 keeps all.
    device, max_memory
        as voxelize.

    Returns
    -------
    Repaired
        plan_repair returns the job, whose `run` returns it.

    Raises
    ------
    MeshError, GridError
        the mesh cannot be read, or the grid not be placed.
    VoxtoolError
        an argument is out of range, no voxel is inside, or a wall leaves no cavity.
    MemoryLimitError
        it would not fit.
    DeviceError
        no usable device, or it has no double precision.

    Warns
    -----
    MeshWarning
        faces of the result pass through others, or a cavity has no drain where others have one.

    References
    ----------
    [Gibson 1998]

    Examples
    --------
    >>> fixed = voxtool.repair("bunny.obj", dim=512, keep_components=1)
    >>> fixed.checked["genus"], fixed.distances["outer_mesh_to_result"]
    >>> voxtool.write_mesh(fixed, "fixed.ply")
    """
    found = as_mesh(mesh, max_memory)
    return repairs.plan_repair(
        found, grid or repairs.grid_for(found, dim, tolerance), fill=fill, gap=gap,
        keep_components=keep_components, offset=offset, shell=shell, thicken=thicken,
        drains=drains, simplify=simplify, device=device, max_memory=max_memory,
    )  # fmt: skip


repair = one_call(plan_repair, "repair", Repaired)
