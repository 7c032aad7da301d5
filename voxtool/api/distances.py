"""Exact distances, and adaptively sampled distance fields."""

from __future__ import annotations

import math
from typing import Any, Literal, overload

import numpy as np

from voxtool import distances
from voxtool.adf.construction.build import FieldJob
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import QueryResult
from voxtool.adf.queries import query as adf_query
from voxtool.api.octrees import MeshLike, Path, opened
from voxtool.choices import (
    DEFAULT_MAX_LEVEL,
    DEFAULT_SEARCH,
    DEFAULT_TEXTURE_3D,
    DEFAULT_TOLERANCE,
    EXACT,
    FILLS,
)
from voxtool.distances import DistanceGridJob, DistanceJob
from voxtool.files import read_adf
from voxtool.files.lattices import placed
from voxtool.files.meshes.mesh import as_mesh
from voxtool.files.storage.spool import Spool
from voxtool.files.storage.streams import STREAM
from voxtool.grid import Grid
from voxtool.job import one_call
from voxtool.opencl import Device, default_device
from voxtool.spatial import signed_distance
from voxtool.spatial.signed_distance import DistanceResult


def plan_adf(
    mesh: MeshLike,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    max_level: int = DEFAULT_MAX_LEVEL,
    band: float = math.inf,
    guarantee: bool = False,
    everywhere: bool = False,
    fill: str = FILLS[0],
    continuous: bool = True,
    bounds: bool = True,
    max_bytes: int | None = None,
    measure: bool = True,
    max_texture: int = DEFAULT_TEXTURE_3D,
    device: Device | None = None,
    max_memory: int | None = None,
) -> FieldJob:
    """Build the adaptively sampled distance field of a mesh.

    Lengths are in sides of the cube that the field fills, 8/7 of the mesh's longest side. Levels
    are counted from the root, which has level 0; a leaf of level n has an edge of 2**-n. A cell
    through which triangles may pass is refined at least until its edge is 64 tolerances, unless its
    bound is within the tolerance: a wall that no sample hits causes an error of at most half the
    edge. A cell that two sheets of the mesh cross
    is refined until it has their signs, or its edge is within the tolerance.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    tolerance : float
        Error at which a cell is no longer refined.
    max_level : int
        Level at which leaves are no longer refined, 1 to 21.
    band : float
        Cells further than this from the surface are not refined.
    guarantee : bool
        Whether a cell is refined until the bound of its error is within the tolerance, not only the
        error at its samples.
    everywhere : bool
        Whether cells along the medial axis are refined to the last level also where the error there
        will exceed the tolerance, too; otherwise they are left at an edge of about the square root
        of the tolerance.
    fill : str
        What is inside: "auto", "winding" or "none" (no distance is negative), or "parity" or
        "nonzero" for closed meshes whose parts do not overlap; see voxelize. Signs are computed by
        pseudo-normals where they are certain, otherwise by winding numbers.
    continuous : bool
        Whether leaves of different levels agree on their common faces.
    bounds : bool
        Whether each leaf stores a bound of its error.
    max_bytes : int, optional
        Approximate size of the field; the largest errors are refined first.
    measure : bool
        Whether the errors of the field are measured; see DistanceField.reached.
    max_texture : int
        Texels that a 3-D texture may have along each axis, 256 to 3072. A field whose blocks would
        not fit is refused.
    device, max_memory
        As in voxelize; voxels and levels that do not fit wait in a temporary file.

    Returns
    -------
    DistanceField
        plan_adf returns the job, whose `run` returns the field.

    Raises
    ------
    MeshError
        If the mesh cannot be read, has no size, or has an extent beyond 2^±500.
    VoxtoolError
        If a number is out of range.
    MemoryLimitError
        If the field does not fit.
    DeviceError
        If there is no device, or it has no double precision.

    Warns
    -----
    MeshWarning
        If signs are uncertain, the field has no inside, or the mesh is thinner than leaves of the
        last level.

    References
    ----------
    [ADF], [Frisken 2000]
    """
    return distances.plan_field(
        as_mesh(mesh, max_memory), tolerance=tolerance, max_level=max_level, band=band,
        guarantee=guarantee, everywhere=everywhere, fill=fill, continuous=continuous,
        bounds=bounds, max_bytes=max_bytes, measure=measure, max_texture=max_texture,
        device=device, max_memory=max_memory, stores=lambda: Spool(STREAM),
    )  # fmt: skip


build_adf = one_call(plan_adf, "build_adf", DistanceField)


def query_adf(
    field: DistanceField | Path,
    points: Any,
    *,
    search: str = DEFAULT_SEARCH,
    sampler: str = EXACT,
    gradient: bool = False,
    bounds: bool = False,
    cell: bool = False,
    device: Device | None = None,
) -> QueryResult:
    """Return the values of a field at points; the field stays on the device for the next call.

    Parameters
    ----------
    field : DistanceField or path
        The field.
    points : (N, 3) or (3,) array_like
        World units; (3,) is one point.
    search : str
        How leaves are found: "linear", "binary", "coherent" or "bottom-up"; the result is the same.
    sampler : str
        "exact", or "hardware": distances are interpolated by the device's filter in a 3-D image,
        which differs from device to device by up to 2**-9 of the range of a leaf's corners an axis.
    gradient, bounds, cell : bool
        Whether these are returned as well.
    device : Device, optional
        Where to compute; the default device if None.

    Returns
    -------
    QueryResult

    Raises
    ------
    VoxtoolError
        If points have a wrong shape, or bounds are requested of a field without them.
    DeviceError
        If there is no device, or it has no filter for the images that the sampler needs.
    """
    return adf_query.query_adf(
        opened(field, read_adf), points, search=search, sampler=sampler, gradient=gradient,
        bounds=bounds, cell=cell, device=device,
    )  # fmt: skip


class SignedDistance(signed_distance.SignedDistance):
    """The exact signed distance to a mesh, for many calls.

    The tree is built once, stays on the device while the mesh is in use, and is shared by all
    objects of the same mesh, sign and device.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    fill : str
        What is inside, as in voxelize: "auto", "parity", "nonzero" or "winding"; or "none": no
        distance is negative. "parity" and "nonzero" count the faces that the row along x crosses
        before a point.
    device : Device, optional
        Where to compute; the default device if None.

    Attributes
    ----------
    fill : str
        The rule that decides what is inside: "parity" for closed meshes whose parts do not overlap.
    sign : str
        How the sign is computed: by "pseudonormal", "winding" numbers, or the rule of rows.
    why : str
        What was found, if parts overlap or are turned; otherwise "".

    Raises
    ------
    MeshError
        If the mesh cannot be read, or its extent is beyond 2^±500.
    DeviceError
        If there is no device, or it has no double precision.
    VoxtoolError
        If the rule is unknown, or is "flood", which fills whole voxels.

    Examples
    --------
    >>> measure = voxtool.SignedDistance("bunny.obj")
    >>> measure([[0, 0, 0], [0.1, 0, 0]])
    >>> measure([0, 0, 0], gradient=True).gradient
    """

    def __init__(self, mesh: MeshLike, fill: str = FILLS[0], device: Device | None = None) -> None:
        device = device or default_device()
        self.given = as_mesh(mesh)
        inside, sign = distances.inside_for(self.given, fill, device)
        self.fill, self.why = inside.fill, inside.why
        super().__init__(inside.mesh_of(self.given), sign, device)


@overload
def distance(
    mesh: MeshLike,
    points: Any,
    *,
    fill: str = FILLS[0],
    gradient: Literal[False] = False,
    nearest: Literal[False] = False,
    face: Literal[False] = False,
    device: Device | None = None,
) -> np.ndarray: ...
@overload
def distance(
    mesh: MeshLike,
    points: Any,
    *,
    fill: str = FILLS[0],
    gradient: bool = False,
    nearest: bool = False,
    face: bool = False,
    device: Device | None = None,
) -> DistanceResult: ...
def distance(
    mesh: MeshLike,
    points: Any,
    *,
    fill: str = FILLS[0],
    gradient: bool = False,
    nearest: bool = False,
    face: bool = False,
    device: Device | None = None,
) -> np.ndarray | DistanceResult:
    """Return the exact signed distances from points to a mesh, negative inside.

    The second call with the same Mesh is fast: its tree stays on the device. The error is at most
    1e-15 of the mesh's extent, or of the distance if that is larger.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    points : (N, 3) or (3,) array_like
        World units; (3,) is one point.
    fill : str
        As in SignedDistance.
    gradient, nearest, face : bool
        Whether these are returned as well, in a DistanceResult.
    device : Device, optional
        Where to compute; the default device if None.

    Returns
    -------
    (N,) float64 or DistanceResult
        World units, never -0.0.

    Raises
    ------
    MeshError
        If the mesh cannot be read, or its extent is beyond 2^±500.
    VoxtoolError
        If points have a wrong shape, are not finite or 2^500 extents away, or the rule is
        unknown.
    DeviceError
        If there is no device, or it has no double precision.

    References
    ----------
    [Baerentzen 2005] for pseudo-normals, [Jacobson 2013] and [Barill 2018] for winding numbers.
    """
    measure = SignedDistance(mesh, fill, device)
    return measure(points, gradient=gradient, nearest=nearest, face=face)


def plan_distance(
    mesh: MeshLike,
    *,
    fill: str = FILLS[0],
    located: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceJob:
    """Return the job whose result, a SignedDistance, measures points.

    Parameters
    ----------
    mesh, fill, device, max_memory
        As in SignedDistance and voxelize.
    located : bool
        Whether gradients, nearest points or faces will be requested.
    """
    return distances.plan_distance(
        as_mesh(mesh, max_memory), fill=fill, located=located, device=device, max_memory=max_memory
    )


def plan_distance_grid(
    mesh: MeshLike,
    grid: Grid | Path | None = None,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    lattice: Grid | Path | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    dtype: Any = np.float64,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceGridJob:
    """Measure the signed distances at the voxel centres of a grid.

    A distance is negative exactly where `voxelize` with the same arguments sets the voxel. The
    magnitudes are those of the unrounded mesh. Where the centre of a set voxel lies on the mesh,
    the distance is the negative normal number nearest to 0, -2.2e-308 (float32: -1.2e-38).

    Parameters
    ----------
    mesh, grid, dim, pitch, lattice, gap, device, max_memory
        As in voxelize; distances are in the unit of the grid.
    fill : str
        As in voxelize, or "none" for distances without a sign.
    dtype : dtype
        float64, or float32, to which distances are rounded.

    Returns
    -------
    (nx, ny, nz) array
        World units, [x, y, z]. plan_distance_grid returns the job, whose `run` returns the array.

    Raises
    ------
    MeshError, GridError, MemoryLimitError, DeviceError
        As in voxelize and distance.
    """
    found, grid, *_ = placed(as_mesh(mesh, max_memory), grid, lattice, dim=dim, pitch=pitch)
    return distances.plan_distance_grid(
        found, grid, fill=fill, gap=gap, dtype=dtype, device=device,
        max_memory=max_memory,
    )  # fmt: skip


distance_grid = one_call(plan_distance_grid, "distance_grid", np.ndarray)
