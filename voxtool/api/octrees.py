"""Meshes, octrees and surfaces, and what all public functions take besides the data classes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeVar

from voxtool.adf.field.field import DistanceField
from voxtool.adf.surface.extract import plan_field_surface
from voxtool.adf.surface.field_surface import FieldSurface
from voxtool.choices import (
    COLOURS,
    DEFAULT_MODE,
    DEFAULT_STYLE,
    FILLS,
    LABEL_STYLES,
    OPERATIONS,
    PRIORITIES,
    SHARP,
    VOXEL_LEVEL,
)
from voxtool.diagnosis import report
from voxtool.diagnosis.report import Report
from voxtool.errors import VoxtoolError
from voxtool.files import read_shape, read_svo
from voxtool.files.lattices import placed
from voxtool.files.meshes.mesh import as_mesh
from voxtool.grid import Grid, grid_of
from voxtool.job import one_call
from voxtool.mesh.appearance import Parts
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.spatial import orientation
from voxtool.svo.attribution.colours import SurfaceAttributesJob
from voxtool.svo.attribution.fraction import FractionJob
from voxtool.svo.attribution.labels import PartLabelsJob
from voxtool.svo.attribution.request import kept_for, plan_octree
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets import booleans
from voxtool.svo.sets import compare as comparing
from voxtool.svo.sets.booleans import CombineJob
from voxtool.svo.sets.compare import CompareJob, Comparison
from voxtool.svo.surface import extract as surfaces
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.svo.surface.labelled import LabelledSurface, plan_labelled
from voxtool.svo.surface.sharp import source_of
from voxtool.svo.voxelization.voxelize import VoxelizeJob

Path: TypeAlias = str | os.PathLike[str]
# A mesh: a Mesh, the path of a mesh file, a trimesh.Trimesh or whatever else has vertices and
# faces, or a pair of arrays, (V, 3) vertices and (F, 3) faces.
MeshLike: TypeAlias = Any
Window: TypeAlias = tuple[Sequence[int], Sequence[int]]
Content = TypeVar("Content")


def opened(content: Content | Path, read: Callable[[Path], Content]) -> Content:
    """Return the content, read if it is a path."""
    if isinstance(content, str | os.PathLike):
        return read(content)
    return content


def plan_voxelize(
    mesh: MeshLike,
    grid: Grid | Path | None = None,
    mode: str = DEFAULT_MODE,
    *,
    dim: int | None = None,
    pitch: float | None = None,
    lattice: Grid | Path | None = None,
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
    """Voxelize a triangle mesh exactly: the result is a sparse voxel octree.

    Vertices are rounded once to 1/256 voxel; all that follows is integer arithmetic, so the result
    is the same bit for bit on every device.

    Parameters
    ----------
    mesh
        a Mesh, a path, a trimesh.Trimesh, or a pair of arrays, (V, 3) and (F, 3).
    grid
        where the voxels lie, or the path of a file whose grid it is, as `voxtool import` reads it;
        by default a grid around the mesh, of `dim` or `pitch`. If the units of mesh and file are
        known and differ, the mesh is scaled, and the octree has the file's unit.
    mode
        "solid" (voxels whose centre is inside), "surface26" (voxels that touch a triangle),
        "surface6" (the thinner, 6-separating set), or "fraction" (voxels of which a part is inside,
        with the attribute "fraction": how much).
    dim
        voxels along the longest side, without a grid; 256 unless pitch is given.
    pitch
        voxel size in world units, without a grid.
    lattice
        instead of a grid: a grid around the mesh whose voxels coincide with those of this Grid or
        file, so that their octrees combine without loss; units as for a grid.
    fill
        what is inside, for "solid" and "fraction": "parity" (an odd number of crossings along x),
        "nonzero" (crossings that enter and leave do not cancel), "winding" (a winding number of
        1/2 or more), "flood" (everything that the outside cannot reach), or "auto": parity if the
        mesh is closed, the union of its parts if they overlap, winding if it is consistent but
        open, otherwise what keeps its outer surface.
    gap
        for "flood", openings of up to this many voxels are closed first.
    with_surface
        for "solid": add the voxels of "surface26".
    connected
        for "solid": keep parts of the mesh that are thinner than two voxels in one piece. Few
        voxels of "surface26" are added: a tube becomes a curve of voxels, a wall a sheet, and a
        ring stays a ring. `octree.plan["connected"]` counts them.
    fraction_type
        for "fraction": "f4" (float32, the default), "u2" or "u1" (whole numbers, times 65,535 or
        255).
    face_fractions
        for "fraction": the attribute "faces" says how much of each face of a voxel is inside, too.
    labels
        the octree gets the attribute "label": by "part", "material" or "object" of the mesh, read
        with `load_mesh(path, keep=("parts",))`, by "shell", by the "file" of joined meshes, or by
        Parts. Each part is filled by its own fill rule. In a surface, a voxel has the label whose
        triangles have the greatest area there, of equal ones the lower; for "fraction" the one that
        has the greatest share of it.
    priority
        of parts that share a voxel of a solid, or that have equal shares of it with "fraction": the
        "first" counts, or the "last", or the names of those that come before the others, in this
        order.
    attributes
        the voxels of the surface get these: "colour", of a mesh read with
        `load_mesh(path, keep=("appearance",))`, "normal", and "area", in the mesh's unit squared.
        Exposed voxels of a solid that no triangle touches have the colour and the normal of the
        surface's nearest point, other set voxels a default.
    colour
        "mean", by area and in linear light, or "nearest": as the greatest part of the surface in
        the voxel has it, so that there are no new colours.
    window
        (low, shape) in voxels: only this part of the grid.
    device
        where to compute; the default device if None.
    max_memory
        bytes that the device may use; by default what device and machine have.

    Returns
    -------
    Octree
        plan_voxelize returns the job, whose `run` returns the octree.

    Raises
    ------
    MeshError
        the mesh cannot be read; colours are asked for and it has none, or fractions and a flood
        fills it.
    GridError
        a vertex lies more than 2**22 voxels from the grid's corner.
    MemoryLimitError
        the octree would not fit; the message says which dim does.
    DeviceError
        no usable device.

    Warns
    -----
    MeshWarning
        no voxel is set, the mesh leaks, or a part of it lies beyond the grid.

    References
    ----------
    [voCCeL]

    Examples
    --------
    >>> octree = voxtool.voxelize("bunny.obj", dim=128)
    >>> octree.count, octree.digest()
    """
    found = as_mesh(mesh, max_memory, kept_for(labels, attributes))
    found, grid, *_ = placed(found, grid, lattice, dim=dim, pitch=pitch)
    return plan_octree(
        found, grid, mode, fill=fill, gap=gap, with_surface=with_surface, connected=connected,
        fraction_type=fraction_type, face_fractions=face_fractions, labels=labels,
        priority=priority, attributes=attributes, colour=colour, window=window, device=device,
        max_memory=max_memory,
    )  # fmt: skip


voxelize = one_call(plan_voxelize, "voxelize", Octree)


def plan_extract(
    octree: Octree | DistanceField | Path,
    *,
    style: str | None = None,
    by: str | None = None,
    level: int | str | None = None,
    isovalue: float = 0.5,
    merge: bool = False,
    source: Mesh | Path | None = None,
    adaptive: float | None = None,
    offset: float = 0.0,
    shell: float | None = None,
    device: Device | None = None,
    max_memory: int | None = None,
) -> Any:
    """Extract the surface of an octree or of a distance field, closed at the border.

    Parameters
    ----------
    octree
        an Octree, a DistanceField or a path.
    style
        of an octree: "surface-nets" (the default), "marching-cubes", "voxel-faces" (two triangles a
        square), or "sharp", which keeps the edges and corners of the source. For a field:
        "sharp", or by default a surface that rounds them off within a leaf.
    by
        "label": one closed mesh for each label of an octree that has labels, as "surface-nets" or
        "voxel-faces". Where two labels meet, their meshes have the same vertices and triangles.
    level
        "voxel" (the default): the samples are voxels; or the level of the nodes that are samples,
        from 0 (bricks of 4 x 4 x 4 voxels) on, for a coarser surface.
    isovalue
        in (0, 1): a sample is inside if at least this share of its voxels is set.
    merge
        join coplanar squares of voxel faces (greedy meshing); leaves T-junctions.
    source
        the mesh, or a path of it, that the octree or the field was made from; for "sharp".
    adaptive
        of an octree: larger cells where the surface is flat, for fewer triangles. No point of the
        surface is further than this length, in world units, from the surface with cells of one
        size, nor any point of that from it. Its `adaptive` says what is saved. Not of "sharp".
    offset
        of a field: distance of the surface, world units, negative inside.
    shell
        of a field: thickness of a wall inward of that surface; by default all within is solid.
    device, max_memory
        as voxelize.

    Returns
    -------
    Isosurface, or FieldSurface of a field, or LabelledSurface by label
        with the colours of an octree's voxels, if it has any. plan_extract returns the job,
        ExtractJob, FieldSurfaceJob or LabelledJob, whose `run` returns it.

    Raises
    ------
    VoxtoolError
        an argument is out of range, or the octree is of a surface and has no inside, or the
        field does not reach the distance.
    MemoryLimitError
        the surface would not fit. DeviceError : no usable device.

    Warns
    -----
    MeshWarning
        the surface is empty, or the samples lose parts of the octree.

    Examples
    --------
    >>> surface = voxtool.extract(octree)
    >>> voxtool.write_mesh(surface, "bunny.ply")
    """
    found = opened(octree, read_shape)
    if by is not None:
        if isinstance(found, DistanceField):
            raise VoxtoolError("by is of octrees: a field has no labels")
        single = (isovalue, merge, source, adaptive, offset, shell)
        if single != (0.5, False, None, None, 0.0, None) or level not in (None, VOXEL_LEVEL):
            raise VoxtoolError(
                "by label, samples are voxels: leave out level, isovalue, merge, source, adaptive, "
                "offset and shell"
            )
        style = style or LABEL_STYLES[0]
        return plan_labelled(found, by=by, style=style, device=device, max_memory=max_memory)
    if isinstance(found, DistanceField):
        usual = (level, isovalue, merge, adaptive) == (None, 0.5, False, None)
        if not usual or style not in (None, SHARP):
            raise VoxtoolError(
                "style (but sharp), level, isovalue, merge and adaptive are of octrees: this is a "
                "field"
            )
        if (source is None) == (style == SHARP):
            raise VoxtoolError(f"style {SHARP} keeps the edges of a source: give both, or neither")
        source = None if source is None else as_mesh(source, max_memory)
        return plan_field_surface(
            found, offset=offset, shell=shell, source=source, device=device, max_memory=max_memory
        )
    if offset or shell is not None:
        raise VoxtoolError("offset and shell are of distance fields: morph offsets an octree")
    if source is not None:
        source = source_of(found, as_mesh(source, max_memory))
    return surfaces.plan_extract(
        found, style=style or DEFAULT_STYLE, level=level, isovalue=isovalue, merge=merge,
        source=source, adaptive=adaptive, device=device, max_memory=max_memory,
    )  # fmt: skip


SURFACE: Any = (
    Isosurface | FieldSurface | LabelledSurface
)  # by the kind of what it is extracted from
extract = one_call(plan_extract, "extract", SURFACE)


def plan_combine(
    octrees: Sequence[Octree | Path],
    operation: str = OPERATIONS[0],
    *,
    device: Device | None = None,
    max_memory: int | None = None,
) -> CombineJob:
    """Combine the sets of voxels of octrees of one lattice.

    The grid of the result is the smallest one that holds all their grids. The result is pruned: it
    has a leaf wherever all voxels of a node are set, or none, so that equal sets are equal octrees.
    Its mode is "solid" and its fill "none".

    Parameters
    ----------
    octrees
        one or more Octrees or paths; their voxels have one size, and their origins are whole
        numbers of voxels apart.
    operation
        "union" (set in one), "intersection" (set in all), "difference" (set in the first and in no
        other) or "xor" (set in an odd number of them).
    device, max_memory
        as voxelize.

    Returns
    -------
    Octree
        plan_combine returns the job, whose `run` returns the octree.

    Raises
    ------
    GridError
        the octrees are of different lattices or units.
    MemoryLimitError
        the result might not fit.
    DeviceError
        no usable device.

    Examples
    --------
    >>> both = voxtool.combine([one, other], "intersection")
    >>> both == one & other
    """
    found = [opened(octree, read_svo) for octree in octrees]
    return booleans.plan_combine(found, operation, device=device, max_memory=max_memory)


combine = one_call(plan_combine, "combine", Octree)


def plan_compare(
    one: Octree | Path,
    other: Octree | Path,
    *,
    device: Device | None = None,
    max_memory: int | None = None,
) -> CompareJob:
    """Compare the sets of voxels of two octrees of one lattice.

    Parameters
    ----------
    one, other
        Octrees or paths, as combine takes them; what lies beyond a grid is not set.
    device, max_memory
        as voxelize.

    Returns
    -------
    Comparison
        what is set only in the first, only in the second, and in both. plan_compare returns the
        job, whose `run` returns it.

    Raises
    ------
    GridError
        the octrees are of different lattices or units.
    MemoryLimitError
        the comparison might not fit.
    DeviceError
        no usable device.

    Examples
    --------
    >>> found = voxtool.compare(one, other)
    >>> found.equal, found.first.count, found.summary()["jaccard"]
    """
    octrees = (opened(octree, read_svo) for octree in (one, other))
    return comparing.plan_compare(*octrees, device=device, max_memory=max_memory)


compare = one_call(plan_compare, "compare", Comparison)


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
        If the mesh cannot be read, or its extent is beyond 2^±250.
    DeviceError
        If there is no device, or it has no double precision.
    """
    found = as_mesh(mesh)
    return report.diagnose(found, grid_of(found, grid, dim, None), device=device, progress=progress)


def orient(mesh: MeshLike, *, device: Device | None = None) -> Mesh:
    """Turn the faces of a mesh outward, by what is seen from outside and by parity
    [Takayama 2014].

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    device : Device, optional
        Where to compute; the default device if None.

    Returns
    -------
    Mesh
        With the same vertices, and the same faces in the same order, some of them reversed; the
        given mesh if none is.

    Raises
    ------
    MeshError
        If the mesh cannot be read, or its extent is beyond 2^±500.
    DeviceError
        If there is no device, or it has no double precision.

    Examples
    --------
    >>> octree = voxtool.voxelize(voxtool.orient("parts.stl"), fill="winding")
    """
    return orientation.orient(as_mesh(mesh), device).mesh
