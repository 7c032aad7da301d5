"""Ray casting of the surface of a field, or of an offset surface at a distance from it.

A ray goes from leaf to leaf. In a leaf the field along the ray is a cubic, whose first root is
found [Marmitt 2004], so that nothing between two steps is missed, however thin: the picture shows
where the field first takes the value of the offset. From the far side of a leaf the ray leaps by
the least distance of the surface, (distance - offset) / the Lipschitz constant: sphere tracing
[Hart 1996]. This requires a field without cracks that is nowhere steeper. So rays do not leap into
steeper leaves: those where the sign jumps, which the stored constant excludes, and the few steeper
than STEEPEST, which would make all leaps short. A table stores how far these leaves are. In fields
with cracks rays do not leap.

A ray that begins inside sees the surface from inside. Nothing is shown outside the cube: surfaces
that leave it are open there. An offset beyond the field's values shows nothing.

Kernels: kernels/adf/raycast.cl.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.cells import cell_of
from voxtool.adf.field import FAR
from voxtool.adf.textures import textures_of
from voxtool.camera import checked_colour
from voxtool.errors import VoxtoolError
from voxtool.opencl import default_device, program

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.adf.field import DistanceField
    from voxtool.camera import Rays
    from voxtool.opencl import Device

SOURCE = "adf/raycast.cl"
COLOUR = (0.86, 0.82, 0.76)  # a warm light grey
STEEPEST = math.sqrt(3)  # that an interpolation of exact distances of one sign is
SAFETY = 1 - 2.0**-10  # of leaps, for rounding
ROOM_LEVEL = 5  # of the cells that tell how far steep leaves are
TILE = 8  # pixels along a side of those that a work-group takes

HEADERS = {"adf/raycast.h": program.c_constants(ROOM_LEVEL=ROOM_LEVEL, TILE=TILE)}


def cast(
    field: DistanceField,
    rays: Rays,
    *,
    offset: float = 0.0,
    colour: Sequence[float] = COLOUR,
    leap: bool = True,
    device: Device | None = None,
) -> np.ndarray:
    """The picture that rays in the world give of a field's surface.

    The field stays on the device for the next picture.

    Parameters
    ----------
    offset : the distance that the surface shown has, world units; it is rounded to float32. Of an
        unsigned field, which is nowhere negative and hardly anywhere 0, offset 0 shows the distance
        least_shown.
    colour : red, green and blue of the surface, from 0 to 1.
    leap : whether rays leap as far as the distance allows; the picture is the same but for
        rounding.

    Returns
    -------
    (height, width, 4) float32: premultiplied colour, and opacity: 1 where the surface is.

    Raises
    ------
    DeviceError : there is no device.
    VoxtoolError : an offset or a colour that is none.
    MemoryLimitError : the field or the picture does not fit on the device.
    """
    device = device or default_device()
    colour = checked_colour(colour)
    shown = min(max(checked_offset(field, offset) / field.side, -FAR), FAR)
    textures = textures_of(field, device)
    leaps = device.keep(field, "leaps", len(field.blocks), lambda: _leaps(field, device))
    local = rays.local(field.origin, field.side)
    camera = np.concatenate([local.origin, local.direction, local.right, local.down])
    width, height = rays.size
    pixels = device.empty(4 * width * height, np.float32)
    tiles = -(-width // TILE) * -(-height // TILE)
    with device.stage("ray casting"):
        device.kernel(SOURCE, "raycast", **textures.options)(
            tiles * TILE * TILE,
            **textures.arguments,
            **leaps if leap else {**leaps, "leap": 0},
            camera=device.put(camera),
            perspective=rays.perspective,
            width=width,
            height=height,
            offset=shown,
            light=rays.light(),
            colour=colour,
            pixels=pixels,
            local=TILE * TILE,
        )
        return pixels.take().reshape(height, width, 4)


def _leaps(field: DistanceField, device: Device) -> dict[str, Any]:
    """What lets rays leap: arguments of the kernel, by name."""
    refined = refined_children(field)
    limit = min(field.lipschitz, STEEPEST)
    return {
        "refined": device.put(refined),
        "room": device.put(room(field, steep_leaves(field, refined, limit))),
        "leap": SAFETY / limit if limit > 0 else 0,
    }


def checked_offset(field: DistanceField, offset: float) -> float:
    """The distance that is shown for an offset, world units.

    Raises
    ------
    VoxtoolError : it is not finite.
    """
    if not math.isfinite(offset):
        raise VoxtoolError(f"an offset of {offset}: give a finite distance")
    return offset or (least_shown(field) if field.sign == "none" else 0.0)


def least_shown(field: DistanceField) -> float:
    """The distance that stands for 0 in a field without signs, world units: half of the edge of the
    deepest leaves, which is the most that is interpolated on a flat sheet, or the tolerance if that
    is more. Thinner, sheets would have holes."""
    return field.side * max(0.5 ** (field.depth + 1), field.tolerance)


def refined_children(field: DistanceField) -> np.ndarray:
    """(n,) uint8: of each block which children have blocks; child x + 2 y + 4 z is bit 2**that."""
    blocks = field.blocks
    one = blocks.dtype.type
    refined = np.zeros(len(blocks), np.uint8)
    parents = np.searchsorted(blocks, blocks[1:] >> one(3))
    np.bitwise_or.at(refined, parents, np.uint8(1) << (blocks[1:] & one(7)).astype(np.uint8))
    return refined


def steep_leaves(
    field: DistanceField, refined: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """The leaves in which the field may be steeper than a limit: (k,) levels and (k, 3) cells.

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
    """(n, n, n) uint8, [z, y, x], of the cells of ROOM_LEVEL: how many of their edges away from
    them steep leaves are, at least; 0 everywhere where neighbours do not agree."""
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
