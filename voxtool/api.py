"""The public functions of voxtool: each does in one call what a command does.

The wings take meshes, octrees, fields and grids. Here, a mesh may also be a path, a
`trimesh.Trimesh` or a pair of arrays, an octree or a field may be a path, and a grid may be given
by its resolution. This module also gives the data classes their pictures in notebooks.
"""

from __future__ import annotations

import io
import math
import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Literal, TypeAlias, TypeVar, get_type_hints, overload

import numpy as np

from voxtool import distances, files, rendering, report
from voxtool.adf import build as adf
from voxtool.adf import query as adf_query
from voxtool.adf.build import FieldJob
from voxtool.adf.field import DistanceField
from voxtool.adf.host_query import QueryResult
from voxtool.adf.query import FieldQuery
from voxtool.camera import Camera, Rays
from voxtool.choices import (
    DEFAULT_MAX_LEVEL,
    DEFAULT_MODE,
    DEFAULT_SEARCH,
    DEFAULT_TOLERANCE,
    FILLS,
    LAYOUTS,
    STYLES,
)
from voxtool.distances import DistanceGridJob, DistanceJob
from voxtool.errors import (
    CheckError,
    DeviceError,
    DeviceWarning,
    FileError,
    GridError,
    MemoryLimitError,
    MeshError,
    MeshWarning,
    VoxtoolError,
    VoxtoolWarning,
)
from voxtool.files import (
    read_adf,
    read_svo,
    read_tet,
    read_unstructured,
    write_adf,
    write_svo,
    write_tet,
)
from voxtool.files.mesh import as_mesh, load_mesh
from voxtool.files.picture import rounded, write_picture, write_png
from voxtool.files.transfer import read_transfer
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.mesh import Mesh, mesh_from_arrays
from voxtool.opencl import Device, list_devices, open_device
from voxtool.rendering import RenderJob, camera_for
from voxtool.report import Report
from voxtool.spatial import deviation as deviations
from voxtool.spatial import signed_distance
from voxtool.spatial.signed_distance import DistanceResult
from voxtool.svo import voxelize as svo
from voxtool.svo.octree import Octree
from voxtool.svo.surface import extract as surfaces
from voxtool.svo.surface.extract import ExtractJob
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.svo.voxelize import VoxelizeJob
from voxtool.tets import textures as tets
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.textures import VolumeJob
from voxtool.tets.transfer import TransferFunction, default_transfer
from voxtool.tets.volume import TetVolume

__all__ = [
    "Camera",
    "CheckError",
    "Cost",
    "Device",
    "DeviceError",
    "DeviceWarning",
    "DistanceField",
    "DistanceGridJob",
    "DistanceJob",
    "DistanceResult",
    "ExtractJob",
    "FieldJob",
    "FieldQuery",
    "FileError",
    "Grid",
    "GridError",
    "Isosurface",
    "Job",
    "MemoryLimitError",
    "Mesh",
    "MeshError",
    "MeshLike",
    "MeshWarning",
    "Octree",
    "Plan",
    "QueryResult",
    "Rays",
    "RenderJob",
    "Report",
    "SignedDistance",
    "TetVolume",
    "TransferFunction",
    "UnstructuredMesh",
    "VolumeJob",
    "VoxelizeJob",
    "VoxtoolError",
    "VoxtoolWarning",
    "build_adf",
    "build_tet",
    "camera_for",
    "default_transfer",
    "deviation",
    "diagnose",
    "distance",
    "distance_grid",
    "export",
    "extract",
    "list_devices",
    "load_mesh",
    "mesh_from_arrays",
    "open_device",
    "plan_adf",
    "plan_distance",
    "plan_distance_grid",
    "plan_extract",
    "plan_render",
    "plan_tet",
    "plan_voxelize",
    "query_adf",
    "read_adf",
    "read_svo",
    "read_tet",
    "read_transfer",
    "read_unstructured",
    "render",
    "voxelize",
    "write_adf",
    "write_mesh",
    "write_picture",
    "write_svo",
    "write_tet",
]

Path: TypeAlias = str | os.PathLike[str]
# A mesh: a Mesh, the path of a mesh file, a trimesh.Trimesh or whatever else has vertices and
# faces, or a pair of arrays, (V, 3) vertices and (F, 3) faces.
MeshLike: TypeAlias = Any
Window: TypeAlias = tuple[Sequence[int], Sequence[int]]
Content = TypeVar("Content")

PICTURE_SIZE = (256, 256)  # pixels of a picture in a notebook
PICTURE_DIM = 128  # voxels along the longest side of a mesh that is shown


def _opened(content: Content | Path, read: Callable[[Path], Content]) -> Content:
    """The content, read if it is a path."""
    if isinstance(content, str | os.PathLike):
        return read(content)
    return content


# ---- files


def write_mesh(
    mesh: MeshLike,
    path: Path,
    clobber: bool = True,
    format: str | None = None,
    normals: np.ndarray | None = None,
) -> None:
    """Write a triangle mesh, or the result of `extract`, as .obj, .ply, .stl, .glb or .off.

    Parameters
    ----------
    path
        `-` writes stdout, as OBJ.
    clobber
        False refuses an existing file.
    format
        "obj", "ply", "stl", "glb" or "off", instead of what the name says.
    normals
        (V, 3) float64 unit vectors, one a vertex, for .obj, .ply and .glb.

    Raises
    ------
    FileError
        the file cannot be written, or the format cannot hold the mesh or its normals.
    MeshError
        a vertex is not finite, or the normals are not one a vertex and finite.
    """
    files.write_mesh(as_mesh(mesh), path, clobber, format, normals)


def export(
    octree: Octree | Path,
    path: Path,
    clobber: bool = True,
    format: str | None = None,
    **options: Any,
) -> None:
    """Export the set voxels as .npy (dense), .npz (coordinates), .vti (ParaView) or .png (slice).

    Parameters
    ----------
    octree
        an Octree or a path.
    clobber
        False refuses an existing file.
    format
        "npy", "npz", "vti" or "png", instead of what the name says.
    options
        for a png, `axis` ("x", "y" or "z") and `value` (a voxel index).

    Raises
    ------
    FileError
        the file cannot be written, is larger than its disk, or its name says no format.
    GridError
        a slice outside the grid. MemoryLimitError : it does not fit in memory.
    """
    files.export(_opened(octree, read_svo), path, clobber, format, **options)


# ---- octrees


def _grid_of(mesh: Mesh, grid: Grid | None, dim: int | None, pitch: float | None) -> Grid:
    if grid is None:
        return Grid.fit(mesh, dim, pitch=pitch)
    if dim is not None or pitch is not None:
        raise GridError("a grid has its own dim and pitch: drop dim= and pitch=, or the grid")
    return grid


def plan_voxelize(
    mesh: MeshLike,
    grid: Grid | None = None,
    mode: str = DEFAULT_MODE,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    with_surface: bool = False,
    window: Window | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VoxelizeJob:
    """Return the job that `voxelize` runs with the same arguments: surveyed and planned."""
    found = as_mesh(mesh)
    return svo.plan_voxelize(
        found, _grid_of(found, grid, dim, pitch), mode, fill=fill, gap=gap,
        with_surface=with_surface, window=window, device=device, max_memory=max_memory,
    )  # fmt: skip


def voxelize(
    mesh: MeshLike,
    grid: Grid | None = None,
    mode: str = DEFAULT_MODE,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    with_surface: bool = False,
    window: Window | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Octree:
    """Return the voxels of a triangle mesh, exactly, as a sparse voxel octree.

    Vertices are rounded once to 1/256 voxel; all that follows is integer arithmetic, so the result
    is the same bit for bit on every device.

    Parameters
    ----------
    mesh
        a Mesh, a path, a trimesh.Trimesh, or a pair of arrays, (V, 3) and (F, 3).
    grid
        where the voxels lie; by default one around the mesh, of `dim` or `pitch`.
    mode
        "solid" (voxels whose centre is inside), "surface26" (voxels that touch a triangle) or
        "surface6" (the thinner, 6-separating set).
    dim
        voxels along the longest side, without a grid; 256 unless pitch is given.
    pitch
        voxel size in world units, without a grid.
    fill
        what is inside, for "solid": "parity" (an odd number of crossings along x), "nonzero"
        (crossings that enter and leave do not cancel), "winding" (a winding number of 1/2 or more),
        "flood" (everything that the outside cannot reach), or "auto": parity if the mesh is closed
        and consistently wound, otherwise winding.
    gap
        for "flood", openings of up to this many voxels are closed first.
    with_surface
        for "solid": add the voxels of "surface26".
    window
        (low, shape) in voxels: only this part of the grid.
    device
        where to compute; the default device if None.
    max_memory
        bytes that the device may use; by default what device and machine have.

    Raises
    ------
    MeshError
        the mesh cannot be read.
    GridError
        a vertex lies more than 2**22 voxels from the grid's corner.
    MemoryLimitError
        the octree would not fit; the message says which dim does.
    DeviceError
        no usable device.

    Warns
    -----
    MeshWarning
        no voxel is set, or the mesh leaks.

    References
    ----------
    [voCCeL]

    Examples
    --------
    >>> octree = voxtool.voxelize("bunny.obj", dim=128)
    >>> octree.count, octree.digest()
    """
    return plan_voxelize(
        mesh, grid, mode, dim=dim, pitch=pitch, fill=fill, gap=gap, with_surface=with_surface,
        window=window, device=device, max_memory=max_memory,
    ).run()  # fmt: skip


def plan_extract(
    octree: Octree | Path,
    *,
    style: str = STYLES[0],
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> ExtractJob:
    """Return the job that `extract` runs with the same arguments."""
    return surfaces.plan_extract(
        _opened(octree, read_svo), style=style, level=level, isovalue=isovalue, merge=merge,
        device=device, max_memory=max_memory,
    )  # fmt: skip


def extract(
    octree: Octree | Path,
    *,
    style: str = STYLES[0],
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Isosurface:
    """Return the surface between the inside and the outside of an octree, closed at the border.

    Parameters
    ----------
    octree
        an Octree or a path.
    style
        "marching-cubes", "voxel-faces" (two triangles a square) or "surface-nets".
    level
        level of the nodes that are samples, from 0 (bricks), or "voxel"; by default 0 for
        marching cubes, otherwise "voxel".
    isovalue
        in (0, 1): a sample is inside if at least this share of its voxels is set.
    merge
        join coplanar squares of voxel faces (greedy meshing); leaves T-junctions.
    device, max_memory
        as voxelize.

    Raises
    ------
    VoxtoolError
        an argument is out of range, or the octree is of a surface and has no inside.
    MemoryLimitError
        the surface would not fit. DeviceError : no usable device.

    Warns
    -----
    MeshWarning
        the surface is empty, or the samples lose parts of the octree.

    Examples
    --------
    >>> surface = voxtool.extract(octree, style="surface-nets")
    >>> voxtool.write_mesh(surface, "bunny.ply")
    """
    return plan_extract(
        octree, style=style, level=level, isovalue=isovalue, merge=merge, device=device,
        max_memory=max_memory,
    ).run()  # fmt: skip


# ---- distances


def plan_adf(
    mesh: MeshLike,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    max_level: int = DEFAULT_MAX_LEVEL,
    band: float = math.inf,
    sign: str | None = None,
    continuous: bool = True,
    bounds: bool = True,
    max_bytes: int | None = None,
    measure: bool = True,
    device: Device | None = None,
    max_memory: int | None = None,
) -> FieldJob:
    """Return the job that `build_adf` runs with the same arguments."""
    return adf.plan_adf(
        as_mesh(mesh), tolerance=tolerance, max_level=max_level, band=band, sign=sign,
        continuous=continuous, bounds=bounds, max_bytes=max_bytes, measure=measure, device=device,
        max_memory=max_memory,
    )  # fmt: skip


def build_adf(
    mesh: MeshLike,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    max_level: int = DEFAULT_MAX_LEVEL,
    band: float = math.inf,
    sign: str | None = None,
    continuous: bool = True,
    bounds: bool = True,
    max_bytes: int | None = None,
    measure: bool = True,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceField:
    """Return the adaptively sampled distance field of a mesh.

    Lengths are in sides of the cube that the field fills, 8/7 of the mesh's longest side. Levels
    are counted from the root, which has level 0; a leaf of level n has an edge of 2**-n. A cell
    through which triangles may pass is refined at least until its edge is 64 tolerances, unless its
    bound is within the tolerance: a wall that no sample hits causes an error of at most half the
    edge.

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
    sign : str, optional
        "pseudonormal", "winding" or "none". By default "pseudonormal" for meshes that are closed,
        consistently wound, free of self-intersections, and without nested shells of the same
        winding; "winding" for all others. On these, "pseudonormal" may give wrong signs, and bounds
        are those of the unsigned distance.
    continuous : bool
        Whether leaves of different levels agree on their common faces.
    bounds : bool
        Whether each leaf stores a bound of its error.
    max_bytes : int, optional
        Approximate size of the field; the largest errors are refined first.
    measure : bool
        Whether the errors of the field are measured; see DistanceField.reached.
    device, max_memory
        As in voxelize.

    Returns
    -------
    DistanceField

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
        If signs are uncertain, or the field has no inside.

    References
    ----------
    [ADF], [Frisken 2000]
    """
    return plan_adf(
        mesh, tolerance=tolerance, max_level=max_level, band=band, sign=sign,
        continuous=continuous, bounds=bounds, max_bytes=max_bytes, measure=measure, device=device,
        max_memory=max_memory,
    ).run()  # fmt: skip


def query_adf(
    field: DistanceField | Path,
    points: Any,
    *,
    search: str = DEFAULT_SEARCH,
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
        How leaves are found: "linear", "binary" or "coherent"; the result is the same.
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
        If there is no device.
    """
    return adf_query.query_adf(
        _opened(field, read_adf), points, search=search, gradient=gradient, bounds=bounds,
        cell=cell, device=device,
    )  # fmt: skip


class SignedDistance(signed_distance.SignedDistance):
    """The exact signed distance to a mesh, for many calls.

    The tree is built once, stays on the device while the mesh is in use, and is shared by all
    objects of the same mesh, sign and device.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    sign : str, optional
        "pseudonormal", "winding" or "none" (no distance is negative). By default "pseudonormal" if
        the mesh is watertight and every face has an area, otherwise "winding".
    device : Device, optional
        Where to compute; the default device if None.

    Attributes
    ----------
    sign : str
        How the sign is found.

    Raises
    ------
    MeshError
        If the mesh cannot be read, or its extent is beyond 2^±500.
    DeviceError
        If there is no device, or it has no double precision.
    VoxtoolError
        If the sign is unknown.

    Examples
    --------
    >>> measure = voxtool.SignedDistance("bunny.obj")
    >>> measure([[0, 0, 0], [0.1, 0, 0]])
    >>> measure([0, 0, 0], gradient=True).gradient
    """

    def __init__(
        self, mesh: MeshLike, sign: str | None = None, device: Device | None = None
    ) -> None:
        super().__init__(as_mesh(mesh), sign, device)


@overload
def distance(
    mesh: MeshLike,
    points: Any,
    *,
    sign: str | None = None,
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
    sign: str | None = None,
    gradient: bool = False,
    nearest: bool = False,
    face: bool = False,
    device: Device | None = None,
) -> DistanceResult: ...
def distance(
    mesh: MeshLike,
    points: Any,
    *,
    sign: str | None = None,
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
    sign : str, optional
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
        If points have a wrong shape, are not finite or 2^500 extents away, or the sign is unknown.
    DeviceError
        If there is no device, or it has no double precision.

    References
    ----------
    [Baerentzen 2005] for pseudo-normals, [Jacobson 2013] and [Barill 2018] for winding numbers.
    """
    return signed_distance.distance(
        as_mesh(mesh), points, sign=sign, gradient=gradient, nearest=nearest, face=face,
        device=device,
    )  # fmt: skip


def plan_distance(
    mesh: MeshLike,
    *,
    sign: str | None = None,
    located: bool = False,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceJob:
    """Return the job whose result, a SignedDistance, measures points.

    Parameters
    ----------
    mesh, sign, device, max_memory
        As in SignedDistance and voxelize.
    located : bool
        Whether gradients, nearest points or faces will be requested.
    """
    return distances.plan_distance(
        as_mesh(mesh), sign=sign, located=located, device=device, max_memory=max_memory
    )


def plan_distance_grid(
    mesh: MeshLike,
    grid: Grid | None = None,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    dtype: Any = np.float64,
    device: Device | None = None,
    max_memory: int | None = None,
) -> DistanceGridJob:
    """Return the job that `distance_grid` runs with the same arguments."""
    found = as_mesh(mesh)
    return distances.plan_distance_grid(
        found, _grid_of(found, grid, dim, pitch), fill=fill, gap=gap, dtype=dtype, device=device,
        max_memory=max_memory,
    )  # fmt: skip


def distance_grid(
    mesh: MeshLike,
    grid: Grid | None = None,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    fill: str = FILLS[0],
    gap: int = 0,
    dtype: Any = np.float64,
    device: Device | None = None,
    max_memory: int | None = None,
) -> np.ndarray:
    """Return the signed distances at the voxel centres of a grid.

    A distance is negative exactly where `voxelize` with the same arguments sets the voxel. The
    magnitudes are those of the unrounded mesh. Where the centre of a set voxel lies on the mesh,
    the distance is the negative normal number nearest to 0, -2.2e-308 (float32: -1.2e-38).

    Parameters
    ----------
    mesh, grid, dim, pitch, gap, device, max_memory
        As in voxelize.
    fill : str
        As in voxelize, or "none" for distances without a sign.
    dtype : dtype
        float64, or float32, to which distances are rounded.

    Returns
    -------
    (nx, ny, nz) array
        World units, [x, y, z].

    Raises
    ------
    MeshError, GridError, MemoryLimitError, DeviceError
        As in voxelize and distance.
    """
    return plan_distance_grid(
        mesh, grid, dim=dim, pitch=pitch, fill=fill, gap=gap, dtype=dtype, device=device,
        max_memory=max_memory,
    ).run()  # fmt: skip


# ---- meshes


def diagnose(
    mesh: MeshLike,
    grid: Grid | None = None,
    *,
    dim: int | None = None,
    device: Device | None = None,
    progress: Callable[[str], None] | None = None,
) -> Report:
    """Report what is wrong with a mesh, where, and what to do about it.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    grid : Grid, optional
        Where the fill rules are compared; by default a grid of `dim` voxels around the mesh.
    dim : int, optional
        Voxels along the longest side, without a grid; 256 by default.
    device : Device, optional
        Where to compute; the default device if None.
    progress : callable, optional
        Called with the name of each stage as it begins.

    Returns
    -------
    Report

    Raises
    ------
    MeshError
        If the mesh cannot be read, or its extent is beyond 2^±500.
    DeviceError
        If there is no device, or it has no double precision.
    """
    found = as_mesh(mesh)
    return report.diagnose(
        found, _grid_of(found, grid, dim, None), device=device, progress=progress
    )


def deviation(
    surface: MeshLike,
    reference: MeshLike,
    samples: int = 100_000,
    pitch: float | None = None,
    device: Device | None = None,
) -> dict[str, Any]:
    """Return the distances between two surfaces, in both directions: mean, RMS and maximum.

    Mean and RMS are over quasi-random points, uniform by area. The maximum is over these and the
    vertices that faces use. It is a lower bound of the one-sided Hausdorff distance, because the
    surface may be farther away between the samples.

    Parameters
    ----------
    surface, reference : Mesh, path, trimesh.Trimesh, pair of arrays, or Isosurface
        The two surfaces.
    samples : int
        Points on each of the two.
    pitch : float, optional
        Side of a voxel, world units, to have the distances in voxels as well.
    device : Device, optional
        Where to compute; the default device if None.

    Returns
    -------
    dict
        JSON types, world units: "samples"; "surface_to_reference" and "reference_to_surface", each
        with "mean", "rms", "max" and "vertices", the number of vertices that the maximum includes;
        "hausdorff", the larger of the two maxima; "maximum_is": "lower bound". With a pitch also
        "pitch", and "voxels", the distances in voxels.

    Raises
    ------
    MeshError
        If a mesh cannot be read, has no area, or has an extent beyond 2^±500.
    VoxtoolError
        If samples or pitch is not positive, or the meshes are 2^500 extents apart.
    DeviceError
        If there is no device, or it has no double precision.

    References
    ----------
    [Cignoni 1998], [Roberts 2018]
    """
    return deviations.deviation(as_mesh(surface), as_mesh(reference), samples, pitch, device)


# ---- volumes and pictures


def build_tet(
    mesh: UnstructuredMesh | Path,
    layout: str = LAYOUTS[0],
    merge_distance: float = 0.0,
    *,
    scalar: str | None = None,
    component: str | int | None = None,
    max_memory: int | None = None,
) -> TetVolume:
    """Return a tetrahedral volume, ready for rendering, of a mesh of volume cells.

    Parameters
    ----------
    mesh : UnstructuredMesh or path
        The mesh, or a file that read_unstructured reads.
    layout : str
        "raycast" ([TetVol] table 5) or "projection" (table 4) split all cells into tetrahedra;
        "hexahedra" (table 5 with six faces) keeps hexahedra with planar faces and one scalar a
        cell.
    merge_distance : float
        Points at most this far apart are merged, world units; 0 merges points at the same position.
    scalar, component : str or int, optional
        The array of a path, as in read_unstructured.
    max_memory : int, optional
        Bytes that the work may take; by default what is free.

    Returns
    -------
    TetVolume

    Raises
    ------
    FileError
        If the file cannot be read.
    MeshError
        If the mesh has no usable volume cells, or float64 cannot hold its range of scalars or
        positions.
    VoxtoolError
        If the layout is unknown or does not hold such scalars.
    MemoryLimitError
        If the work needs more than max_memory, or too many points are within the merge distance.

    References
    ----------
    [TetVol], [Dompierre 1999] for the split into tetrahedra.
    """
    return plan_tet(
        mesh, layout, merge_distance, scalar=scalar, component=component, max_memory=max_memory
    ).run()


def plan_tet(
    mesh: UnstructuredMesh | Path,
    layout: str = LAYOUTS[0],
    merge_distance: float = 0.0,
    *,
    scalar: str | None = None,
    component: str | int | None = None,
    max_memory: int | None = None,
) -> VolumeJob:
    """Return the job that `build_tet` runs with the same arguments."""
    found = _opened(mesh, lambda path: read_unstructured(path, scalar, component))
    return tets.plan_tet(found, layout, merge_distance, max_memory=max_memory)


def plan_render(
    content: Octree | DistanceField | TetVolume | Path,
    view: Camera | Rays | str | None = None,
    *,
    size: tuple[int, int] = rendering.SIZE,
    samples: int | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
    **options: Any,
) -> RenderJob:
    """Return the job that `render` runs with the same arguments."""
    return rendering.plan_render(
        _opened(content, files.read_scene), view, size=size, samples=samples, device=device,
        max_memory=max_memory, **options,
    )  # fmt: skip


def render(
    content: Octree | DistanceField | TetVolume | Path,
    view: Camera | Rays | str | None = None,
    *,
    size: tuple[int, int] = rendering.SIZE,
    samples: int | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
    **options: Any,
) -> np.ndarray:
    """Return a picture of an octree, a distance field or a tetrahedral volume.

    The content stays on the device, so further pictures of it take less time. The result is the
    same bit for bit on every device.

    Parameters
    ----------
    content : Octree, DistanceField, TetVolume or path
        What is drawn.
    view : Camera, Rays or str, optional
        A camera; one ray for each pixel; or the name of a view ("front", "back", "left", "right",
        "top", "bottom", "iso"), with everything in the picture. By default "iso".
    size : (int, int)
        Width and height in pixels; Rays have their own.
    samples : int, optional
        Each pixel is the mean of samples x samples rays; by default 2 for octrees and fields, which
        have sharp edges, and 1 for volumes and for Rays.
    device, max_memory
        As in voxelize.
    **options
        Of an octree `level` ("voxel", or a level from 0 on) and `colour`; of a field `offset`
        (world units) and `colour`; of a volume `transfer` (a TransferFunction), `method`
        ("raycast" or "projection") and `integrator` ("linear", "preintegrated", "average" or
        "sampled:N").

    Returns
    -------
    (height, width, 4) float32
        Premultiplied red, green, blue, and opacity, from 0 to 1; the top row comes first.

    Raises
    ------
    VoxtoolError
        If a view, a size or an option is not valid.
    MemoryLimitError
        If the picture does not fit in memory.
    DeviceError
        If there is no device, or it has no double precision.

    Warns
    -----
    MeshWarning
        If nothing is visible; the message says why.

    References
    ----------
    [Laine 2010] for octrees, [Hart 1996] for fields, [TetVol] and [Moreland 2004] for volumes.

    Examples
    --------
    >>> picture = voxtool.render("bunny.svo.h5", "front", size=(800, 600))
    >>> voxtool.write_picture(picture, "bunny.png")
    """
    return plan_render(
        content, view, size=size, samples=samples, device=device, max_memory=max_memory, **options
    ).run()


# ---- annotations and notebooks

# The modules of these functions import their types for type checkers only.
for _function in (
    camera_for, default_transfer, load_mesh, list_devices, mesh_from_arrays, open_device, read_adf,
    read_svo, read_tet, read_transfer, read_unstructured, write_adf, write_picture, write_svo,
    write_tet,
):  # fmt: skip
    _names = {**globals(), **_function.__globals__}
    _function.__annotations__ = get_type_hints(_function, _names)


def _repr_png_(self: Any) -> bytes | None:
    """The picture that a notebook shows: PNG, or None where none can be made."""
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = self
        if isinstance(self, Isosurface | Mesh):
            content = voxelize(self, dim=PICTURE_DIM, mode="surface26")
        file = io.BytesIO()
        write_png(rounded(render(content, size=PICTURE_SIZE), 8), file)
        return file.getvalue()
    return None


for _shown in (Octree, DistanceField, TetVolume, Isosurface, Mesh):
    _shown._repr_png_ = _repr_png_  # pyright: ignore[reportAttributeAccessIssue]
