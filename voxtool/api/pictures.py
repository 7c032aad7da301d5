"""Volumes, and pictures of all content."""

from __future__ import annotations

import io
import warnings
from contextlib import suppress
from typing import Any

import numpy as np

from voxtool import files
from voxtool.adf.field.field import DistanceField
from voxtool.api.octrees import Path, opened, voxelize
from voxtool.camera import Camera, Rays
from voxtool.choices import LAYOUTS, MAX_TEXTURE_2D
from voxtool.files import read_unstructured
from voxtool.files.pictures.picture import rounded, write_png
from voxtool.grid import Grid
from voxtool.job import one_call
from voxtool.mesh.mesh import Mesh
from voxtool.opencl import Device
from voxtool.pictures import rendering
from voxtool.pictures.rendering import RenderJob
from voxtool.svo.dag.merged import MergedOctree
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.labels import Labels
from voxtool.svo.solvers.wall_links import WallLinks
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.tets.construction import textures as tets
from voxtool.tets.construction.textures import VolumeJob
from voxtool.tets.volume.mesh import UnstructuredMesh
from voxtool.tets.volume.volume import TetVolume

PICTURE_SIZE = (256, 256)  # pixels of a picture in a notebook
PICTURE_DIM = 128  # voxels along the longest side of a mesh that is shown

# files imports the types of its functions for type checkers only; get_type_hints needs them too.
TYPES = (
    Device, DistanceField, Grid, Labels, MergedOctree, Octree, OctreeContent, TetVolume,
    UnstructuredMesh, WallLinks,
)  # fmt: skip
files.__dict__.update({type_.__name__: type_ for type_ in TYPES}, np=np)


def plan_tet(
    mesh: UnstructuredMesh | Path,
    layout: str = LAYOUTS[0],
    merge_distance: float = 0.0,
    *,
    scalar: str | None = None,
    component: str | int | None = None,
    max_texture: int = MAX_TEXTURE_2D,
    device: Device | None = None,
    max_memory: int | None = None,
) -> VolumeJob:
    """Build a tetrahedral volume, ready for rendering, from a mesh of volume cells.

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
    max_texture : int
        Texels that a 2-D texture may have along each axis, 2048 to 16384. A volume that would not
        fit is refused.
    device : Device, optional
        Where the textures are computed; by default the default device.
    max_memory : int, optional
        Bytes that the work may take; by default what the device has.

    Returns
    -------
    TetVolume
        plan_tet returns the job, whose `run` returns the volume.

    Raises
    ------
    FileError
        If the file cannot be read.
    MeshError
        If the mesh has no usable volume cells, or float64 cannot hold its range of scalars or
        positions.
    VoxtoolError
        If the layout is unknown or does not hold such scalars.
    DeviceError
        If the device has no double precision.
    MemoryLimitError
        If the work needs more than max_memory, or too many points are within the merge distance.

    References
    ----------
    [TetVol], [Dompierre 1999] for the split into tetrahedra.
    """
    found = opened(mesh, lambda path: read_unstructured(path, scalar, component, max_memory))
    return tets.plan_tet(
        found, layout, merge_distance, max_texture=max_texture, device=device, max_memory=max_memory
    )


build_tet = one_call(plan_tet, "build_tet", TetVolume)


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
    """Draw a picture of an octree, a distance field or a tetrahedral volume.

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
        For an octree: `level` ("voxel", or a level from 0 on), with a level `isovalue` (the least
        share of a node that is set; by default any), `colour`, `other` (an octree of the same grid,
        for a picture of what only one of them has), `colour_by` ("label", "colour", "normal",
        "fraction" or "none": the attribute whose colours are drawn; by default the colour, or else
        the label, if there is one) and `only` (names of labels that are drawn alone).
        For a field: `offset` (world units), `search` ("linear", "binary", "coherent" or
        "bottom-up", for the same picture) and `colour`.
        For a volume: `transfer` (a TransferFunction), `method` ("raycast" or "projection"),
        `integrator` ("linear", "preintegrated", "average" or "sampled:N"), `isovalues` (scalars
        whose surfaces are drawn; alone, if there is no `transfer`), and their `opacity` and
        `colour`.

    Returns
    -------
    (height, width, 4) float32
        Premultiplied red, green, blue, and opacity, from 0 to 1; the top row comes first.
        plan_render returns the job, whose `run` returns the picture.

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
    [Laine 2010] for octrees, [Marmitt 2004] for fields, [TetVol] and [Moreland 2004] for volumes.

    Examples
    --------
    >>> picture = voxtool.render("bunny.svo.h5", "front", size=(800, 600))
    >>> voxtool.write_picture(picture, "bunny.png")
    """
    return rendering.plan_render(
        opened(content, files.read_drawn), view, size=size, samples=samples, device=device,
        max_memory=max_memory, **options,
    )  # fmt: skip


render = one_call(plan_render, "render", np.ndarray)


def _repr_png_(self: Any) -> bytes | None:
    """Return the picture that a notebook shows: PNG, or None where none can be made."""
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
