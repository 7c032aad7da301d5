"""Ray casting of the surface of a field, or of an offset surface at a distance from it.

A ray visits, in order, the leaves whose corners are not all on the side of the surface where it
starts. Whole subtrees without such leaves are skipped: each block has a bit for each of its
children, made for the offset. In a leaf the field along the ray is a cubic, whose first root is
computed [Marmitt 2004], so thin features are not missed: the picture shows the first point at which
the field equals the offset. Children of a block are found by the number of the first, as blocks are
in the order of their cells; no hash is needed.

With a search, a ray goes instead from each leaf to the next, which it finds by the hash [ADF,
section 3.4]. It visits the same leaves at the same times, so the picture is the same, bit for bit.

Rays of neighbouring pixels visit the tree together (kernels/packets.h), which does not show in the
picture.

A ray that starts inside shows the surface from inside. Nothing is drawn outside the cube: surfaces
that leave it are open there. An offset beyond the field's values draws nothing.

Kernels: kernels/adf/pictures/raycast.cl.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from voxtool.adf.field.field import FAR
from voxtool.adf.queries.textures import constant_of, textures_of, voxels_of
from voxtool.camera import checked_colour
from voxtool.errors import VoxtoolError
from voxtool.opencl import program

if TYPE_CHECKING:
    from collections.abc import Callable

    from voxtool.adf.field.field import DistanceField
    from voxtool.adf.pictures.scene import FieldScene
    from voxtool.camera import Rays
    from voxtool.opencl import Array, Device

SOURCE = "adf/pictures/raycast.cl"
COLOUR = (0.86, 0.82, 0.76)  # a warm light grey
TILE = 8  # a work-group draws TILE x TILE packets of rays
NODE_BYTES = 8  # bytes of a block's children and their bits
OUTER, INNER = 8, 16  # the first bit of those for rays that start outside, and inside

HEADERS = {"adf/pictures/raycast.h": program.c_constants(TILE=TILE, OUTER=OUTER, INNER=INNER)}


def cast(scene: FieldScene, rays: Rays, device: Device) -> np.ndarray:
    """Return the picture of a scene along rays in the world: (height, width, 4) float32,
    premultiplied colour, and opacity, which is 1 on the surface.

    The field, and the bits of its blocks for the offset, stay on the device for the next picture.
    """
    field = scene.content
    shown, lanes = local_offset(field, scene.offset), scene.lanes or device.lanes
    mark = device.kernel(SOURCE, "mark_children", LANES=lanes)
    tables, options = {}, {}
    if scene.search:
        lanes = 1
        found, taken = textures_of(field, device), ("full", "voxels")
        options = {"SEARCH": constant_of(scene.search), "BATCH": 1, **found.options}
        tables = {name: each for name, each in found.arguments.items() if name not in taken}
    draw = device.kernel(SOURCE, "raycast", LANES=lanes, **options)
    nodes = device.keep(
        field, f"nodes at {shown!r}", NODE_BYTES * len(field.blocks),
        lambda: _marked(field, shown, device, mark),
    )  # fmt: skip
    local = scene.local_rays(rays)
    camera = np.concatenate([local.origin, local.direction, local.right, local.down])
    width, height = rays.size
    pixels = device.empty(4 * width * height, np.float32)
    side = TILE * math.isqrt(lanes)  # pixels along a side of a work-group's tile
    with device.stage("ray casting"):
        draw(
            -(-width // side) * -(-height // side) * TILE**2,
            voxels=voxels_of(field, device),
            nodes=nodes,
            root=field.depth,
            camera=device.put(camera),
            perspective=rays.perspective,
            width=width,
            height=height,
            offset=shown,
            light=rays.light(),
            colour=checked_colour(scene.colour),
            pixels=pixels,
            **tables,
            local=TILE**2,
        )
        return pixels.take().reshape(height, width, 4)


def _marked(
    field: DistanceField, offset: float, device: Device, mark: Callable[..., None]
) -> Array:
    """Return the first child and the bits of each block, for an offset in sides: (n, 2) uint32 on
    the device. Children are marked before their parents."""
    refined = refined_children(field)
    children = np.cumsum(np.bitwise_count(refined), dtype=np.uint32)
    nodes = np.stack([1 + children - np.bitwise_count(refined), refined], axis=1)
    found, ends = device.put(nodes.astype(np.uint32)), np.cumsum(field.cells_by_level()).tolist()
    with device.stage("marking"):
        for first, end in reversed(list(itertools.pairwise([0, *ends]))):
            mark(end - first, voxels_of(field, device), offset, first, nodes=found)
    return found


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
