"""References that results are compared with (models, exact pictures), and measures of errors.

Voxels are compared by the boundary of their set, so voxtool's results and those of other tools are
measured in the same way.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.bench.points import MEASURES
from voxtool.errors import count_of
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import volume
from voxtool.spatial.deviation import deviation
from voxtool.svo.fill.caps import find_caps
from voxtool.svo.layout import BRICK_SIDE
from voxtool.vector import cross, length

if TYPE_CHECKING:
    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.svo.octree import Octree

CAPPED_DIM = 4096  # of the lattice on which the boundary loops of a model are found
NO_AREA = {"area": "faces of voxels do not tend to the area"}
NO_SOLID = {"volume": "the voxels that a surface touches are no solid"}


# --- surfaces ------------------------------------------------------------------------------------


def capped(mesh: Mesh) -> tuple[Mesh, int]:
    """The mesh with its holes closed by fans, as `fill="winding"` closes them, and their number."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices, faces = mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32)
    caps = find_caps(Grid.fit(mesh, CAPPED_DIM).to_fixed(vertices), faces)
    return Mesh(vertices, np.concatenate([faces, caps.faces]), name=mesh.name), caps.holes


class Reference:
    """A mesh that surfaces are compared with.

    Attributes
    ----------
    words : what it is; diagonal : of its bounding box, world units.
    absent : the measures that make no sense, and why.
    """

    def __init__(
        self,
        mesh: Mesh,
        holes: int,
        samples: int,
        device: Device,
        absent: dict[str, str] | None = None,
    ) -> None:
        self.mesh, self.samples, self.device = mesh, samples, device
        self.words = f"the model, {count_of(holes, 'hole')} capped" if holes else "the model"
        self.absent = absent or {}
        low, high = mesh.bounds
        self.diagonal = math.sqrt(float(((high - low) ** 2).sum()))
        self.volume, self.area = abs(volume(mesh)), area(mesh)

    def errors_of(self, surface: Mesh) -> Any:
        """The `errors` and `absent` of a Point."""
        if not len(surface.faces):
            return {"errors": {}, "absent": dict.fromkeys(MEASURES["extract"], "it is empty")}
        found = deviation(surface, self.mesh, self.samples, device=self.device)
        ways = found["surface_to_reference"], found["reference_to_surface"]
        errors = {
            "rms": max(way["rms"] for way in ways) / self.diagonal,
            "hausdorff": found["hausdorff"] / self.diagonal,
            "volume": abs(abs(volume(surface)) / self.volume - 1) if self.volume else math.inf,
            "area": abs(area(surface) / self.area - 1),
        }
        return {
            "errors": {name: value for name, value in errors.items() if name not in self.absent},
            "absent": self.absent,
        }


def area(mesh: Mesh) -> float:
    """The area of a mesh, in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return math.fsum(length(cross(b - a, c - a)).tolist()) / 2


def boundary(voxels: np.ndarray, origin: np.ndarray, pitch: np.ndarray) -> Mesh:
    """The faces between occupied and empty voxels, two triangles each, counter-clockwise from
    outside.

    Parameters
    ----------
    voxels : (nx, ny, nz) bool.
    origin, pitch : (3,) float64: the low corner of the first voxel, and the side lengths.
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


def voxels_of_peer(made: Any, grid: Grid) -> Mesh:
    """The boundary of the voxels of another tool: a vtkImageData, or a VoxelGrid of Open3D or
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


def surface_of_peer(made: Any, octree: Octree) -> Mesh:
    """The surface of another tool, a vtkPolyData or what scikit-image returns, on the lattice of
    the centres of the octree's bricks."""
    if isinstance(made, tuple):
        points, faces = made[0][:, ::-1], made[1]
    else:
        support = importlib.import_module("vtk.util.numpy_support")
        points = support.vtk_to_numpy(made.GetPoints().GetData())
        faces = support.vtk_to_numpy(made.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    side = BRICK_SIDE * np.array(octree.grid.pitch)
    places = (points.astype(np.float64) + 0.5) * side + np.array(octree.grid.origin)
    return Mesh(places, faces.astype(np.int32), name="surface")


# --- distances -----------------------------------------------------------------------------------


def distance_errors(found: np.ndarray, exact: np.ndarray, side: float) -> dict[str, float]:
    """The errors of distances, in sides of the cube: "rms", "p99", the 99th percentile, and
    "max"."""
    errors = np.abs(found - exact) / side
    return {
        # math.fsum rounds once, in whatever order it adds
        "rms": math.sqrt(math.fsum(errors * errors) / len(errors)),
        "p99": float(np.quantile(errors, 0.99, method="inverted_cdf")),
        "max": float(errors.max()),
    }


def sign_figures(found: np.ndarray, exact: np.ndarray, side: float) -> dict[str, float]:
    """The largest error of distances without their sign, in sides, and the number of points whose
    sign differs."""
    unsigned = np.abs(np.abs(found) - np.abs(exact)) / side
    return {
        "max unsigned": float(unsigned.max()),
        "other sign": int(np.count_nonzero((found < 0) != (exact < 0))),
    }


# --- pictures ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReferencePicture:
    """The exact colours of some pixels of a picture.

    Attributes
    ----------
    rays : of the picture.
    pixels : (N, 2) int, column and row; expected : (N, 4) float64, their premultiplied RGBA.
    """

    rays: Rays
    pixels: np.ndarray
    expected: np.ndarray

    def errors(self, found: np.ndarray) -> dict[str, float]:
        """RMS and maximum of the errors of (N, 4) colours, over the pixels that are not empty in
        both."""
        seen = (self.expected[:, 3] > 0) | (found[:, 3] > 0)
        off = np.abs(found[seen].astype(np.float64) - self.expected[seen]).ravel()
        # math.fsum rounds once, in whatever order it adds
        rms = math.sqrt(math.fsum(off * off) / max(len(off), 1))
        return {"rms": rms, "max": float(off.max(initial=0))}

    def of(self, picture: np.ndarray) -> np.ndarray:
        """The colours of the pixels in a picture."""
        return picture[self.pixels[:, 1], self.pixels[:, 0]]
