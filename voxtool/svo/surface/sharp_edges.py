"""The distance of a mesh's sharp edges from its sharp surface: where an edge or a tip is thinner
than the voxels, the surface ends before it."""

from __future__ import annotations

from itertools import product

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import next_sides, topology_of
from voxtool.opencl import Device
from voxtool.spatial.distance import TriangleDistance
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.isosurface import Isosurface
from voxtool.vector import cross, dot, length

LEAST_COSINE = 0.75**0.5  # of the normals beside an edge that is not sharp: 30 degrees
SPACING = 0.25  # voxels between points of an edge, at most
MOST_POINTS = 1 << 20  # of all edges; beyond, they lie farther apart


def sharp_edges(mesh: Mesh) -> np.ndarray:
    """Return the (n, 2, 3) ends of the edges between faces whose normals are more than 30 degrees
    apart."""
    topology = topology_of(mesh)
    corners = mesh.vertices[mesh.faces[topology.proper]]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    one, other = topology.pairs
    a, b = normals[one // 3], normals[other // 3]
    sides = one[dot(a, b) < LEAST_COSINE * length(a) * length(b)]
    points = corners.reshape(-1, 3)
    return np.stack([points[sides], points[next_sides(sides)]], axis=1)


def farthest_sharp_edge(
    mesh: Mesh, octree: Octree, surface: Isosurface, device: Device
) -> tuple[float, tuple[float, ...]] | None:
    """Return the largest distance of the mesh's sharp edges from the surface, and where, in world
    units; None without such edges. Edges inside the octree, as those of parts that overlap, or
    beyond its grid do not count."""
    ends, grid = sharp_edges(mesh), octree.grid
    pitch, low = np.array(grid.pitch), np.array(grid.origin)
    voxels = length((ends[:, 1] - ends[:, 0]) / pitch)
    step = max(SPACING, float(voxels.sum()) / MOST_POINTS)
    counts = np.ceil(np.minimum(voxels / step, MOST_POINTS)).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(ends)), counts)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (place / np.maximum(counts[edge] - 1, 1))[:, None]
    points = ends[edge, 0] * (1 - share) + ends[edge, 1] * share
    held = ((points >= low) & (points <= low + pitch * grid.shape)).all(axis=1)
    around = np.array(list(product((-1, 1), repeat=3))) * pitch
    beside = (points[held][:, None] + around).reshape(-1, 3)
    within = octree.contains(beside, device=device).reshape(-1, len(around)).all(axis=1)
    points = points[held][~within]
    if not len(points):
        return None
    distances = TriangleDistance(surface.mesh(), device)(points)
    most = int(np.argmax(distances))
    return float(distances[most]), tuple(points[most].tolist())
