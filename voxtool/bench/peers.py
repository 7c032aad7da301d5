"""Other tools on the same work, where they are installed: mesh in memory to voxels in memory,
octree in memory to surface in memory, and distances from points to a mesh."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.morton import morton_decode
from voxtool.svo.octree import BRICK_SIDE, Octree

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.grid import Grid
    from voxtool.mesh import Mesh


def of(mesh: Mesh, grid: Grid, mode: str) -> dict[str, Callable[[], object]]:
    """The peers that do this mode's work, by name and version; their inputs are made beforehand."""
    makers = {"solid": _vtk_stencil, "surface26": _open3d_voxel_grid}
    if mode not in makers:
        return {}
    made = makers[mode](mesh, grid)
    return dict([made]) if made else {}


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except (ImportError, OSError):  # not there, or a library that it needs is not
        return None


def _vtk_stencil(mesh: Mesh, grid: Grid) -> tuple[str, Callable[[], object]] | None:
    """vtkPolyDataToImageStencil, and the image of bytes that it is for."""
    vtk, support = _module("vtk"), _module("vtk.util.numpy_support")
    if vtk is None:
        return None
    points, cells, surface = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
    points.SetData(support.numpy_to_vtk(mesh.vertices, deep=True))
    faces = mesh.faces.astype(np.int64)
    cells.SetData(
        support.numpy_to_vtk(3 * np.arange(len(faces) + 1, dtype=np.int64), deep=True),
        support.numpy_to_vtk(faces.ravel(), deep=True),
    )
    surface.SetPoints(points)
    surface.SetPolys(cells)

    def run() -> object:
        stencil = vtk.vtkPolyDataToImageStencil()
        stencil.SetInputData(surface)
        stencil.SetOutputOrigin(*(np.array(grid.origin) + 0.5 * np.array(grid.pitch)))
        stencil.SetOutputSpacing(*grid.pitch)
        stencil.SetOutputWholeExtent(*(v for n in grid.shape for v in (0, n - 1)))
        image = vtk.vtkImageStencilToImage()
        image.SetInputConnection(stencil.GetOutputPort())
        image.SetInsideValue(1)
        image.SetOutputScalarTypeToUnsignedChar()
        image.Update()
        return image.GetOutput()

    return f"VTK {vtk.vtkVersion().GetVTKVersion()}", run


def _open3d_voxel_grid(mesh: Mesh, grid: Grid) -> tuple[str, Callable[[], object]] | None:
    """VoxelGrid.create_from_triangle_mesh."""
    open3d = _module("open3d")
    if open3d is None:
        return None
    geometry = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces)
    )

    def run() -> object:
        return open3d.geometry.VoxelGrid.create_from_triangle_mesh(geometry, grid.pitch[0])

    return f"Open3D {open3d.__version__}", run


def of_octree(octree: Octree, isovalue: float) -> dict[str, Callable[[], object]]:
    """The peers that extract a smooth surface, by name and version. They need the dense grid of
    coverages, which is computed in their time."""
    makers = (_vtk_flying_edges, _skimage_marching_cubes)
    return dict(made for maker in makers if (made := maker(octree, isovalue)))


def coverage_grid(octree: Octree) -> np.ndarray:
    """(nz, ny, nx) uint8: the set voxels of each brick of the octree's cube."""
    n = octree.grid.side // BRICK_SIDE
    grid = np.zeros((n, n, n), np.uint8)
    for level in octree.levels():
        if level.number:
            s = level.side // BRICK_SIDE
            blocks = grid.reshape(n // s, s, n // s, s, n // s, s).transpose(0, 2, 4, 1, 3, 5)
            x, y, z = morton_decode(level.codes[level.inside]).T
            blocks[z, y, x] = BRICK_SIDE**3
        else:
            x, y, z = morton_decode(level.codes).T
            grid[z, y, x] = np.bitwise_count(octree.bricks)
    return grid


def _vtk_flying_edges(octree: Octree, isovalue: float) -> tuple[str, Callable[[], object]] | None:
    """vtkFlyingEdges3D on all cores, without normals."""
    vtk, support = _module("vtk"), _module("vtk.util.numpy_support")
    if vtk is None:
        return None

    def run() -> object:
        vtk.vtkSMPTools.SetBackend("STDThread")
        vtk.vtkSMPTools.Initialize(os.cpu_count() or 1)
        coverage = coverage_grid(octree)
        image = vtk.vtkImageData()
        image.SetDimensions(*coverage.shape[::-1])
        image.GetPointData().SetScalars(support.numpy_to_vtk(coverage.ravel()))
        edges = vtk.vtkFlyingEdges3D()
        edges.SetInputData(image)
        edges.SetValue(0, BRICK_SIDE**3 * isovalue)
        edges.ComputeNormalsOff()
        edges.ComputeGradientsOff()
        edges.Update()
        return edges.GetOutput()

    return f"VTK {vtk.vtkVersion().GetVTKVersion()}", run


def _skimage_marching_cubes(
    octree: Octree, isovalue: float
) -> tuple[str, Callable[[], object]] | None:
    """skimage.measure.marching_cubes, of Lewiner."""
    skimage, measure = _module("skimage"), _module("skimage.measure")
    if measure is None:
        return None

    def run() -> object:
        coverage = coverage_grid(octree)
        return measure.marching_cubes(coverage, BRICK_SIDE**3 * isovalue)

    return f"scikit-image {skimage.__version__}", run


@dataclass(frozen=True)
class DistancePeer:
    """What computes the signed distance of points to a mesh.

    build : makes what it needs of the mesh, and returns what gives (N,) float distances at (N, 3)
    float64 points; builds_each_time : this builds it anew whenever it is asked.
    """

    name: str
    build: Callable[[], Callable[[np.ndarray], np.ndarray]]
    builds_each_time: bool = False


DISTANCE_MODULES = {"open3d": "open3d", "igl": "libigl"}  # and what pip calls them


def of_distance(mesh: Mesh) -> list[DistancePeer]:
    """The peers that compute signed distances, each with the threads that it takes by itself."""
    return [peer for maker in (_open3d_scene, _igl_signed_distance) if (peer := maker(mesh))]


def missing_of_distance() -> list[str]:
    """What pip calls those that are not installed."""
    return [package for module, package in DISTANCE_MODULES.items() if _module(module) is None]


def _open3d_scene(mesh: Mesh) -> DistancePeer | None:
    """RaycastingScene.compute_signed_distance, which is in float32; its sign is by parity."""
    open3d = _module("open3d")
    if open3d is None:
        return None
    as_tensor = open3d.core.Tensor
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)

    def build() -> Callable[[np.ndarray], np.ndarray]:
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(as_tensor(vertices), as_tensor(faces))

        def distance(points: np.ndarray) -> np.ndarray:
            return scene.compute_signed_distance(as_tensor(points.astype(np.float32))).numpy()

        distance(mesh.vertices[:1])  # the first query builds the tree
        return distance

    return DistancePeer(f"Open3D {open3d.__version__}", build)


def _igl_signed_distance(mesh: Mesh) -> DistancePeer | None:
    """signed_distance with fast winding numbers w, which builds its trees in every call, and gives
    (1 - 2 |w|) times the distance: it is exact where w is 0 or 1."""
    igl = _module("igl")
    if igl is None:
        return None
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER

    def distance(points: np.ndarray) -> np.ndarray:
        return igl.signed_distance(points, vertices, faces, sign)[0]

    def build() -> Callable[[np.ndarray], np.ndarray]:
        distance(vertices[:1])
        return distance

    return DistancePeer(f"libigl {importlib.metadata.version('libigl')}", build, True)
