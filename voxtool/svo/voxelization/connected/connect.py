"""The voxels that keep the thin parts of a solid in one piece.

Candidates are voxels that touch the mesh about parts that are thinner than two voxels
(thin_parts.py). With the solid they are thinned (thinning.py): those go first whose centres are
farthest from the mesh, and the voxels of the solid stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.grid import FIXED_POINT_BITS
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.octree.layout import BRICK_SIDE, descend, unite_bricks
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.tiling import Tiling
from voxtool.svo.voxelization.connected.about import CONNECTED
from voxtool.svo.voxelization.connected.parts import Shells
from voxtool.svo.voxelization.connected.thin_parts import Bricks, Solid, find_thin_parts
from voxtool.svo.voxelization.connected.thinning import Thinning
from voxtool.svo.voxelization.mesh_parts import PartMesh
from voxtool.svo.voxelization.part_octrees import plan_parts
from voxtool.svo.voxelization.part_pieces import list_pieces
from voxtool.svo.voxelization.scan_conversion import TOUCHED, ActiveNodes, Scan
from voxtool.vector import cross, dot, length

if TYPE_CHECKING:
    from voxtool.svo.voxelization.voxelize import VoxelizeJob

STEPS_OF_DISTANCE = 16  # in a voxel: voxels that are farther from the mesh go first


def connect(job: VoxelizeJob, octree: Octree, scan: Scan, active: ActiveNodes) -> Octree:
    """Return the solid of a job with the voxels that connect its thin parts, which the job then
    has as `added`; the octree's plan counts them and its components before and after.

    Parameters
    ----------
    scan, active : Scan, ActiveNodes
        The scan of the job's mesh, and its active level-1 nodes.
    """
    codes = descend(active.nodes.get().astype(np.uint64))
    surface = Bricks(codes, scan.voxels(TOUCHED, active).take())
    solid = Solid(Tiling.of(octree, 0))
    parts = None if job.one_part else parts_of_faces(job, scan, active, surface)
    if parts is None:
        added = _added(solid, surface, partial(distances_in, scan, active), job.limit)
    else:
        added = added_to_parts(job, parts)
    places = np.searchsorted(octree.levels()[-1].codes, added.codes)
    masks = added.masks & ~octree.bricks[places]
    job.added = Bricks(added.codes[masks != 0], masks[masks != 0])
    pieces = became = solid.pieces
    if masks.any():
        bricks = octree.bricks.copy()
        bricks[places] |= masks
        octree = replace(octree, bricks=bricks)
        became = Solid(Tiling.of(octree, 0)).pieces
    count = int(np.bitwise_count(masks).sum())
    facts = {"added": count, "pieces": pieces, "became": became}
    return replace(octree, plan={**octree.plan, CONNECTED: facts})


def _added(
    solid: Solid, surface: Bricks, distances: Callable[[np.ndarray], np.ndarray], max_memory: int
) -> Bricks:
    """Return the voxels that connect the thin parts of a solid, given those that its mesh touches;
    `distances` returns those of voxels, in masks of the surface's bricks, to the mesh."""
    frame = morton_encode(np.full((1, 3), solid.voxels.corner // BRICK_SIDE))
    thin = find_thin_parts(solid, Bricks(surface.codes | frame, surface.masks), max_memory)
    candidates = Bricks.of(thin.codes[thin.added])
    if not len(candidates.codes):
        return candidates
    masks = np.zeros_like(surface.masks)
    masks[np.searchsorted(surface.codes, candidates.codes ^ frame)] = candidates.masks
    weights = STEPS_OF_DISTANCE - np.floor(STEPS_OF_DISTANCE * distances(masks)).astype(int)
    thinning = Thinning(thin.added, thin.covered, ~thin.between, thin.beside)
    stays = thinning.run(weights, thin.subfields)
    added = Bricks.of(thin.codes[stays & thin.added])
    return Bricks(added.codes ^ frame, added.masks)


def parts_of_faces(
    job: VoxelizeJob, scan: Scan, active: ActiveNodes, surface: Bricks
) -> np.ndarray | None:
    """Return the part of the inside that each face of a mesh bounds, (F,) int32; None if there is
    one part."""
    shells = Shells(job.mesh_of_faces, job.lattice.fixed)
    if not shells.several:
        return None
    part = shells.united(*_pairs(scan, active, surface.masks))[shells.of]
    return part.astype(np.int32) if (part != part[0]).any() else None


def added_to_parts(job: VoxelizeJob, parts: np.ndarray) -> Bricks:
    """Return the voxels that connect the thin parts of a job's mesh, of which each part is
    voxelized alone."""
    mesh, fill = job.mesh_of_faces, job.plan.fill
    closed_fill = "nonzero" if fill == "winding" else fill  # shells inside out are inside, too
    request: dict[str, Any] = {"connected": True, "max_memory": job.max_memory}
    request |= {"device": job.device}
    own = PartMesh.of_mesh(mesh, parts)
    _, atlas, jobs = plan_parts(mesh, own, job.grid, "solid", fill, closed_fill, **request)
    found = []
    with job.device.reporting(lambda _: None):  # not the stages within
        for inner in jobs:
            inner.one_part = True
            inner.solid_octree()
            assert inner.added is not None
            found.append(inner.added)
    if atlas:
        found[0] = Bricks(atlas.home_of(found[0].codes), found[0].masks)
    codes = np.concatenate([one.codes for one in found])
    order = np.argsort(codes, kind="stable")
    masks = np.concatenate([one.masks for one in found])
    return Bricks(*unite_bricks(codes[order], masks[order]))


def _pairs(scan: Scan, active: ActiveNodes, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rank of the voxel and the face of each pair of them that touch, for the voxels of
    masks of the active nodes' bricks."""
    counts = np.bitwise_count(masks).astype(np.int64)
    starts = (np.cumsum(counts) - counts).astype(np.uint32)
    put = scan.device.put
    found = list_pieces(scan, active, put(masks), put(starts), TOUCHED)
    return found.voxels.get(0, found.n), found.faces.get(0, found.n)


def distances_in(scan: Scan, active: ActiveNodes, masks: np.ndarray) -> np.ndarray:
    """Return the distance from the centre of each voxel of masks of the active nodes' bricks to the
    triangles that touch it, (n,) float64, in voxels."""
    mesh, unit = scan.mesh, 1 << FIXED_POINT_BITS
    voxels, faces = _pairs(scan, active, masks)
    bricks = Bricks(descend(active.nodes.get().astype(np.uint64)), masks)
    centres = unit * morton_decode(bricks.where(masks)) + unit // 2
    corners = mesh.fixed[mesh.faces.get().reshape(-1, 3)[faces]] - centres[voxels, None]
    least = np.full(len(centres), np.inf)
    np.minimum.at(least, voxels, distances_of(corners.astype(np.float64)))
    return least / unit


def distances_of(triangles: np.ndarray) -> np.ndarray:
    """Return the distance from the origin to each triangle, (n,) float64, given (n, 3, 3)
    corners."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = cross(b - a, c - a)
    size = dot(normal, normal)
    above = (size > 0) & (dot(cross(a, b), normal) >= 0)
    above &= (dot(cross(b, c), normal) >= 0) & (dot(cross(c, a), normal) >= 0)
    height = np.abs(dot(a, normal)) / np.sqrt(np.where(size > 0, size, 1))
    sides = [_distance_of_side(p, q) for p, q in ((a, b), (b, c), (c, a))]
    return np.where(above, height, np.minimum.reduce(sides))


def _distance_of_side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    along = q - p
    size = dot(along, along)
    share = np.clip(-dot(p, along) / np.where(size > 0, size, 1), 0, 1)
    return length(p + share[:, None] * along)
