"""Models and exact pictures that results are compared with, and measures of errors."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.points import MEASURES
from voxtool.errors import count_of, human
from voxtool.grid import Grid
from voxtool.memory import available_memory
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import volume
from voxtool.spatial.deviation import deviation
from voxtool.svo.octree.octree import Octree
from voxtool.svo.voxelization.fill.caps import find_boundary, find_caps
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from voxtool.camera import Rays
    from voxtool.opencl import Device

TRIANGLE_BYTES = 280  # bytes of a surface whose distances are measured, at the peak
CAPPED_DIM = 4096  # of the lattice on which the boundary loops of a model are found
NO_AREA = {"area": "faces of voxels do not tend to the area"}
NO_SOLID = {"volume": "the voxels that a surface touches are no solid"}


# --- surfaces ------------------------------------------------------------------------------------


def capped(mesh: Mesh) -> tuple[Mesh, int]:
    """Return the mesh with its holes closed by fans, as `fill="winding"` closes them, and their
    number."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    own = Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=mesh.name)
    fixed = Grid.fit(mesh, CAPPED_DIM).to_fixed(own.vertices)
    caps = find_caps(fixed, find_boundary(own))
    return replace(own, faces=np.concatenate([own.faces, caps.faces])), caps.holes


class Reference:
    """A mesh that surfaces are compared with.

    Attributes
    ----------
    words : names it; diagonal : of its bounding box, world units.
    samples : points on each surface whose distances are measured; 0 leaves distances out.
    absent : reasons by the measures that make no sense.
    """

    def __init__(
        self,
        mesh: Mesh,
        holes: int,
        samples: int,
        device: Device,
        absent: dict[str, str] | None = None,
    ) -> None:
        self.mesh, self.samples, self.device, self.absent = mesh, samples, device, absent or {}
        self.words = f"the model, {count_of(holes, 'hole')} capped" if holes else "the model"
        self.diagonal = float(length(np.diff(mesh.bounds, axis=0))[0])
        self.volume, self.area = abs(volume(mesh)), area(mesh)

    def errors_of(self, surface: Mesh) -> Any:
        """Return the `errors` and `absent` of a Point."""
        if not len(surface.faces):
            return {"errors": {}, "absent": dict.fromkeys(MEASURES["extract"], "it is empty")}
        errors: dict[str, float] = {}
        why, needed = "", TRIANGLE_BYTES * len(surface.faces)
        if not self.samples:
            why = "distances are left out with --samples 0"
        elif needed > available_memory():
            why = f"the tree of {len(surface.faces):,} triangles would take {human(needed)}"
        absent = self.absent | ({"rms": why, "hausdorff": why} if why else {})
        if not why:
            found = deviation(surface, self.mesh, self.samples, device=self.device)
            ways = found["surface_to_reference"], found["reference_to_surface"]
            errors["rms"] = max(way["rms"] for way in ways) / self.diagonal
            errors["hausdorff"] = found["hausdorff"] / self.diagonal
        enclosed = abs(volume(surface))
        errors["volume"] = abs(enclosed / self.volume - 1) if self.volume else math.inf
        errors["area"] = abs(area(surface) / self.area - 1)
        return {
            "errors": {name: value for name, value in errors.items() if name not in absent},
            "absent": absent,
        }

    def in_voxels(self, found: dict[str, dict], edge: float) -> dict[str, float]:
        """Return the distances of `errors_of` in voxels, or leaves, with an edge in world units."""
        names = {"rms": "rms in voxels", "hausdorff": "max in voxels"}
        return {
            name: self.diagonal / edge * found["errors"][measure]
            for measure, name in names.items()
            if measure in found["errors"]
        }


def area(mesh: Mesh) -> float:
    """Return the area of a mesh, in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return math.fsum(length(cross(b - a, c - a)).tolist()) / 2


def voxels_of_peer(made: Any, grid: Grid) -> Octree:
    """Return the voxels of another tool: a vtkImageData, a vtkImageStencilData, or a VoxelGrid of
    Open3D or trimesh."""
    if hasattr(made, "matrix"):
        pitch = np.asarray(made.pitch, np.float64)
        low = made.translation - pitch / 2
        return Octree.from_dense(made.matrix, low.tolist(), pitch.tolist())
    if hasattr(made, "get_voxels"):
        cells = np.array([voxel.grid_index for voxel in made.get_voxels()]).reshape(-1, 3)
        x, y, z = (cells.max(axis=0, initial=0) + 1).tolist()
        own = Grid((x, y, z), tuple(made.origin), (made.voxel_size,) * 3)
        return Octree.from_voxels(cells, own)
    if made.IsA("vtkImageStencilData"):
        image = importlib.import_module("vtk").vtkImageStencilToImage()
        image.SetInputData(made)
        image.SetInsideValue(1)
        image.SetOutsideValue(0)
        image.SetOutputScalarTypeToUnsignedChar()
        image.Update()
        made = image.GetOutput()
    values = _from_vtk(made.GetPointData().GetScalars()).reshape(grid.shape[::-1])
    return Octree.from_dense(values.T, grid.origin, grid.pitch)


def surface_of_peer(made: Any, origin: np.ndarray, step: np.ndarray | float) -> Mesh:
    """Return the surface of another tool, a vtkPolyData or the arrays of scikit-image, on a lattice
    that begins at an origin."""
    if isinstance(made, tuple):
        points, faces = made[0][:, ::-1], made[1]
    else:
        points = _from_vtk(made.GetPoints().GetData())
        faces = _from_vtk(made.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    places = points.astype(np.float64) * step + origin
    return Mesh(places, faces.astype(np.int32), name="surface")


def _from_vtk(array: Any) -> np.ndarray:
    return importlib.import_module("vtk.util.numpy_support").vtk_to_numpy(array)


# --- distances -----------------------------------------------------------------------------------


def distance_errors(found: np.ndarray, exact: np.ndarray, side: float) -> dict[str, float]:
    """Return the errors of distances, as shares of the cube's side; "p99" is a percentile."""
    errors = np.abs(found - exact) / side
    p99 = float(np.quantile(errors, 0.99, method="inverted_cdf"))
    return {"rms": _rms(errors), "p99": p99, "max": float(errors.max())}


def distances_compared(
    found: np.ndarray, exact: np.ndarray, side: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the errors of distances, and two figures of their signs: the largest error without the
    sign, as a share of the cube's side, and the number of points whose sign differs."""
    unsigned = np.abs(np.abs(found) - np.abs(exact)) / side
    signs = {
        "max unsigned": float(unsigned.max()),
        "other sign": int(np.count_nonzero((found < 0) != (exact < 0))),
    }
    return distance_errors(found, exact, side), signs


def _rms(errors: np.ndarray) -> float:
    """Return the root of the mean square; math.fsum rounds once, in whatever order it adds."""
    return math.sqrt(math.fsum(errors * errors) / max(len(errors), 1))


# --- pictures ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReferencePicture:
    """The exact colours of some pixels of a picture.

    Attributes
    ----------
    rays : those of the picture.
    pixels : (N, 2) int, column and row; expected : (N, 4) float64, their premultiplied RGBA.
    """

    rays: Rays
    pixels: np.ndarray
    expected: np.ndarray

    def compared(self, found: np.ndarray) -> dict[str, Any]:
        """Return the `errors` and `figures` of a Point for (N, 4) colours: the errors are those of
        the pixels that are not empty in both."""
        alpha = self.expected[:, 3]
        seen = (alpha > 0) | (found[:, 3] > 0)
        off = np.abs(found[seen].astype(np.float64) - self.expected[seen]).ravel()
        return {
            "errors": {"rms": _rms(off), "max": float(off.max(initial=0))},
            "figures": {
                "pixels compared": int(np.count_nonzero(alpha)),
                "largest alpha": float(alpha.max()),
            },
        }

    def of(self, picture: np.ndarray) -> np.ndarray:
        """Return the colours of the pixels in a picture."""
        return picture[self.pixels[:, 1], self.pixels[:, 0]]
