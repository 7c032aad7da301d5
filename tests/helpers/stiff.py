"""Random stiff scenes of voxels, each held against integers and rational numbers."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from random import Random

import numpy as np
from helpers import meshes, oracles

import voxtool
from voxtool.opencl import Device
from voxtool.svo.octree.stored_volume import stored_volume

SHAPE = (13, 11, 12)
KINDS = ("sliver", "needle", "plate", "wedge", "flat", "repeated", "near", "sparse")
CLOSED = KINDS[:4]  # of one part, whose faces all have an area
ROUNDED = Fraction(1, 2) + Fraction(1, 1 << 12)  # of a step of the lattice: by float64, too


@dataclass(frozen=True)
class Scene:
    """A closed mesh in voxels; whether it has one part; where it lies and how large a voxel is; and
    in a deep grid, the low corners of the boxes of SHAPE that hold its parts."""

    kind: str
    vertices: np.ndarray
    faces: np.ndarray
    origin: np.ndarray
    pitch: float
    dim: int | None = None
    corners: tuple[tuple[int, ...], ...] = ((0, 0, 0),)

    @property
    def grid(self) -> voxtool.Grid:
        shape = SHAPE if self.dim is None else (self.dim,) * 3
        return voxtool.Grid(shape, tuple(self.origin.tolist()), (self.pitch,) * 3)

    @property
    def mesh(self) -> voxtool.Mesh:
        return meshes.mesh_of(self.origin + self.pitch * self.vertices, self.faces)


def stiff_scene(rng: Random, kind: str) -> Scene:
    """Return a scene of a kind: its small length is 1e-1 to 1e-6 voxel. Half of them are turned, a
    third lie far from 0, and a third are tiny or huge."""
    random = np.random.default_rng(rng.randrange(1 << 32))
    small = 10 ** -rng.uniform(1, 6)
    middle = np.array(SHAPE) / 2
    dim, corners = None, ((0, 0, 0),)
    if kind == "sliver":
        a, b, c = random.uniform(2, 9, (3, 3))
        share = random.random()
        vertices, faces = meshes.tetrahedron(
            a, b, a * share + b * (1 - share) + small * random.normal(size=3), c
        )
    elif kind in ("needle", "plate"):
        sides = np.array([small, small if kind == "needle" else 5, 5.0])[random.permutation(3)]
        vertices, faces = meshes.box(middle - sides, middle + sides)
    elif kind == "wedge":
        x, y, z = middle
        vertices, faces = meshes.tetrahedron(
            (x - 5, y - 4, z), (x + 5, y, z), (x + 5, y + small, z), (x - 2, y + 3, z + 5)
        )
    elif (
        kind == "flat"
    ):  # with faces without area: segments, points, needles that fold onto themselves
        vertices, faces = meshes.octahedron(middle, 4.5)
        edge = rng.randrange(len(faces))
        a, b, _ = faces[edge]
        faces = np.concatenate([faces, [(a, b, a), (a, a, a), (b, a, b)]])
    elif kind == "repeated":
        vertices, faces = meshes.octahedron(middle, 4.2)
        faces = np.concatenate([faces, faces, faces])
    elif kind == "near":  # faces side by side, and a part that nearly touches another
        low = middle - 4
        beside = np.array([(4 + small, 1, 0), (7, 5, 3)]) + low
        vertices, faces = meshes.join(meshes.box(low, low + 4), meshes.box(*beside))
    else:
        dim = rng.choice([8192, 40_000, 65_536])
        most = dim - max(SHAPE)
        corners = tuple(
            tuple(64 * rng.randrange(most // 64) for _ in range(3))
            for _ in range(rng.randint(1, 4))
        )
        corners = ((0, 0, 0), *corners) if rng.random() < 0.5 else corners
        corners = tuple(dict.fromkeys(corners))
        vertices, faces = meshes.octahedron(middle, rng.uniform(0.3, 4.7))
    vertices = np.asarray(vertices, np.float64)
    if rng.random() < 0.5 and dim is None:
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        vertices = (vertices - middle) @ turn.T * 0.7 + middle
    vertices, faces = meshes.join(*((vertices + corner, faces) for corner in corners))
    pitch = 10 ** rng.choice([0, 0, rng.uniform(-60, 60)])
    far = rng.choice([0, 0, 10 ** rng.uniform(0, 7)])
    origin = random.uniform(-1, 1, 3) * pitch * far
    return Scene(kind, vertices, faces, origin, pitch, dim, corners)


def voxels_wrong(scene: Scene, device: Device) -> int:
    """Return the number of voxels of all modes that are not those of the mesh on the lattice, in
    integers; assert that each vertex lies on the nearest point of it, in rational numbers."""
    grid, mesh = scene.grid, scene.mesh
    fixed = grid.to_fixed(mesh.vertices)
    for vertex, steps in zip(mesh.vertices.tolist(), fixed.tolist(), strict=True):
        for value, origin, step in zip(vertex, scene.origin.tolist(), steps, strict=True):
            exact = (Fraction(value) - Fraction(origin)) * 256 / Fraction(scene.pitch)
            assert abs(exact - step) <= ROUNDED
    triangles = fixed[mesh.faces].astype(np.int64)
    wrong = 0
    for mode in ("surface26", "surface6", "solid"):
        octree = voxtool.voxelize(mesh, grid, mode, fill="parity", device=device)
        octree.validate()
        found = {tuple(v) for v in octree.occupied().tolist()}
        expected = set()
        for corner in scene.corners:
            own = triangles - 256 * np.array(corner)
            # boxes lie apart; rows along x pass no other part in them
            near = ((own.min(axis=1) < 256 * 13) & (own.max(axis=1) >= 0)).all(axis=1)
            cells = getattr(oracles, mode)(own[near], SHAPE)
            expected |= {tuple(np.add(cell, corner).tolist()) for cell in cells}
        wrong += len(found ^ expected)
        if mode == "solid" and octree.count:
            surface = voxtool.extract(octree, style="voxel-faces", device=device)
            checked = surface.check()
            assert checked["closed"], scene
            assert Fraction(surface.volume) == Fraction(octree.count * grid.voxel_volume), scene
    return wrong


def volume_off(scene: Scene, device: Device) -> float:
    """Return by how many voxels the sum of the fractions differs from the volume of the mesh as it
    was given, in rational numbers, relative to its bound: that of vertices that move by half a step
    of 2^-20 voxel along each axis, and of shares that are rounded."""
    mesh, grid = scene.mesh, scene.grid
    corners = [[Fraction(v) for v in vertex] for vertex in mesh.vertices.tolist()]
    exact = Fraction()
    for face in mesh.faces.tolist():
        exact += six_volumes(*(corners[v] for v in face))
    touched = voxtool.voxelize(mesh, grid, "surface26", device=device).count
    octree = voxtool.voxelize(
        mesh, grid, mode="fraction", fraction_type="f4", fill="parity", device=device
    )
    found = Fraction(stored_volume(octree))
    pitch = Fraction(scene.pitch)
    area = sum(
        float(np.linalg.norm(np.cross(b - a, c - a))) / 2 for a, b, c in scene.vertices[scene.faces]
    )
    bound = area * 3**0.5 * 2**-20 + touched * 2**-31
    return float(abs(found - abs(exact) / 6 / pitch**3)) / bound


def six_volumes(a: list[Fraction], b: list[Fraction], c: list[Fraction]) -> Fraction:
    """Return six times the signed volume between the origin and a triangle."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
