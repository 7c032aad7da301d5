"""A mesh of cells to the textures of a volume [TetVol, section 4.1].

Everything is found in float64, in local coordinates, and rounded to float32 once. A face is the
same whichever of its cells sees it: its plane is found from its vertices in one order, and the cell
on the other side has the negation.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from voxtool.choices import LAYOUTS
from voxtool.errors import MeshError, VoxtoolError
from voxtool.job import Job
from voxtool.morton import morton_encode
from voxtool.tets.conforming import hexahedra, tetrahedra
from voxtool.tets.faces import loops
from voxtool.tets.mesh import ConformingMesh, UnstructuredMesh, VolumeCells, volume_cells
from voxtool.tets.plan import VolumePlan
from voxtool.tets.volume import FACES, TetVolume, block_ranges
from voxtool.vector import cross, dot, length, triple

MORTON_BITS = 21  # of each coordinate of a centroid
LEAST = 2.0**-126  # what float32 holds below it, some devices take for 0


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
    cells: dict[str, int] = {}
    for kind, block in found.blocks:
        cells[kind] = cells.get(kind, 0) + len(block)
    ignored, points = found.report["ignored"], len(found.points)
    plan = VolumePlan(layout, merge_distance, cells, ignored, points, mesh.constant)
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
        mesh, plan = self.mesh, self.plan
        with self.stage(plan.stages[0]):
            conforming = hexahedra if plan.layout == "hexahedra" else tetrahedra
            cells = conforming(
                mesh, plan.merge_distance, found=self.found, max_pairs=plan.max_pairs
            )
        with self.stage("order"):
            origin, scale = _frame(cells)
            low, high = _scalar_range(cells)
            local = _ordered(
                replace(
                    cells,
                    vertices=(cells.vertices - origin) / scale,
                    scalars=(cells.scalars - low) / ((high - low) or 1.0),
                )
            )
        with self.stage("planes"):
            vertices = np.zeros((len(local.vertices), 4), np.float32)
            vertices[:, :3] = float32(local.vertices)
            if not local.constant:
                vertices[:, 3] = float32(local.scalars)
            normals, plane_error = _planes(local, vertices, plan.layout)
        with self.stage("gradients"):
            gradients, scalar_error = _gradients(local, vertices)
        report = {
            **cells.report,
            "boundary_faces": int(np.count_nonzero(local.neighbours < 0)),
            "plane_error": plane_error,
            "scalar_error": scalar_error,
        }
        projection = plan.layout == "projection"
        volume = TetVolume(
            plan.layout,
            vertices,
            local.cells,
            local.neighbours,
            normals[:, :, :3].copy() if projection else normals,
            gradients[:, :3].copy() if projection else gradients,
            local.cells[:, :2].copy() if projection else None,
            np.zeros((0, 2), np.float32),
            triple(origin),
            scale,
            (low, high),
            mesh.scalar,
            mesh.constant,
            units=mesh.units,
            source_sha256=mesh.source_sha256,
            plan=plan.scene(),
            report=report,
        )
        return replace(volume, ranges=block_ranges(*volume.cell_ranges()))


def _scalar_range(mesh: ConformingMesh) -> tuple[float, float]:
    """The least and the largest scalar.

    Raises
    ------
    MeshError : their difference is not finite.
    """
    low, high = float(mesh.scalars.min()), float(mesh.scalars.max())
    if not math.isfinite(high - low):
        raise MeshError(
            f"{mesh.name or 'mesh'}: {mesh.scalar} from {low:g} to {high:g} is a range that "
            "float64 does not hold: scale it"
        )
    return low, high


def float32(values: np.ndarray) -> np.ndarray:
    """Rounded to float32, and those that it holds with fewer bits to 0."""
    return np.where(np.abs(values) < LEAST, 0.0, values).astype(np.float32)


def _frame(mesh: ConformingMesh) -> tuple[np.ndarray, float]:
    """The middle of the mesh, and the power of two that brings it into [-1, 1] around it."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = low / 2 + high / 2 + 0.0
    reach = float(np.maximum(high - origin, origin - low).max())
    if not 2.0**-1000 < reach < 2.0**1000:
        raise MeshError(
            f"{mesh.name or 'mesh'}: positions up to {reach:g} from the middle of the mesh: scale "
            "them to what float64 computes with, 1e-300 to 1e300"
        )
    mantissa, exponent = math.frexp(reach)
    scale = math.ldexp(1.0, exponent - (mantissa == 0.5))
    return origin, scale


def _ordered(mesh: ConformingMesh) -> ConformingMesh:
    """The mesh with its cells along the Morton curve of their centroids, and its vertices in the
    order of their first use."""
    count = mesh.cells.shape[1]
    centroid = sum(mesh.vertices[mesh.cells[:, i]] for i in range(count)) / count
    place = ((centroid + 1) * 2.0 ** (MORTON_BITS - 1)).astype(np.int64)
    order = np.argsort(morton_encode(place.clip(0, (1 << MORTON_BITS) - 1)), kind="stable")
    rank = np.full(len(mesh.cells) + 1, -1, np.int32)  # the last is what -1, no cell, finds
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
    """(F, T, 4) float32: normal and offset of each face, and how far at most one of its vertices
    in float32 is from its plane.

    The offset is that of the plane, of this normal in float32, midway between the outermost and
    the innermost of the face's vertices.
    """
    normals, error = np.empty((len(FACES[layout]), len(mesh.cells), 4), np.float32), 0.0
    for face, plane in zip(FACES[layout], normals, strict=True):
        loop, backward = loops(mesh.cells, np.array([face]))
        loop, backward = loop[:, 0], backward[:, 0]
        corners = [mesh.vertices[loop[:, i]] for i in range(len(face))]
        normal = cross(corners[2] - corners[0], corners[-1] - corners[1])
        plane[:, :3] = float32(normal / length(normal)[:, None])
        heights = np.stack([_height(plane, corner) for corner in corners])
        plane[:, 3] = float32(-(heights.min(axis=0) + heights.max(axis=0)) / 2)
        for i in range(len(face)):
            height = _height(plane, vertices[loop[:, i], :3].astype(np.float64)) + plane[:, 3]
            error = max(error, float(np.abs(height).max()))
        plane[backward] *= -1
    return normals, error


def _height(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(T,) float64: of points along the normals of planes."""
    return dot(plane[:, :3].astype(np.float64), points)


def _slopes(mesh: ConformingMesh) -> np.ndarray:
    """(T, 3) float64: the gradient of the scalar in each tetrahedron, by the inverse of its
    edges."""
    points, scalars = mesh.vertices[mesh.cells], mesh.scalars[mesh.cells]
    edges = [points[:, i] - points[:, 0] for i in (1, 2, 3)]
    normals = [cross(edges[(i + 1) % 3], edges[(i + 2) % 3]) for i in range(3)]
    slopes = np.zeros((len(mesh.cells), 3))
    for i, normal in enumerate(normals):
        slopes += (scalars[:, i + 1] - scalars[:, 0])[:, None] * normal
    return slopes / dot(edges[0], normals[0])[:, None]


def _gradients(mesh: ConformingMesh, vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """(T, 4) float32: gradient and scalar term of each cell, and how far at most its value is from
    the scalar at a vertex in float32.

    The scalar term is midway between what the four vertices ask for.
    """
    gradients = np.zeros((len(mesh.cells), 4), np.float32)
    if mesh.constant:
        gradients[:, 3] = float32(mesh.scalars)
        return gradients, 0.0
    gradients[:, :3] = float32(_slopes(mesh))
    wanted = [mesh.scalars[k] - _height(gradients, mesh.vertices[k]) for k in mesh.cells.T]
    gradients[:, 3] = float32((np.min(wanted, axis=0) + np.max(wanted, axis=0)) / 2)
    error = 0.0
    for k in mesh.cells.T:
        corner = vertices[k].astype(np.float64)
        value = _height(gradients, corner[:, :3]) + gradients[:, 3]
        error = max(error, float(np.abs(value - corner[:, 3]).max()))
    return gradients, error
