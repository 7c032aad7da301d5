"""The distances between a repaired surface and the mesh: means of samples, and bounds that hold.

The outer surface of a mesh is the part of it whose voxels lie near what a flood reaches from
outside: all that is within a diagonal of a voxel of the centre of such a voxel. Faces inside, which
no repair keeps, are left out of it. Large faces are divided first, and a piece counts as inside if
its corners and its centre are.
"""

from __future__ import annotations

import math
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.mesh.mesh import Mesh
from voxtool.repairing.walls import morphed
from voxtool.spatial.deviation import averages, largest, one_way
from voxtool.spatial.hausdorff import bound
from voxtool.spatial.sampling import SurfaceSampler
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine
from voxtool.svo.voxelization.voxelize import plan_voxelize
from voxtool.vector import dot

if TYPE_CHECKING:
    from voxtool.opencl import Device
    from voxtool.spatial.distance import TriangleDistance

SAMPLES = 100_000  # on each surface, for means
APART = 0.02  # voxels between the bounds of a largest distance
# Voxels between centres: a diagonal to where a flood reaches, and half of one from a centre to the
# points of its voxel.
NEAR_OUTSIDE = 1.5 * math.sqrt(3)
LONGEST = 4.0  # voxels: the edges of pieces of faces


def measure(
    surface: Mesh, onto_surface: TriangleDistance, mesh: Mesh, onto_mesh: TriangleDistance,
    octree: Octree,
) -> dict[str, Any]:  # fmt: skip
    """Return the distances from a surface to a mesh, and back from all of it and from its outer
    surface, in JSON types, world units; octree : whose surface it is."""
    pitch = octree.grid.pitch[0]
    tolerance = APART * pitch
    pieces, outside = outer_faces(mesh, octree, onto_mesh.device)
    there = one_way(SurfaceSampler(surface, "mesh"), onto_mesh, SAMPLES, tolerance)
    outer, inner = (
        largest(bound(pieces, pieces.faces[some], onto_surface, tolerance)) if some.any() else None
        for some in (outside, ~outside)
    )
    ways = [way for way in (outer, inner) if way]
    back = max(ways, key=itemgetter("max"))
    return {
        "pitch": pitch,
        "samples": SAMPLES,
        "tolerance": tolerance,
        "result_to_mesh": there,
        "mesh_to_result": {
            **averages(SurfaceSampler(mesh, "mesh"), onto_surface, SAMPLES),
            **back,
            "max_upper": max(way["max_upper"] for way in ways),
        },
        "outer_mesh_to_result": outer,
    }


def outer_faces(mesh: Mesh, octree: Octree, device: Device) -> tuple[Mesh, np.ndarray]:
    """Return a mesh with its large faces divided, and which faces are of its outer surface, (F,)
    bool, at the grid of an octree."""
    grid = octree.grid
    flooded = plan_voxelize(mesh, grid, fill="flood", device=device).run()
    deep = morphed(flooded, "erode", NEAR_OUTSIDE, device)
    pieces = divided(mesh, LONGEST * grid.pitch[0])
    corners = pieces.vertices[pieces.faces]
    points = np.concatenate([corners, corners.sum(axis=1, keepdims=True) / 3], axis=1)
    cells = np.floor((points.reshape(-1, 3) - grid.origin) / grid.pitch).astype(np.int64)
    cells = np.clip(cells, 0, np.array(grid.shape) - 1)
    probe = Octree.from_voxels(cells, grid)
    held = combine([probe, deep], "intersection", device=device).occupied()
    numbers = np.array([np.prod(grid.shape[1:], dtype=np.int64), grid.shape[2], 1])
    inside = np.isin((cells * numbers).sum(axis=1), (held * numbers).sum(axis=1)).reshape(-1, 4)
    return pieces, ~(inside[:, 0] & inside[:, 1] & inside[:, 2] & inside[:, 3])


def divided(mesh: Mesh, longest: float) -> Mesh:
    """Return a mesh whose faces are divided in four until no edge is longer."""
    corners, done = mesh.vertices[mesh.faces], []
    while len(corners):
        edges = corners - np.roll(corners, 1, axis=1)
        small = (dot(edges, edges) <= longest * longest).all(axis=1)
        done.append(corners[small])
        a, b, c = corners[~small].transpose(1, 0, 2)
        ab, bc, ca = (0.5 * p + 0.5 * q for p, q in ((a, b), (b, c), (c, a)))
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    vertices = np.concatenate(done).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, name=mesh.name)
