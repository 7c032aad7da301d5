"""The boundary of a set of voxels as a triangle mesh, and what peers made in the form that ours
has, so that both are held against the model by the same measure."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.svo.layout import BRICK_SIDE

if TYPE_CHECKING:
    from voxtool.grid import Grid
    from voxtool.svo.octree import Octree


def boundary(voxels: np.ndarray, origin: np.ndarray, pitch: np.ndarray) -> Mesh:
    """The faces between set voxels and others, two triangles each, counter-clockwise from outside.

    Parameters
    ----------
    voxels : (nx, ny, nz) bool.
    origin, pitch : (3,) float64: the low corner of the first, and the sides of all, world units.
    """
    padded = np.pad(voxels, 1)
    shape = np.array(padded.shape)
    quads = []
    for axis in range(3):
        other, third = (axis + 1) % 3, (axis + 2) % 3
        step = np.diff(padded.view(np.int8), axis=axis)
        for sign in (1, -1):  # into the set, out of it
            low = np.argwhere(step == sign)
            low[:, axis] += 1  # the plane between the two
            corners = np.repeat(low[:, None], 4, axis=1)
            corners[:, 1:3, other] += 1
            corners[:, 2:4, third] += 1
            quads.append(corners[:, ::-1] if sign > 0 else corners)
    corners = np.concatenate(quads).reshape(-1, 3)
    at = np.ravel_multi_index(tuple(corners.T), tuple(shape + 1))
    places, index = np.unique(at, return_inverse=True)
    vertices = np.stack(np.unravel_index(places, tuple(shape + 1)), axis=1) - 1.0
    index = index.reshape(-1, 4)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]]).astype(np.int32)
    return Mesh(origin + pitch * vertices, faces, name="voxels")


def of_peer(made: Any, grid: Grid) -> Mesh:
    """The boundary of what a peer of voxelize returned: a vtkImageData, or a VoxelGrid of Open3D or
    trimesh."""
    if hasattr(made, "matrix"):
        pitch = np.asarray(made.pitch, np.float64)
        return boundary(made.matrix, made.translation - pitch / 2, pitch)
    if hasattr(made, "get_voxels"):
        cells = np.array([voxel.grid_index for voxel in made.get_voxels()]).reshape(-1, 3)
        voxels = np.zeros(cells.max(axis=0, initial=0) + 1, bool)
        voxels[tuple(cells.T)] = True
        return boundary(voxels, np.asarray(made.origin), np.full(3, made.voxel_size))
    support = importlib.import_module("vtk.util.numpy_support")
    values = support.vtk_to_numpy(made.GetPointData().GetScalars()).reshape(grid.shape[::-1])
    return boundary(values.T != 0, np.array(grid.origin), np.array(grid.pitch))


def of_peer_surface(made: Any, octree: Octree) -> Mesh:
    """The surface that a peer of extract returned, a vtkPolyData or what scikit-image returns; its
    lattice is the middles of the octree's bricks."""
    if isinstance(made, tuple):
        points, faces = made[0][:, ::-1], made[1]
    else:
        support = importlib.import_module("vtk.util.numpy_support")
        points = support.vtk_to_numpy(made.GetPoints().GetData())
        faces = support.vtk_to_numpy(made.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    side = BRICK_SIDE * np.array(octree.grid.pitch)
    places = (points.astype(np.float64) + 0.5) * side + np.array(octree.grid.origin)
    return Mesh(places, faces.astype(np.int32), name="surface")
