"""Ray casting of the surface of a field, or of an offset surface at a distance from it.

A ray visits the leaves in order. In a leaf the field along the ray is a cubic, whose first root is
computed [Marmitt 2004], so thin features are not missed: the picture shows the first point at which
the field equals the offset. Where a ray leaves a leaf, it skips the least possible distance to the
surface, (distance - offset) / the Lipschitz constant, as in sphere tracing [Hart 1996]. This
requires a field without cracks that is nowhere steeper. Rays therefore do not skip into steeper
leaves: those with a sign discontinuity, which the stored constant excludes, and the few steeper
than STEEPEST, which would shorten all steps. A table stores the distance to these leaves. In fields
with cracks rays skip nothing.

A ray that starts inside shows the surface from inside. Nothing is drawn outside the cube: surfaces
that leave it are open there. An offset beyond the field's values draws nothing.

Kernels: kernels/adf/raycast.cl.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.cells import cell_of
from voxtool.adf.field import FAR
from voxtool.adf.query import textures_of
from voxtool.camera import checked_colour
from voxtool.errors import VoxtoolError
from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.adf.field import DistanceField
    from voxtool.adf.scene import FieldScene
    from voxtool.camera import Rays
    from voxtool.opencl import Device

SOURCE = "adf/raycast.cl"
COLOUR = (0.86, 0.82, 0.76)  # a warm light grey
STEEPEST = math.sqrt(3)  # the largest slope of interpolated exact distances of one sign
SAFETY = 1 - 2.0**-10  # factor of skipped lengths, for rounding
ROOM_LEVEL = 5  # level of the cells of the table of distances to steep leaves
TILE = 8  # a work-group draws TILE x TILE pixels

HEADERS = {"adf/raycast.h": program.c_constants(ROOM_LEVEL=ROOM_LEVEL, TILE=TILE)}


def cast(scene: FieldScene, rays: Rays, device: Device) -> np.ndarray:
    """Return the picture of a scene along rays in the world: (height, width, 4) float32,
    premultiplied colour, and opacity, which is 1 on the surface.

    Without `leap` the picture is the same except for rounding. The field stays on the device for
    the next picture.
    """
    field = scene.content
    shown = local_offset(field, scene.offset)
    leaps = device.keep(field, "leaps", len(field.blocks), lambda: _leaps(field, device))
    local = rays.local(field.origin, field.side)
    camera = np.concatenate([local.origin, local.direction, local.right, local.down])
    width, height = rays.size
    textures, pixels = textures_of(field, device), device.empty(4 * width * height, np.float32)
    tiles = -(-width // TILE) * -(-height // TILE)
    with device.stage("ray casting"):
        device.kernel(SOURCE, "raycast", **textures.options)(
            tiles * TILE * TILE,
            **textures.arguments,
            **(leaps if scene.leap else {**leaps, "leap": 0}),
            camera=device.put(camera),
            perspective=rays.perspective,
            width=width,
            height=height,
            offset=shown,
            light=rays.light(),
            colour=checked_colour(scene.colour),
            pixels=pixels,
            local=TILE * TILE,
        )
        return pixels.take().reshape(height, width, 4)


def _leaps(field: DistanceField, device: Device) -> dict[str, Any]:
    """Return the kernel's arguments for skipping empty space, by name."""
    refined = refined_children(field)
    limit = min(field.lipschitz, STEEPEST)
    return {
        "refined": device.put(refined),
        "room": device.put(room(field, steep_leaves(field, refined, limit))),
        "leap": SAFETY / limit if limit > 0 else 0,
    }


def checked_offset(field: DistanceField, offset: float) -> float:
    """Return the distance drawn for an offset, world units; raise VoxtoolError if not finite.

    For an unsigned field, offset 0 draws least_shown, since hardly any of its values is 0."""
    if not math.isfinite(offset):
        raise VoxtoolError(f"an offset of {offset}: give a finite distance")
    return offset or (least_shown(field) if field.sign == "none" else 0.0)


def local_offset(field: DistanceField, offset: float) -> float:
    """Return the distance drawn for an offset, in sides; at most FAR, where there is no surface."""
    return min(max(checked_offset(field, offset) / field.side, -FAR), FAR)


def least_shown(field: DistanceField) -> float:
    """Return the distance drawn in place of 0 in an unsigned field, world units: half of the edge
    of the deepest leaves, the largest interpolated value on a flat sheet, or the tolerance if
    larger. A smaller distance would leave holes."""
    return field.side * max(0.5 ** (field.depth + 1), field.tolerance)


def refined_children(field: DistanceField) -> np.ndarray:
    """Return which children of each block have blocks, (n,) uint8; bit x + 2 y + 4 z is a child."""
    blocks = field.blocks
    one = blocks.dtype.type
    refined = np.zeros(len(blocks), np.uint8)
    parents = np.searchsorted(blocks, blocks[1:] >> one(3))
    np.bitwise_or.at(refined, parents, np.uint8(1) << (blocks[1:] & one(7)).astype(np.uint8))
    return refined


def steep_leaves(
    field: DistanceField, refined: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the leaves in which the field may exceed a slope: (k,) levels and (k, 3) cells.

    A leaf's slope is at most that of the steepest of its edges along each axis.
    """
    squares = np.zeros((len(field.voxels), 2, 2, 2), np.float32)
    for axis in (1, 2, 3):
        steps = np.abs(np.diff(field.voxels, axis=axis))
        for other in {1, 2, 3} - {axis}:
            first, last = np.split(np.take(steps, [0, 1, 1, 2], axis=other), 2, axis=other)
            steps = np.maximum(first, last)
        squares += steps * steps
    levels, cells = cell_of(field.blocks)
    leaves = np.unpackbits(refined, bitorder="little").reshape(-1, 2, 2, 2) == 0
    edges = np.ldexp(1.0, -levels - 1)[:, None, None, None]
    steep = np.sqrt(squares) > limit * (1 + 1e-6) * edges
    block, z, y, x = np.nonzero(leaves & steep)
    return levels[block] + 1, 2 * cells[block] + np.stack([x, y, z], axis=1)


def room(field: DistanceField, steep: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the least distance from each cell of ROOM_LEVEL to a steep leaf, in edges of a cell,
    (n, n, n) uint8, [z, y, x]; 0 everywhere for fields with cracks."""
    levels, cells = steep
    near = np.zeros((1, 1, 1), bool)
    for level in range(1, ROOM_LEVEL + 1):
        near = near.repeat(2, 0).repeat(2, 1).repeat(2, 2)
        here = levels == level if level < ROOM_LEVEL else levels >= level
        x, y, z = (cells[here] >> (levels[here] - level)[:, None]).T
        near[z, y, x] = True
    edges = np.zeros(near.shape, np.uint8)
    for _ in range(len(near) if field.continuous else 0):
        for axis in range(3):  # by one cell
            along = np.moveaxis(near, axis, 0)
            wide = along.copy()
            wide[1:] |= along[:-1]
            wide[:-1] |= along[1:]
            near = np.moveaxis(wide, 0, axis)
        edges += ~near
    return edges
