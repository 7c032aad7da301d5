"""A mesh of cells to the textures of a volume [TetVol, section 4.1].

Everything is computed in float64, in local coordinates, and rounded to float32 once. The plane of a
face is computed from its vertices in one order, whichever cell has the face; the cell on the other
side has the negated plane.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from voxtool.choices import LAYOUTS
from voxtool.errors import MeshError, VoxtoolError
from voxtool.job import Job
from voxtool.morton import morton_encode
from voxtool.tets.cells import loops
from voxtool.tets.conforming import hexahedra, tetrahedra
from voxtool.tets.mesh import ConformingMesh, UnstructuredMesh, VolumeCells, volume_cells
from voxtool.tets.plan import VolumePlan
from voxtool.tets.volume import FACES, TetVolume
from voxtool.vector import cross, dot, length, triple

MORTON_BITS = 21  # of each coordinate of a centroid
LEAST = 2.0**-126  # some devices round smaller numbers of float32 to 0


def build_tet(
    mesh: UnstructuredMesh,
    layout: str = "raycast",
    merge_distance: float = 0.0,
    *,
    max_memory: int | None = None,
) -> TetVolume:
    """Return the volume of a mesh; see voxtool.build_tet."""
    return plan_tet(mesh, layout, merge_distance, max_memory=max_memory).run()


def plan_tet(
    mesh: UnstructuredMesh,
    layout: str = "raycast",
    merge_distance: float = 0.0,
    *,
    max_memory: int | None = None,
) -> VolumeJob:
    """Return the job of the volume of a mesh; see voxtool.build_tet."""
    if layout not in LAYOUTS:
        raise VoxtoolError(f"layout {layout!r} is unknown: choose {', '.join(LAYOUTS)}")
    if layout == "projection" and mesh.constant:
        raise VoxtoolError(
            f"{mesh.name or 'mesh'}: {mesh.scalar} is one a cell, and the layout projection holds "
            "scalars of vertices: use --layout raycast"
        )
    found = volume_cells(mesh)
    cells: Counter[str] = Counter()
    for kind, block in found.blocks:
        cells[kind] += len(block)
    ignored, points = found.report["ignored"], len(found.points)
    plan = VolumePlan(layout, merge_distance, dict(cells), ignored, points, mesh.constant)
    return VolumeJob(mesh, found, plan, max_memory)


class VolumeJob(Job[TetVolume]):
    """A planned volume; `run` returns a TetVolume."""

    device = None
    plan: VolumePlan

    def __init__(
        self, mesh: UnstructuredMesh, found: VolumeCells, plan: VolumePlan, max_memory: int | None
    ) -> None:
        self.mesh, self.found, self.plan, self.max_memory = mesh, found, plan, max_memory

    def _run(self) -> TetVolume:
        plan = self.plan
        with self.stage(plan.stages[0]):
            conforming = hexahedra if plan.layout == "hexahedra" else tetrahedra
            cells = conforming(self.found, plan.merge_distance, plan.max_pairs)
        with self.stage("order"):
            frame = _frame(cells, self.found)
            local = _ordered(frame.localised(cells))
        with self.stage("planes"):
            vertices = np.zeros((len(local.vertices), 4), np.float32)
            vertices[:, :3] = _float32(local.vertices)
            if not local.constant:
                vertices[:, 3] = _float32(local.scalars)
            normals, plane_error = _planes(local, vertices, plan.layout)
        with self.stage("gradients"):
            gradients, scalar_error = _gradients(local, vertices)
        errors = {"plane_error": plane_error, "scalar_error": scalar_error}
        return self._volume(frame, local, vertices, normals, gradients, errors)

    def _volume(
        self,
        frame: Frame,
        local: ConformingMesh,
        vertices: np.ndarray,
        normals: np.ndarray,
        gradients: np.ndarray,
        errors: dict[str, float],
    ) -> TetVolume:
        """Return the volume that holds the textures."""
        mesh, projection = self.mesh, self.plan.layout == "projection"
        floats = 3 if projection else 4
        outside = int(np.count_nonzero(local.neighbours < 0))
        volume = TetVolume(
            self.plan.layout,
            vertices,
            local.cells,
            local.neighbours,
            normals[:, :, :floats].copy(),
            gradients[:, :floats].copy(),
            local.cells[:, :2].copy() if projection else None,
            np.zeros((0, 2), np.float32),
            triple(frame.origin),
            frame.scale,
            (frame.low, frame.high),
            mesh.scalar,
            mesh.constant,
            mesh.units,
            mesh.source_sha256,
            self.plan.scene(),
            {**local.report, "boundary_faces": outside, **errors},
        )
        return replace(volume, ranges=volume.block_ranges())


class Frame(NamedTuple):
    """The local frame of a volume: world = origin + scale * local; and its range of scalars."""

    origin: np.ndarray
    scale: float
    low: float
    high: float

    def localised(self, mesh: ConformingMesh) -> ConformingMesh:
        """Return a mesh in local coordinates, with normalised scalars."""
        scalars = (mesh.scalars - self.low) / ((self.high - self.low) or 1.0)
        return replace(mesh, vertices=(mesh.vertices - self.origin) / self.scale, scalars=scalars)


def _frame(mesh: ConformingMesh, found: VolumeCells) -> Frame:
    """Return the frame that brings a mesh into [-1, 1] around its middle, by a power of two.

    Raises
    ------
    MeshError : float64 does not hold the range of positions or scalars; `found` has the names.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = low / 2 + high / 2 + 0.0
    reach = float(np.maximum(high - origin, origin - low).max())
    if not 2.0**-1000 < reach < 2.0**1000:
        raise MeshError(
            f"{found.name}: positions up to {reach:g} from the middle of the mesh: scale "
            "them to what float64 computes with, 1e-300 to 1e300"
        )
    mantissa, exponent = math.frexp(reach)
    scale = math.ldexp(1.0, exponent - (mantissa == 0.5))
    least, most = float(mesh.scalars.min()), float(mesh.scalars.max())
    if not math.isfinite(most - least):
        raise MeshError(
            f"{found.name}: {found.scalar} from {least:g} to {most:g} is a range that "
            "float64 does not hold: scale it"
        )
    return Frame(origin, scale, least, most)


def _float32(values: np.ndarray) -> np.ndarray:
    """Return values rounded to float32; those below LEAST become 0."""
    return np.where(np.abs(values) < LEAST, 0.0, values).astype(np.float32)


def _ordered(mesh: ConformingMesh) -> ConformingMesh:
    """Return a mesh with its cells along the Morton curve of their centroids, and its vertices in
    the order of their first use."""
    count = mesh.cells.shape[1]
    centroid = sum(mesh.vertices[mesh.cells[:, i]] for i in range(count)) / count
    place = ((centroid + 1) * 2.0 ** (MORTON_BITS - 1)).astype(np.int64)
    order = np.argsort(morton_encode(place.clip(0, (1 << MORTON_BITS) - 1)), kind="stable")
    rank = np.full(len(mesh.cells) + 1, -1, np.int32)  # the last is for -1, no cell
    rank[order] = np.arange(len(order))
    cells = mesh.cells[order]
    used, first = np.unique(cells, return_index=True)
    vertices = used[np.argsort(first)]
    number = np.zeros(len(mesh.vertices), np.int32)
    number[vertices] = np.arange(len(vertices))
    return replace(
        mesh,
        vertices=mesh.vertices[vertices],
        cells=number[cells],
        neighbours=rank[mesh.neighbours[order]],
        scalars=mesh.scalars[order if mesh.constant else vertices],
    )


def _planes(mesh: ConformingMesh, vertices: np.ndarray, layout: str) -> tuple[np.ndarray, float]:
    """Return normal and offset of each face, (F, T, 4) float32, and the largest distance of a
    face's vertex, in float32, from its plane.

    The offset is midway between those of the outermost and the innermost vertex of the face.
    """
    normals, error = np.empty((len(FACES[layout]), len(mesh.cells), 4), np.float32), 0.0
    for face, plane in zip(FACES[layout], normals, strict=True):
        loop, backward = (found[:, 0] for found in loops(mesh.cells, np.array([face])))
        corners = [mesh.vertices[k] for k in loop.T]
        normal = cross(corners[2] - corners[0], corners[-1] - corners[1])
        plane[:, :3] = _float32(normal / length(normal)[:, None])
        heights = [_height(plane, corner) for corner in corners]
        plane[:, 3] = _float32(-_middle(heights))
        for k in loop.T:
            height = _height(plane, vertices[k, :3].astype(np.float64)) + plane[:, 3]
            error = max(error, float(np.abs(height).max()))
        plane[backward] *= -1
    return normals, error


def _height(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the dot products of normals, or gradients, in float32 with points, (T,) float64."""
    return dot(plane[:, :3].astype(np.float64), points)


def _middle(values: list[np.ndarray]) -> np.ndarray:
    """Return the middle between the least and the largest of several values, element by element."""
    return (np.min(values, axis=0) + np.max(values, axis=0)) / 2


def _slopes(mesh: ConformingMesh) -> np.ndarray:
    """Return the gradient of the scalar in each tetrahedron, by the inverse of its edges, (T, 3)
    float64."""
    points, scalars = mesh.vertices[mesh.cells], mesh.scalars[mesh.cells]
    edges = [points[:, i] - points[:, 0] for i in (1, 2, 3)]
    normals = [cross(edges[(i + 1) % 3], edges[(i + 2) % 3]) for i in range(3)]
    slopes = np.zeros((len(mesh.cells), 3))
    for i, normal in enumerate(normals):
        slopes += (scalars[:, i + 1] - scalars[:, 0])[:, None] * normal
    return slopes / dot(edges[0], normals[0])[:, None]


def _gradients(mesh: ConformingMesh, vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Return gradient and scalar term of each cell, (T, 4) float32, and the largest difference of
    a cell's scalar at a vertex from that of the vertex in float32.

    The scalar term is midway between those by which the cell has the scalars of its vertices.
    """
    gradients = np.zeros((len(mesh.cells), 4), np.float32)
    if mesh.constant:
        gradients[:, 3] = _float32(mesh.scalars)
        return gradients, 0.0
    gradients[:, :3] = _float32(_slopes(mesh))
    terms = [mesh.scalars[k] - _height(gradients, mesh.vertices[k]) for k in mesh.cells.T]
    gradients[:, 3] = _float32(_middle(terms))
    error = 0.0
    for k in mesh.cells.T:
        corner = vertices[k].astype(np.float64)
        value = _height(gradients, corner[:, :3]) + gradients[:, 3]
        error = max(error, float(np.abs(value - corner[:, 3]).max()))
    return gradients, error
