"""Other tools on the same work, if they are installed: mesh to voxels, octree to surface, distances
from points to a mesh, closed meshes, and pictures of volumes, all in memory."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from voxtool.camera import Rays
    from voxtool.grid import Grid
    from voxtool.mesh.mesh import Mesh
    from voxtool.tets.pictures.transfer import TransferFunction

    Distance = Callable[[np.ndarray], np.ndarray]
    Arrays = tuple[np.ndarray, np.ndarray]  # vertices and faces

TOOLS = {  # imported name, name on the package index, and the benches that use it
    "VTK": ("vtk", "vtk", {"voxelize", "extract", "surfaces", "tets"}),
    "Open3D": ("open3d", "open3d", {"voxelize", "adf", "pictures"}),
    "PyMeshLab": ("pymeshlab", "pymeshlab", {"repair"}),
    "libigl": ("igl", "libigl", {"adf"}),
    "scikit-image": ("skimage", "scikit-image", {"extract", "surfaces"}),
    "trimesh": ("scipy", "scipy", {"voxelize"}),  # trimesh is always there, and needs SciPy here
}


def missing(benches: set[str]) -> list[str]:
    """Return the packages that these benches could use and that are not installed."""
    return [
        package
        for name, package, used in TOOLS.values()
        if used & benches and _module(name) is None
    ]


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except (ImportError, OSError):  # not installed, or a library that it needs is not
        return None


def _made(makers: dict[str, Callable[..., Any]], *args: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name and version of each tool that is installed, and what its maker returns."""
    for tool, maker in makers.items():
        if _module(TOOLS[tool][0]) is not None:
            yield f"{tool} {importlib.metadata.version(tool)}", maker(*args)


def _vtk() -> tuple[Any, Any]:
    return _module("vtk"), _module("vtk.util.numpy_support")


def _vtk_mesh(vertices: np.ndarray, cells: np.ndarray) -> tuple[Any, Any]:
    """Return the vtkPoints of (V, 3) vertices and the vtkCellArray of (N, k) cells."""
    vtk, support = _vtk()
    points, array = vtk.vtkPoints(), vtk.vtkCellArray()
    points.SetData(support.numpy_to_vtk(np.asarray(vertices, np.float64), deep=True))
    starts = np.arange(0, cells.size + 1, cells.shape[1], dtype=np.int64)
    array.SetData(
        support.numpy_to_vtk(starts, deep=True),
        support.numpy_to_vtk(cells.astype(np.int64).ravel(), deep=True),
    )
    return points, array


# --- voxels and surfaces -------------------------------------------------------------------------


def of(mesh: Mesh, grid: Grid, mode: str) -> dict[str, Callable[[], object]]:
    """Return the tools that voxelize in this mode, by name and version; their inputs are made
    before."""
    makers = {
        "solid": {"VTK": _vtk_stencil, "trimesh": _trimesh_filled},
        "surface26": {"Open3D": _open3d_voxel_grid, "trimesh": _trimesh_subdivide},
    }
    return dict(_made(makers.get(mode, {}), mesh, grid))


def _vtk_stencil(mesh: Mesh, grid: Grid) -> Callable[[], object]:
    """vtkPolyDataToImageStencil: the runs of voxels in rows, without an image made from them."""
    vtk, _ = _vtk()
    surface = vtk.vtkPolyData()
    points, faces = _vtk_mesh(mesh.vertices, mesh.faces)
    surface.SetPoints(points)
    surface.SetPolys(faces)

    def run() -> object:
        stencil = vtk.vtkPolyDataToImageStencil()
        stencil.SetInputData(surface)
        stencil.SetOutputOrigin(*(np.array(grid.origin) + 0.5 * np.array(grid.pitch)))
        stencil.SetOutputSpacing(*grid.pitch)
        stencil.SetOutputWholeExtent(*(v for n in grid.shape for v in (0, n - 1)))
        stencil.Update()
        return stencil.GetOutput()

    return run


def _open3d_voxel_grid(mesh: Mesh, grid: Grid) -> Callable[[], object]:
    """VoxelGrid.create_from_triangle_mesh."""
    open3d = _module("open3d")
    geometry = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices.copy()),  # it takes no read-only arrays
        open3d.utility.Vector3iVector(mesh.faces.copy()),
    )
    return lambda: open3d.geometry.VoxelGrid.create_from_triangle_mesh(geometry, grid.pitch[0])


def _trimesh_subdivide(mesh: Mesh, grid: Grid) -> Callable[[], Any]:
    """trimesh.voxel.creation.voxelize: the voxels of the subdivided mesh's vertices."""

    def run() -> Any:
        surface = _module("trimesh").Trimesh(mesh.vertices, mesh.faces, process=False)
        return _module("trimesh.voxel.creation").voxelize(surface, grid.pitch[0])

    return run


def _trimesh_filled(mesh: Mesh, grid: Grid) -> Callable[[], object]:
    """Return the voxels of _trimesh_subdivide with its holes filled."""
    voxels = _trimesh_subdivide(mesh, grid)
    return lambda: voxels().fill()


def of_grid(dense: Callable[[], np.ndarray], value: float) -> dict[str, Callable[[], object]]:
    """Return the tools that extract a smooth surface where a dense grid has a value, by name and
    version. Their time includes `dense`, which makes the grid, (nz, ny, nx)."""
    makers = {"VTK": _vtk_flying_edges, "scikit-image": _skimage_marching_cubes}
    found = dict(_made(makers, dense, value))
    flying = f", Flying Edges on {_threads()} threads"
    return {name + flying * ("VTK" in name): extract for name, extract in found.items()}


def _threads() -> int:
    return os.cpu_count() or 1


def _vtk_flying_edges(dense: Callable[[], np.ndarray], value: float) -> Callable[[], object]:
    """vtkFlyingEdges3D on all cores, without normals."""
    vtk, support = _vtk()

    def run() -> object:
        vtk.vtkSMPTools.SetBackend("STDThread")
        vtk.vtkSMPTools.Initialize(_threads())
        grid = dense()
        image = vtk.vtkImageData()
        image.SetDimensions(*grid.shape[::-1])
        image.GetPointData().SetScalars(support.numpy_to_vtk(grid.ravel()))
        edges = vtk.vtkFlyingEdges3D()
        edges.SetInputData(image)
        edges.SetValue(0, value)
        edges.ComputeNormalsOff()
        edges.ComputeGradientsOff()
        edges.Update()
        return edges.GetOutput()

    return run


def _skimage_marching_cubes(dense: Callable[[], np.ndarray], value: float) -> Callable[[], object]:
    """skimage.measure.marching_cubes, of Lewiner."""
    measure = _module("skimage.measure")

    def run() -> object:
        grid = dense()
        if not grid.min() <= value <= grid.max():  # no surface, which is an error there
            return np.empty((0, 3)), np.empty((0, 3), np.int32)
        return measure.marching_cubes(grid, value)

    return run


# --- closed meshes -------------------------------------------------------------------------------


def of_repair(mesh: Mesh, grid: Grid) -> dict[str, Callable[[], Arrays]]:
    """Return the tools that make a closed mesh of any triangles, at the voxels of a grid."""
    made = _made({"PyMeshLab": _meshlab_wrap}, mesh, grid.pitch[0])
    return {f"{name}, alpha wrap": work for name, work in made}


def _meshlab_wrap(mesh: Mesh, pitch: float) -> Callable[[], Arrays]:
    """CGAL's alpha wrap, shrunk into openings wider than two voxels, half a voxel outside."""
    lab = _module("pymeshlab")

    def run() -> Arrays:
        work = lab.MeshSet()
        work.add_mesh(lab.Mesh(mesh.vertices, mesh.faces))
        size, away = lab.PureValue(2 * pitch), lab.PureValue(pitch / 2)
        work.generate_alpha_wrap(alpha=size, offset=away)
        found = work.current_mesh()
        return found.vertex_matrix(), found.face_matrix()

    return run


# --- distances -----------------------------------------------------------------------------------


def of_distance(mesh: Mesh) -> dict[str, Callable[[], Distance]]:
    """Return the tools that compute signed distances, by name and version, each with its own choice
    of threads. A call prepares the mesh and returns a function from (N, 3) float64 points to (N,)
    distances."""
    found = dict(_made({"Open3D": _open3d_scene, "libigl": _igl_signed_distance}, mesh))
    return {name + ", building its trees" * ("libigl" in name): build
            for name, build in found.items()}  # fmt: skip


def _open3d_scene(mesh: Mesh) -> Callable[[], Distance]:
    """RaycastingScene.compute_signed_distance, which is in float32; its sign is by parity."""
    open3d = _module("open3d")
    as_tensor = open3d.core.Tensor
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)

    def build() -> Distance:
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(as_tensor(vertices), as_tensor(faces))

        def distance(points: np.ndarray) -> np.ndarray:
            return scene.compute_signed_distance(as_tensor(points.astype(np.float32))).numpy()

        distance(mesh.vertices[:1])  # the first query builds the tree
        return distance

    return build


def _igl_signed_distance(mesh: Mesh) -> Callable[[], Distance]:
    """signed_distance with fast winding numbers w. It builds its trees in every call, and returns
    (1 - 2 |w|) times the distance, which is exact if w is 0 or 1."""
    igl = _module("igl")
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER

    def distance(points: np.ndarray) -> np.ndarray:
        return igl.signed_distance(points, vertices, faces, sign)[0]

    def build() -> Distance:
        distance(vertices[:1])
        return distance

    return build


# --- pictures ------------------------------------------------------------------------------------


def of_rays(mesh: Mesh, rays: Rays) -> dict[str, Callable[[], np.ndarray]]:
    """Return the tools that cast rays at a mesh, by name and version; their trees are made before.
    Each returns (H, W) bool: the rays that meet it."""
    return dict(_made({"Open3D": _open3d_rays}, mesh, rays))


def _open3d_rays(mesh: Mesh, rays: Rays) -> Callable[[], np.ndarray]:
    """RaycastingScene.cast_rays, which is Embree, in float32."""
    open3d = _module("open3d")
    as_tensor, (width, height) = open3d.core.Tensor, rays.size
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        as_tensor(mesh.vertices.astype(np.float32)), as_tensor(mesh.faces.astype(np.uint32))
    )
    y, x = np.indices((height, width))[..., None] + 0.5
    aside = (x - width / 2) * rays.right + (y - height / 2) * rays.down
    origins, directions = np.broadcast_arrays(rays.origin, rays.direction, aside)[:2]
    origins = origins + (0 if rays.perspective else aside)
    directions = directions + (aside if rays.perspective else 0)
    both = as_tensor(np.concatenate([origins, directions], axis=2).astype(np.float32))
    return lambda: np.isfinite(scene.cast_rays(both)["t_hit"].numpy())


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
    """Return the tools that draw what voxtool.selftest.reference draws, with their own choice of
    threads. There is none in perspective, in which VTK's scalars are wrong."""
    volume = (vertices, cells, scalars, transfer, rays, constant)
    makers = {} if rays.perspective else {"VTK": _vtk_ray_cast}
    return [PicturePeer(name, *made) for name, made in _made(makers, *volume)]


def _vtk_ray_cast(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    transfer: TransferFunction,
    rays: Rays,
    constant: bool,
) -> tuple[Callable[[], None], Callable[[], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """vtkUnstructuredGridVolumeRayCastMapper with its linear integrator. (Partial pre-integration
    crashes.)

    Its picture has 8 bits, truncated, and is shown as a texture that is one pixel too large; its
    rays alone have float32.
    """
    vtk, support = _vtk()
    grid, values = vtk.vtkUnstructuredGrid(), support.numpy_to_vtk(scalars.astype(float), deep=True)
    points, array = _vtk_mesh(vertices, cells)
    grid.SetPoints(points)
    grid.SetCells(vtk.VTK_TETRA, array)
    (grid.GetCellData() if constant else grid.GetPointData()).SetScalars(values)
    integrator = vtk.vtkUnstructuredGridLinearRayIntegrator()
    mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
    mapper.SetInputData(grid)
    mapper.SetRayIntegrator(integrator)
    mapper.AutoAdjustSampleDistancesOff()
    mapper.SetImageSampleDistance(1)
    window = _vtk_window(_vtk_volume(mapper, transfer), rays)
    width, height = rays.size

    def picture() -> np.ndarray:
        shown = vtk.vtkUnsignedCharArray()
        window.GetRGBACharPixelData(0, 0, width - 1, height - 1, False, shown)
        return support.vtk_to_numpy(shown).reshape(height, width, 4)[::-1] / 255

    def at(pixels: np.ndarray) -> np.ndarray:
        ray = mapper.GetRayCastFunction().NewIterator()
        ray.SetBounds((0, 1))
        passed, lengths = vtk.vtkIdList(), vtk.vtkDoubleArray()
        near, far = vtk.vtkDoubleArray(), vtk.vtkDoubleArray()
        found = np.zeros((len(pixels), 4))
        for rgba, (column, row) in zip(found, pixels.tolist(), strict=True):
            total = [0.0] * 4
            ray.Initialize(column, height - 1 - row)
            while ray.GetNextIntersections(
                passed, lengths, None if constant else values, near, far
            ):
                if constant:
                    near.SetNumberOfTuples(passed.GetNumberOfIds())
                    values.GetTuples(passed, near)
                integrator.Integrate(lengths, near, near if constant else far, total)
            rgba[:] = total
        return found

    return window.Render, picture, at


def _vtk_volume(mapper: Any, transfer: TransferFunction) -> Any:
    """Return a vtkVolume with a transfer function. VTK takes no steps, so the first of two equal
    control points is moved."""
    vtk, _ = _vtk()
    scalars = transfer.scalars.astype(np.float64)
    scalars[:-1][np.diff(transfer.scalars) == 0] -= 1e-9 * np.ptp(transfer.scalars)
    colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    for scalar, rgb, extinction in zip(
        scalars, transfer.colours, transfer.extinctions, strict=True
    ):
        colour.AddRGBPoint(scalar, *rgb)
        opacity.AddPoint(scalar, extinction)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.GetProperty().SetColor(colour)
    volume.GetProperty().SetScalarOpacity(opacity)
    volume.GetProperty().SetScalarOpacityUnitDistance(1)
    volume.GetProperty().SetInterpolationTypeToLinear()
    return volume


def _vtk_window(volume: Any, rays: Rays) -> Any:
    """Return an off-screen window that shows a vtkVolume along orthographic rays."""
    vtk, _ = _vtk()
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
    # a window of EGL, if VTK has it, needs no display
    window = getattr(vtk, "vtkEGLRenderWindow", vtk.vtkRenderWindow)()
    window.SetOffScreenRendering(True)
    window.SetAlphaBitPlanes(True)
    window.SetMultiSamples(0)
    window.SetSize(width, height)
    window.AddRenderer(renderer)
    return window
