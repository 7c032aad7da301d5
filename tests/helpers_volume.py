"""Meshes of tetrahedra for tests, and what a picture of one should be."""

from __future__ import annotations

import itertools

import numpy as np

from voxtool.camera import Camera, Rays
from voxtool.opencl import Device
from voxtool.selftest.reference import reference
from voxtool.tets.mesh import UnstructuredMesh
from voxtool.tets.project import Projection
from voxtool.tets.scene import VolumeScene
from voxtool.tets.transfer import TransferFunction
from voxtool.tets.volume import TetVolume

# A cube's corners are 4 x + 2 y + z. Kuhn's six tetrahedra: the ways from corner 0 to corner 7.
SIX = np.array([np.cumsum([0, *way]) for way in itertools.permutations((1, 2, 4))])
FIVE = np.array([(0, 1, 2, 4), (3, 1, 2, 7), (5, 1, 4, 7), (6, 2, 4, 7), (1, 2, 4, 7)])


def grid_points(shape: tuple[int, int, int]) -> np.ndarray:
    """(n, 3) float64: the corners of unit cubes."""
    return np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in shape), indexing="ij"), -1).reshape(
        -1, 3
    )


def grid_corners(shape: tuple[int, int, int]) -> np.ndarray:
    """(cubes, 8) int: the corners 4 x + 2 y + z of each cube."""
    numbers = np.arange(np.prod(np.add(shape, 1))).reshape(np.add(shape, 1))
    x, y, z = shape
    return np.stack(
        [
            numbers[i : i + x, j : j + y, k : k + z].ravel()
            for i, j, k in itertools.product((0, 1), repeat=3)
        ],
        axis=1,
    )


def tet_grid(
    shape: tuple[int, int, int], seed: int | None = None, holes: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Cubes cut in six; with a seed, the points moved at random and a share of the cells gone.

    Returns points (P, 3) float64 in [-1, 1] or so, and cells (T, 4) int.
    """
    points = grid_points(shape)
    cells = grid_corners(shape)[:, SIX].reshape(-1, 4)
    if seed is not None:
        random = np.random.default_rng(seed)
        points += random.uniform(-0.2, 0.2, points.shape)
        cells = cells[random.random(len(cells)) >= holes]
    return points / (np.array(shape) / 2) - 1, cells


def mesh_of(points: np.ndarray, cells: np.ndarray, scalars, name: str = "s") -> UnstructuredMesh:
    return UnstructuredMesh(points, [("tetra", np.asarray(cells))], scalars, name)


class Pictures:
    """Pictures of a volume by a device, which keeps the volume."""

    def __init__(self, volume: TetVolume, device: Device) -> None:
        self.volume, self.device = volume, device

    def scene(self, transfer: TransferFunction, *how, **decisions) -> VolumeScene:
        """What a transfer function shows, by a method and an integrator."""
        return VolumeScene(self.volume, transfer, *how, **decisions)

    def render(self, rays: Rays, transfer: TransferFunction, *how, **decisions) -> np.ndarray:
        return self.scene(transfer, *how, **decisions).draw(rays, self.device)

    def project(
        self, rays: Rays, transfer: TransferFunction, integrator="linear", **decisions
    ) -> Projection:
        scene = self.scene(transfer, "projection", integrator, **decisions)
        return scene.project(rays, self.device)


def ramp(
    low: float, high: float, extinction: float, steps: int = 4, seed: int = 5
) -> TransferFunction:
    """Random colours, and random extinctions up to a largest, over a range of scalars."""
    random = np.random.default_rng(seed)
    return TransferFunction(
        np.linspace(low, high, steps),
        random.random((steps, 3)),
        extinction * random.random(steps),
    )


def reference_picture(mesh: UnstructuredMesh, transfer: TransferFunction, rays: Rays) -> np.ndarray:
    """(H, W, 4) float64."""
    cells = mesh.cells[0][1]
    scalars = mesh.scalars[0] if isinstance(mesh.scalars, list) else mesh.scalars
    width, height = rays.size
    picture = reference(mesh.points, cells, scalars, transfer, rays, constant=mesh.constant)
    return picture.reshape(height, width, 4)


def rays_of(mesh: UnstructuredMesh, view: str, fov: float | None, size=(40, 32)) -> Rays:
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    return Camera.fit(low, high, view, fov=fov).rays(*size)
