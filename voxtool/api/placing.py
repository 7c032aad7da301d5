"""Meshes placed in a unit cube, and in grids."""

from __future__ import annotations

from voxtool.api.octrees import MeshLike
from voxtool.choices import NORMALIZED
from voxtool.files.meshes.mesh import as_mesh
from voxtool.grid import Grid
from voxtool.mesh import lengths
from voxtool.mesh import normalize as normalized
from voxtool.mesh.mesh import Mesh


def normalize(mesh: MeshLike, into: str = NORMALIZED[0]) -> Mesh:
    """Place a mesh in a unit cube or a unit ball; the result keeps the transform.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    into : {"unit", "sphere"}
        "unit" is the cube [0, 1]^3: the longest side of the bounding box becomes 1, and its centre
        (0.5, 0.5, 0.5). "sphere" is the ball of radius 1 at 0: the centre of the bounding box
        becomes 0, and the farthest vertex gets the distance 1.

    Returns
    -------
    Mesh
        Its vertices are `vertices * scale + offset`, its `transform` is (scale, offset x, offset y,
        offset z), which octrees made of it keep, and it has no unit.

    Raises
    ------
    MeshError
        If the mesh cannot be read, has been normalized before, or has an extent beyond 1e±150.
    VoxtoolError
        If `into` is unknown.

    Examples
    --------
    >>> octree = voxtool.voxelize(voxtool.normalize("bunny.obj", "sphere"), dim=128)
    >>> scale, *offset = octree.transform
    """
    return normalized.normalize(as_mesh(mesh), into)


def share_beyond(mesh: MeshLike, grid: Grid) -> float:
    """Return the share of the surface of a mesh that lies beyond a grid, by area.

    Each triangle is clipped by the box of the grid, with its vertices rounded to 1/256 voxel as
    `voxelize` rounds them. A mesh without area counts by the faces that lie wholly beyond.

    Parameters
    ----------
    mesh : Mesh, path, trimesh.Trimesh, or pair of arrays
        The triangle mesh.
    grid : Grid
        The grid, in the unit of the mesh.

    Returns
    -------
    float
        From 0 to 1; clipping errs by about 1e-15, and 1e-12 or less is 0.

    Raises
    ------
    MeshError
        If the mesh cannot be read.

    Examples
    --------
    >>> grid = voxtool.Grid.fit(one, 256)
    >>> if voxtool.share_beyond(other, grid):
    ...     grid = voxtool.Grid.fit(other, lattice=grid)
    """
    return lengths.share_beyond(as_mesh(mesh), grid)
