"""Sets of voxels at a distance from a surface: offset, hollow, thick, and drained.

A voxel is near if its centre is within the distance of the surface, exactly. Morphology leaves few
of them to be measured. Let the surface separate the centres of set voxels from the others, each of
its triangles in cells around one link between two such centres. Then a centre is at most as far
from the surface as from the nearest centre on the other side, and at most SLACK voxels less.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from voxtool.errors import MeshWarning, VoxtoolError, at_least
from voxtool.memory import check_memory
from voxtool.repairing.targets import Cylinder
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.booleans import combine
from voxtool.svo.sets.components import plan_keep_components
from voxtool.svo.sets.morphology import plan_morph
from voxtool.vector import cross, unit

if TYPE_CHECKING:
    from voxtool.mesh.mesh import Mesh
    from voxtool.opencl import Device
    from voxtool.spatial.distance import TriangleDistance
    from voxtool.svo.surface.isosurface import Isosurface

SLACK = math.sqrt(3) + 1e-6  # voxels: the diagonal of a cell, and rounding
LEAST_WALL = 2.0  # voxels: of thinner walls the two sides share cells
# Voxels outward, half the diagonal, and inward: of less, vertices move to the other side of the
# surface, which is as far away.
LEAST_OFFSET, LEAST_INSET = math.sqrt(3) / 2, 0.6
LEAST_RADIUS = 1.5  # voxels, of a drain hole
DEEPEST = 4  # times the wall: how deep the cavity may lie below the place of a drain
AT_ONCE = 1 << 20  # voxels whose distance is measured


def check_walls(
    pitch: float,
    offset: float,
    shell: float,
    thicken: float,
    drains: Sequence[Sequence[float]],
) -> None:
    """Raise VoxtoolError for lengths that are no lengths, contradict each other, or are too small
    for voxels of this size."""
    if sum(map(bool, (offset, shell, thicken))) > 1:
        raise VoxtoolError("an offset, a shell and a thick surface exclude each other: choose one")
    if not all(map(math.isfinite, (offset, shell, thicken, *(x for d in drains for x in d)))):
        raise VoxtoolError("a length or a place is not finite: give numbers")
    for what, length, least in (
        ("wall", shell or thicken, LEAST_WALL),
        ("offset", offset, LEAST_OFFSET if offset > 0 else LEAST_INSET),
    ):
        if length and not abs(length) >= least * pitch:
            raise VoxtoolError(
                f"{what} {length:g} is {abs(length) / pitch:.2g} voxels of {pitch:.4g}, of "
                f"{least:.3g} at least: give {at_least(least * pitch)} or more, or a larger dim"
            )
    if drains and not shell:
        raise VoxtoolError("drains go with a shell: there is no cavity")
    for drain in drains:
        if len(drain) != 4 or not drain[3] >= LEAST_RADIUS * pitch:
            raise VoxtoolError(
                f"drain {', '.join(f'{x:g}' for x in drain)}: give x, y, z and a radius of "
                f"{at_least(LEAST_RADIUS * pitch)} or more, {LEAST_RADIUS:g} voxels"
            )


def within(octree: Octree, distance: TriangleDistance, reach: float, device: Device) -> Octree:
    """Return the set voxels, and those whose centre is within `reach` world units of the surface
    around them."""
    radius = reach / octree.grid.pitch[0]
    sure = morphed(octree, "dilate", radius, device)
    most = morphed(octree, "dilate", radius + SLACK, device)
    return _sifted(sure, most, distance, lambda far: far <= reach, device)


def beyond(octree: Octree, distance: TriangleDistance, reach: float, device: Device) -> Octree:
    """Return the set voxels whose centre is farther than `reach` world units from the surface
    around them."""
    radius = reach / octree.grid.pitch[0]
    sure = morphed(octree, "erode", radius + SLACK, device)
    most = morphed(octree, "erode", radius, device)
    return _sifted(sure, most, distance, lambda far: far > reach, device)


def plate(touched: Octree, distance: TriangleDistance, reach: float, device: Device) -> Octree:
    """Return the voxels whose centre is within `reach` world units of a mesh, at least half the
    diagonal of a voxel; touched : those that the mesh touches."""
    radius, half = reach / touched.grid.pitch[0], SLACK / 2
    sure = morphed(touched, "dilate", max(radius - half, 0.0), device)
    most = morphed(touched, "dilate", radius + half, device)
    return _sifted(sure, most, distance, lambda far: far <= reach, device)


def cavities(
    octree: Octree, distance: TriangleDistance, wall: float, device: Device
) -> tuple[Octree, int]:
    """Return the set voxels beyond a wall, in world units, around them, and the number of their
    components; those smaller than a cube of the wall's side are left out."""
    inner = beyond(octree, distance, wall, device)  # refuses walls that reach too far
    size = math.ceil((wall / octree.grid.pitch[0]) ** 3)
    found = plan_keep_components(inner, min_size=size)
    with warnings.catch_warnings(action="ignore", category=MeshWarning):
        return found.run(), int(np.count_nonzero(found.sizes >= size))


def morphed(octree: Octree, operation: str, voxels: float, device: Device) -> Octree:
    """Return an octree dilated or eroded by a ball, empty if no voxel is left."""
    if voxels < 1:  # no other centre is as near
        return octree
    with warnings.catch_warnings(action="ignore", category=MeshWarning):
        return plan_morph(octree, operation, voxels, device=device).run()


def _sifted(
    sure: Octree,
    most: Octree,
    distance: TriangleDistance,
    held: Callable[[np.ndarray], np.ndarray],
    device: Device,
) -> Octree:
    """Return the sure voxels, and those of the others whose distance is `held`."""
    band = combine([most, sure], "difference", device=device)
    voxels = band.occupied()
    chosen = [
        block[held(distance(band.grid.to_world(block + 0.5)))]
        for block in (voxels[i : i + AT_ONCE] for i in range(0, len(voxels), AT_ONCE))
    ]
    found = Octree.from_voxels(np.concatenate([voxels[:0], *chosen]), band.grid, units=most.units)
    return combine([sure, found], device=device)


def drain_of(
    drain: Sequence[float],
    wall: float,
    cavity: Octree,
    surface: Mesh,
    distance: TriangleDistance,
    device: Device,
) -> tuple[Cylinder, Octree]:
    """Return the hole of a drain, x, y, z and a radius in world units, and its voxels: along the
    normal of the surface at its nearest point, from outside to the cavity."""
    *place, radius = map(float, drain)
    pitch = cavity.grid.pitch[0]
    found = distance.at_block(next(distance.blocks(np.array([place]))), located=True)
    assert found.points is not None
    assert found.faces is not None
    a, b, c = surface.vertices[surface.faces[found.faces[0]]]
    centre, axis = found.points[0], unit(cross(c - a, b - a)[None])[0]
    hole = Cylinder(centre, axis, radius, -(radius + 2 * pitch), DEEPEST * wall)
    met = combine([voxels_of(hole, cavity), cavity], "intersection", device=device)
    reached = hole.along(met.grid.to_world(met.occupied() + 0.5))
    if not len(reached):
        raise VoxtoolError(
            f"the drain at {', '.join(f'{x:g}' for x in place)} meets no cavity within "
            f"{DEEPEST * wall:g}: choose a place where the part is thicker"
        )
    hole = replace(hole, high=float(reached.min()) + pitch)
    return hole, voxels_of(hole, cavity)


def voxels_of(hole: Cylinder, like: Octree) -> Octree:
    """Return the voxels of an octree's grid whose centre is in a cylinder."""
    grid = like.grid
    ends = hole.centre + np.outer((hole.low, hole.high), hole.axis)
    low = np.floor((ends.min(axis=0) - hole.radius - grid.origin) / grid.pitch).astype(np.int64)
    high = np.ceil((ends.max(axis=0) + hole.radius - grid.origin) / grid.pitch).astype(np.int64)
    low, high = np.maximum(low, 0), np.maximum(np.minimum(high, grid.shape), 0)
    shape = np.maximum(high - low, 0)
    count = int(shape.prod())
    check_memory(100 * count, f"the {count:,} voxels around a drain")
    cells = np.indices(shape).reshape(3, -1).T + low
    return Octree.from_voxels(cells[hole.holds(grid.to_world(cells + 0.5))], grid)


def thinnest(
    surface: Isosurface, distance: TriangleDistance, wall: float, holes: Sequence[Cylinder]
) -> float:
    """Return the least distance from the surface of the cavities to the outer one, of vertices and
    of centres of faces. What lies within two voxels of a drain is left out."""
    vertices, pitch = surface.vertices, surface.grid.pitch[0]
    inner = distance(vertices) > wall / 2
    for hole in holes:
        inner &= ~hole.grown(2 * pitch).holds(vertices)
    faces = surface.faces[inner[surface.faces].all(axis=1)]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(distance(np.concatenate([a, b, c, (a + b + c) / 3])).min())
