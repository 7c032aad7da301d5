"""Distances between meshes, sampled or bounded."""

from __future__ import annotations

from typing import Any

from voxtool.api.octrees import MeshLike
from voxtool.files.meshes.mesh import as_mesh
from voxtool.opencl import Device
from voxtool.spatial import deviation as deviations
from voxtool.spatial import hausdorff as bounds
from voxtool.spatial.hausdorff import DirectedHausdorff, Hausdorff


def hausdorff(
    a: MeshLike,
    b: MeshLike,
    *,
    tolerance: float | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Hausdorff:
    """Return two bounds of the Hausdorff distance between meshes, by branch and bound.

    It is the largest distance from a point of either mesh to the other. The bounds hold: no point
    between samples is missed, and rounding, about 2^-41 of the extents, is included.

    Parameters
    ----------
    a, b : Mesh, path, trimesh.Trimesh, pair of arrays, or Isosurface
        The two meshes; they need not be closed, and faces without area count. If both have units,
        and different ones, b is scaled: distances are in the unit of a.
    tolerance : float, optional
        How far apart the bounds of each direction may be, world units; by default 1e-5 of the
        diagonal of the box around both meshes. They are further apart if it is less than the
        rounding, or if more than 2,097,152 pieces of faces, or those that fit in max_memory,
        are undecided at once.
    device, max_memory
        As in voxelize.

    Returns
    -------
    Hausdorff
        With `lower` and `upper`, and as `a_to_b` and `b_to_a` those of each direction.

    Raises
    ------
    MeshError
        If a mesh cannot be read, or its extent is beyond 2^±500.
    VoxtoolError
        If the tolerance is not positive, or the meshes are 2^500 extents apart.
    MemoryLimitError
        If the meshes do not fit.
    DeviceError
        If there is no device, or it has no double precision.

    References
    ----------
    [Guthe 2005], [Tang 2009], [Sacht 2024]

    Examples
    --------
    >>> apart = voxtool.hausdorff("bunny.obj", "simplified.obj")
    >>> apart.lower, apart.upper, apart.a_to_b.point
    """
    return bounds.hausdorff(
        as_mesh(a, max_memory), as_mesh(b, max_memory), tolerance, device, max_memory
    )


def directed_hausdorff(
    mesh: MeshLike,
    other: MeshLike,
    *,
    tolerance: float | None = None,
    faces: Any = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DirectedHausdorff:
    """Return two bounds of the largest distance from a point of a mesh to another mesh.

    Parameters
    ----------
    mesh, other, tolerance, device, max_memory
        As in hausdorff.
    faces : (F,) array_like of bool, or (N,) of int, optional
        The faces of `mesh` whose points count; by default all.

    Returns
    -------
    DirectedHausdorff

    Raises
    ------
    MeshError
        As hausdorff, and if `faces` are not faces of the mesh, or none.
    VoxtoolError, MemoryLimitError, DeviceError
        As hausdorff.

    References
    ----------
    [Guthe 2005], [Tang 2009], [Sacht 2024]
    """
    return bounds.directed_hausdorff(
        as_mesh(mesh, max_memory), as_mesh(other, max_memory), tolerance, faces, device, max_memory
    )


def deviation(
    surface: MeshLike,
    reference: MeshLike,
    samples: int = 100_000,
    pitch: float | None = None,
    device: Device | None = None,
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Return the distances between two surfaces, in both directions: mean, RMS and maximum.

    Mean and RMS are over quasi-random points, uniform by area. The maximum, which is the directed
    Hausdorff distance, is over all points: it lies between two bounds, as of voxtool.hausdorff.

    Parameters
    ----------
    surface, reference : Mesh, path, trimesh.Trimesh, pair of arrays, or Isosurface
        The two surfaces. If both have units, and different ones, the reference is scaled:
        distances are in the unit of the surface.
    samples : int
        Points on each of the two.
    pitch : float, optional
        Side of a voxel, world units, to have the distances in voxels as well.
    device : Device, optional
        Where to compute; the default device if None.

    tolerance : float, optional
        As in hausdorff: how far apart the two bounds may be.

    Returns
    -------
    dict
        JSON types, world units: "samples"; "tolerance"; "surface_to_reference" and
        "reference_to_surface", each with "mean", "rms", "max" and "max_upper", between which the
        maximum lies, "point", where the distance is "max", and "nearest", the nearest point of the
        other; "hausdorff" and "hausdorff_upper", the larger ones of the two directions. With a
        pitch also "pitch", and "voxels", the distances in voxels.

    Raises
    ------
    MeshError
        If a mesh cannot be read, has no area, or has an extent beyond 2^±500.
    VoxtoolError
        If samples, pitch or tolerance is not positive, or the meshes are 2^500 extents apart.
    DeviceError
        If there is no device, or it has no double precision.

    References
    ----------
    [Cignoni 1998], [Roberts 2018], [Guthe 2005], [Sacht 2024]
    """
    return deviations.deviation(
        as_mesh(surface), as_mesh(reference), samples, pitch, device, tolerance
    )
