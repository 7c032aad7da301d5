"""Random scenes of closed parts, and what is inside of them by another algorithm.

Parts are turned polyhedra: boxes, icospheres and tori. A point is in a convex part if it is below
all planes of its faces, and in a torus if the ray from it crosses an odd number of its faces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from helpers import meshes

from voxtool.distances import plan_distance, plan_field
from voxtool.grid import Grid
from voxtool.mesh.mesh import Mesh
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

POINTS = 300


@dataclass(frozen=True)
class Part:
    vertices: np.ndarray
    faces: np.ndarray
    convex: bool
    inverted: bool

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return which points are inside, (n,) bool."""
        near = ((points > self.vertices.min(axis=0)) & (points < self.vertices.max(axis=0))).all(1)
        near[near] = self._holds(points[near])
        return near

    def _holds(self, points: np.ndarray) -> np.ndarray:
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        if self.convex:
            normals = np.cross(b - a, c - a)
            return (points @ normals.T < (normals * a).sum(axis=1)).all(axis=1)
        x, y, z = (points[:, i, None] for i in range(3))  # rays along z, (points, faces)
        areas = [
            (p[:, 0] - x) * (q[:, 1] - y) - (p[:, 1] - y) * (q[:, 0] - x)
            for p, q in ((b, c), (c, a), (a, b))
        ]
        whole = areas[0] + areas[1] + areas[2]
        hit = np.logical_and.reduce([part * whole > 0 for part in areas])
        height = areas[0] * a[:, 2] + areas[1] * b[:, 2] + areas[2] * c[:, 2]
        above = hit & ((height > z * whole) == (whole > 0))
        return np.count_nonzero(above, axis=1) % 2 == 1

    def within(self, other: Part) -> bool:
        """Return whether this part lies in another: its vertices do, and points on its faces if the
        other is not convex."""
        points = self.vertices
        if (points.min(axis=0) < other.vertices.min(axis=0)).any():
            return False
        if not other.convex:
            a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
            shares = [(i / 6, j / 6) for i in range(7) for j in range(7 - i)]
            points = np.concatenate([i * a + j * b + (1 - i - j) * c for i, j in shares])
        return bool(other.holds(points).all())


@dataclass(frozen=True)
class Scene:
    parts: list[Part]

    @property
    def mesh(self) -> Mesh:
        shells = [(p.vertices, p.faces[:, ::-1] if p.inverted else p.faces) for p in self.parts]
        return meshes.mesh_of(*meshes.join(*shells))

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return where winding numbers are 1 or more, each shell turned by what encloses it."""
        order = sorted(range(len(self.parts)), key=lambda i: -_volume(self.parts[i]))
        parent = {
            i: next((j for j in reversed(order[:n]) if self.parts[i].within(self.parts[j])), None)
            for n, i in enumerate(order)
        }
        number = np.zeros(len(points), int)
        for i in order:
            root = i
            while (up := parent[root]) is not None:
                root = up
            outward = self.parts[i].inverted == self.parts[root].inverted
            number += np.where(self.parts[i].holds(points), 1 if outward else -1, 0)
        return number >= 1


def _volume(part: Part) -> float:
    a, b, c = part.vertices[part.faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def random_scene(rng: np.random.Generator) -> Scene:
    """Two to twelve parts, a third of them turned inside out, a third within another."""
    parts: list[Part] = []
    for _ in range(rng.integers(2, 13)):
        kind = rng.integers(3)
        vertices, faces = (
            (
                lambda: meshes.box(-1.0, 1.0),
                lambda: meshes.icosphere(1),
                lambda: meshes.torus(sides=(12, 6)),
            )
        )[kind]()
        vertices = np.asarray(vertices, float) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        vertices = vertices / np.abs(vertices).max() * rng.uniform(0.3, 1)
        place = rng.uniform(-1, 1, 3)
        if parts and rng.random() < 1 / 3:
            other = parts[rng.integers(len(parts))]
            vertices = vertices * 0.2
            place = other.vertices.mean(axis=0) + rng.uniform(-0.1, 0.1, 3)
        part = Part(vertices + place, np.asarray(faces), kind < 2, bool(rng.random() < 1 / 3))
        if _volume(part) < 0:
            part = Part(part.vertices, part.faces[:, ::-1], part.convex, part.inverted)
        parts.append(part)
    return Scene(parts)


def _set_voxels(mesh: Mesh, grid: Grid, device: Device) -> np.ndarray:
    octree = voxelize(mesh, grid, device=device)
    return np.concatenate(list(VoxelImage.of(octree).slabs()))


def check_scene(scene: Scene, seed: int, device: Device, *, field: bool) -> None:
    """Compare distances, voxels and a field with the oracle; voxels farther than rounding."""
    mesh, rng = scene.mesh, np.random.default_rng(seed)
    measure = plan_distance(mesh, device=device).run()
    low, high = mesh.bounds
    points = rng.uniform(low - 0.1, high + 0.1, (POINTS, 3))
    assert np.array_equal(measure(points) < 0, scene.inside(points))
    grid = Grid.fit(mesh, 20)
    cells = rng.integers(grid.shape, size=(4 * POINTS, 3))
    centres = grid.to_world(cells + 0.5)
    clear = np.abs(measure(centres)) > grid.pitch[0] / 100
    found = _set_voxels(mesh, grid, device)[tuple(cells.T)]
    assert np.array_equal(found[clear], scene.inside(centres)[clear])
    if field:
        built = plan_field(mesh, max_level=5, measure=False, device=device).run()
        distances = built.query(points).distance
        far = np.abs(measure(points)) > built.side / 32
        assert np.array_equal(distances[far] < 0, scene.inside(points)[far])
