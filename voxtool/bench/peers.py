"""Other tools on the same work, if they are installed: mesh to voxels, octree to surface, distances
from points to a mesh, and pictures of volumes, all in memory."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.morton import morton_decode
from voxtool.svo.layout import BRICK_SIDE
from voxtool.svo.octree import Octree

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.camera import Rays
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.tets.transfer import TransferFunction


PACKAGES = {  # imported name, package name, and the benches that use it
    "vtk": ("vtk", {"voxelize", "extract", "tets"}),
    "open3d": ("open3d", {"voxelize", "adf"}),
    "igl": ("libigl", {"adf"}),
    "skimage": ("scikit-image", {"extract"}),
    "scipy": ("scipy", {"voxelize"}),  # needed by trimesh
}


def missing(benches: set[str]) -> list[str]:
    """The packages that these benches could use and that are not installed."""
    return [
        package
        for name, (package, used) in PACKAGES.items()
        if used & benches and _module(name) is None
    ]


def of(mesh: Mesh, grid: Grid, mode: str) -> dict[str, Callable[[], object]]:
    """The tools that voxelize in this mode, by name and version; their inputs are made before."""
    makers = {
        "solid": (_vtk_stencil, _trimesh_filled),
        "surface26": (_open3d_voxel_grid, _trimesh_subdivide),
    }
    return dict(made for maker in makers.get(mode, ()) if (made := maker(mesh, grid)))


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


def _trimesh_subdivide(mesh: Mesh, grid: Grid) -> tuple[str, Callable[[], object]] | None:
    """trimesh.voxel.creation.voxelize: the voxels of the subdivided mesh's vertices. It needs
    SciPy."""
    if _module("scipy") is None:
        return None
    return f"trimesh {_module('trimesh').__version__}", partial(_trimesh_voxels, mesh, grid)


def _trimesh_filled(mesh: Mesh, grid: Grid) -> tuple[str, Callable[[], object]] | None:
    """The voxels of _trimesh_subdivide with its holes filled."""
    if _module("scipy") is None:
        return None

    def run() -> object:
        return _trimesh_voxels(mesh, grid).fill()

    return f"trimesh {_module('trimesh').__version__}", run


def _trimesh_voxels(mesh: Mesh, grid: Grid) -> Any:
    surface = _module("trimesh").Trimesh(mesh.vertices, mesh.faces, process=False)
    return _module("trimesh.voxel.creation").voxelize(surface, grid.pitch[0])


def of_octree(octree: Octree, isovalue: float) -> dict[str, Callable[[], object]]:
    """The tools that extract a smooth surface, by name and version. Their time includes the dense
    grid of coverages that they need."""
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
    """A tool that computes signed distances to a mesh.

    Attributes
    ----------
    build : prepares the mesh and returns a function from (N, 3) float64 points to (N,) distances.
    builds_each_time : whether that function prepares the mesh again in every call.
    """

    name: str
    build: Callable[[], Callable[[np.ndarray], np.ndarray]]
    builds_each_time: bool = False


def of_distance(mesh: Mesh) -> list[DistancePeer]:
    """The tools that compute signed distances, each with its own choice of threads."""
    return [peer for maker in (_open3d_scene, _igl_signed_distance) if (peer := maker(mesh))]


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
    """signed_distance with fast winding numbers w. It builds its trees in every call, and returns
    (1 - 2 |w|) times the distance, which is exact if w is 0 or 1."""
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


@dataclass(frozen=True)
class PicturePeer:
    """A tool that draws a tetrahedral volume.

    Attributes
    ----------
    draw : draws the volume; the first call also prepares it.
    picture : returns (H, W, 4) float64 premultiplied RGBA as shown, after `draw`.
    at : returns (N, 4) float64 premultiplied RGBA of the rays of (N, 2) pixels, column and row.
    """

    name: str
    draw: Callable[[], None]
    picture: Callable[[], np.ndarray]
    at: Callable[[np.ndarray], np.ndarray]


def of_volume(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    transfer: TransferFunction,
    rays: Rays,
    *,
    constant: bool = False,
) -> list[PicturePeer]:
    """The tools that draw what voxtool.selftest.reference draws, with their own choice of threads.
    There is none in perspective, in which VTK's scalars are wrong."""
    if rays.perspective or _module("vtk") is None:
        return []
    return [_vtk_ray_cast(vertices, cells, scalars, transfer, rays, constant)]


def _vtk_ray_cast(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    transfer: TransferFunction,
    rays: Rays,
    constant: bool,
) -> PicturePeer:
    """vtkUnstructuredGridVolumeRayCastMapper with its linear integrator. (Partial pre-integration
    crashes.)

    Its picture has 8 bits, truncated, and is shown as a texture that is one pixel too large; its
    rays alone have float32.
    """
    vtk, support = _module("vtk"), _module("vtk.util.numpy_support")
    points, array, grid = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkUnstructuredGrid()
    points.SetData(support.numpy_to_vtk(np.asarray(vertices, np.float64), deep=True))
    array.SetData(
        support.numpy_to_vtk(4 * np.arange(len(cells) + 1, dtype=np.int64), deep=True),
        support.numpy_to_vtk(cells.astype(np.int64).ravel(), deep=True),
    )
    values = support.numpy_to_vtk(np.asarray(scalars, np.float64), deep=True)
    grid.SetPoints(points)
    grid.SetCells(vtk.VTK_TETRA, array)
    (grid.GetCellData() if constant else grid.GetPointData()).SetScalars(values)

    integrator = vtk.vtkUnstructuredGridLinearRayIntegrator()
    mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
    mapper.SetInputData(grid)
    mapper.SetRayIntegrator(integrator)
    mapper.AutoAdjustSampleDistancesOff()
    mapper.SetImageSampleDistance(1)
    colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    for scalar, rgb, extinction in zip(
        _apart(transfer.scalars), transfer.colours, transfer.extinctions, strict=True
    ):
        colour.AddRGBPoint(scalar, *rgb)
        opacity.AddPoint(scalar, extinction)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.GetProperty().SetColor(colour)
    volume.GetProperty().SetScalarOpacity(opacity)
    volume.GetProperty().SetScalarOpacityUnitDistance(1)
    volume.GetProperty().SetInterpolationTypeToLinear()

    width, height = rays.size
    renderer, camera = vtk.vtkRenderer(), vtk.vtkCamera()
    renderer.AddVolume(volume)
    renderer.SetBackgroundAlpha(0)
    eye = rays.origin + (rays.right - rays.down) / 2  # its rays pass lower left corners of pixels
    camera.ParallelProjectionOn()
    camera.SetPosition(*eye)
    camera.SetFocalPoint(*(eye + rays.direction))
    camera.SetViewUp(*-rays.down)
    camera.SetParallelScale(height / 2 * np.sqrt((rays.down**2).sum()))
    renderer.SetActiveCamera(camera)
    renderer.ResetCameraClippingRange()
    # with EGL, where there is such a window, it needs no display
    window = getattr(vtk, "vtkEGLRenderWindow", vtk.vtkRenderWindow)()
    window.SetOffScreenRendering(True)
    window.SetAlphaBitPlanes(True)
    window.SetMultiSamples(0)
    window.SetSize(width, height)
    window.AddRenderer(renderer)

    def picture() -> np.ndarray:
        shown = vtk.vtkUnsignedCharArray()
        window.GetRGBACharPixelData(0, 0, width - 1, height - 1, False, shown)
        return support.vtk_to_numpy(shown).reshape(height, width, 4)[::-1] / 255

    def at(pixels: np.ndarray) -> np.ndarray:
        ray = mapper.GetRayCastFunction().NewIterator()
        ray.SetBounds((0, 1))
        passed, lengths = vtk.vtkIdList(), vtk.vtkDoubleArray()
        near, far = vtk.vtkDoubleArray(), vtk.vtkDoubleArray()
        scalars_at = None if constant else values
        found = np.zeros((len(pixels), 4))
        for rgba, (column, row) in zip(found, pixels.tolist(), strict=True):
            sum_ = [0.0] * 4
            ray.Initialize(column, height - 1 - row)
            while ray.GetNextIntersections(passed, lengths, scalars_at, near, far):
                if constant:
                    near.SetNumberOfTuples(passed.GetNumberOfIds())
                    values.GetTuples(passed, near)
                integrator.Integrate(lengths, near, near if constant else far, sum_)
            rgba[:] = sum_
        return found

    return PicturePeer(f"VTK {vtk.vtkVersion().GetVTKVersion()}", window.Render, picture, at)


def _apart(scalars: np.ndarray) -> np.ndarray:
    """The scalars of control points, with the first of two equal ones moved: VTK takes no steps."""
    apart = scalars.astype(np.float64)
    apart[:-1][scalars[:-1] == scalars[1:]] -= 1e-9 * (scalars[-1] - scalars[0])
    return apart
