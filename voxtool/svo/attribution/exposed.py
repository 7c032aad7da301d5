"""Exposed voxels: set ones that share a face, an edge or a corner with an unset one, or with the
outside of the grid. They are seen in pictures, so they have values, whether the surface meets them
or not (nearest_surface.py).

They are the set without its erosion by a cube. An inside leaf that holds some is refined down to
the bricks that do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from voxtool.morton import among, distinct, morton_decode, morton_encode
from voxtool.opencl import Device
from voxtool.svo.attribution.nearest_surface import NearestSurface
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.layout import (
    AT_ONCE,
    BRICK,
    BRICK_BYTES,
    BRICK_SIDE,
    BRICK_VOXELS,
    descend,
    held_in,
    pack_voxels,
    unpack_bits,
    voxels_within,
)
from voxtool.svo.octree.links import FULL, REFINED, states_of
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS
from voxtool.svo.sets.morphology import Element, batch_of, erode
from voxtool.svo.sets.tiling import LEVEL, Box, Tiling

Bricks = tuple[np.ndarray, np.ndarray]  # Morton codes of bricks, ascending, and their masks
TILE_COPIES = 4  # of the bricks that are eroded
UNSEEN = "area"  # what the surface has in a voxel: 0 where it does not meet it


def exposed_bytes(bricks: int) -> int:
    """Return the predicted bytes, on the device and on the host, of finding the exposed voxels of
    an octree with this number of bricks."""
    return TILE_COPIES * BRICK_BYTES * bricks


def exposed_voxels(
    octree: Octree, low: np.ndarray, shape: np.ndarray, device: Device, max_memory: int | None
) -> Bricks:
    """Return the exposed voxels of a box of an octree, counted from the box's low corner; `low` is
    the corner, in voxels."""
    box, cube = Box(low, low + shape), Element.of("cube", 1.0, (1.0, 1.0, 1.0))
    voxels = Tiling.of(octree, 1)
    inner = erode(device, voxels, cube, batch_of(cube, len(voxels.codes), max_memory), box)
    tiles = distinct(np.concatenate([voxels.codes, inner.codes]))
    tiles = tiles[voxels.within(tiles, box)]
    masks = (voxels.bricks_of(tiles) & ~inner.bricks_of(tiles)).ravel()
    held = np.flatnonzero(masks)
    cells = morton_decode(descend(tiles, LEVEL)[held]) - voxels.corner // BRICK_SIDE
    if (low % BRICK_SIDE).any():
        brick, bit = bits_of(masks[held])
        found = BRICK_SIDE * cells[brick] + BRICK_VOXELS[bit] - low
        return pack_voxels(found[((found >= 0) & (found < shape)).all(axis=1)])
    cells -= low // BRICK_SIDE
    x, y, z = shape.tolist()
    masks = masks[held] & voxels_within(cells, (x, y, z))
    own = np.flatnonzero((cells >= 0).all(axis=1) & (masks != 0))
    codes = morton_encode(cells[own])
    order = np.argsort(codes)
    return codes[order], masks[own][order]


def with_exposed(
    octree: Octree, exposed: Bricks, surface: NearestSurface, low: np.ndarray, names: Sequence[str]
) -> Octree:
    """Return an octree with values of its exposed voxels: those that the surface does not meet have
    those of its nearest point.

    Parameters
    ----------
    octree : Octree
        An octree with attributes of the voxels that the surface meets.
    low : (3,) int
        The octree's low corner in the grid of the surface, in voxels.
    names : sequence of str
        Names of the surface's attributes.
    """
    seen = [name for name in names if name != UNSEEN]
    if not seen:
        return octree
    octree, codes = refined(octree, exposed[0])
    masks = np.zeros(len(octree.bricks), BRICK)
    masks[np.searchsorted(codes, exposed[0])] = exposed[1]
    bare = masks & ~octree.attribute(seen[0]).held(octree.bricks)
    brick, bit = bits_of(bare)
    if not len(brick):
        return octree
    voxels = low + BRICK_SIDE * morton_decode(codes[brick]) + BRICK_VOXELS[bit]
    values = surface.values(seen, voxels)
    more = (
        _merged(one, octree.bricks, bare, values[one.name]) if one.name in values else one
        for one in octree.attributes
    )
    return replace(octree, attributes=tuple(more))


def bits_of(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the brick and the bit of each voxel of some masks."""
    bricks = np.flatnonzero(masks)
    parts = [np.empty((2, 0), np.int64)]
    for first in range(0, len(bricks), AT_ONCE):
        row, bit = np.nonzero(unpack_bits(masks[bricks[first : first + AT_ONCE]]))
        parts.append(np.stack([bricks[first + row], bit]))
    brick, bit = np.concatenate(parts, axis=1)
    return brick, bit


def _merged(
    attribute: Attribute, bricks: np.ndarray, bare: np.ndarray, values: np.ndarray
) -> Attribute:
    """Return an attribute with values of more voxels, which had none."""
    held = attribute.held(bricks) | bare
    added = held_in(held, bare)
    found = np.empty((len(added), *values.shape[1:]), values.dtype)
    found[added], found[~added] = values, attribute.values
    return replace(attribute, values=found, masks=held)


def refined(octree: Octree, bricks: np.ndarray) -> tuple[Octree, np.ndarray]:
    """Return an octree in which bricks, given by their ascending codes, are no part of a leaf, and
    the codes of all of its bricks."""
    levels = octree.levels()
    own = levels[-1].codes
    wanted = distinct(bricks[~among(own, bricks)] >> np.uint64(3))
    if not len(wanted):
        return octree, own
    states, kept, leaves = [], [], 0
    more, more_leaves = own[:0], np.empty(0, np.int64)  # nodes below leaves that are refined
    for level in levels[:-1]:
        codes = np.concatenate([level.codes, more])
        order = np.argsort(codes)
        codes = codes[order]
        state = np.concatenate(
            [states_of(level.nodes["child"]), np.full(len(more), FULL, np.uint8)]
        )
        leaf = np.cumsum(level.inside) - 1 + leaves
        leaf = np.concatenate([leaf, more_leaves])[order]
        leaves += int(level.inside.sum())
        state = state[order]
        holds = distinct(wanted >> np.uint64(3 * (level.number - 1)))
        split = (state == FULL) & among(holds, codes)
        more, more_leaves = descend(codes[split]), np.repeat(leaf[split], 8)
        state[split] = REFINED
        states.append(state)
        kept.append(leaf[state == FULL])
    places = np.searchsorted(own, more)
    masks = np.insert(octree.bricks, places, ALL_VOXELS)
    of_leaves = np.concatenate(kept)
    attributes = tuple(
        _with_bricks(one, octree.bricks, places, more_leaves, of_leaves)
        for one in octree.attributes
    )
    made = Octree.of_states(octree.grid, octree.mode, octree.fill, states, masks)
    described = {
        name: getattr(octree, name) for name in ("plan", "source_sha256", "units", "transform")
    }
    codes = np.insert(own, places, more)
    return replace(made, attributes=attributes, **described), codes


def _with_bricks(
    attribute: Attribute, bricks: np.ndarray, places: np.ndarray, leaf_of: np.ndarray,
    leaves: np.ndarray,
) -> Attribute:  # fmt: skip
    """Return an attribute of an octree with more bricks, which were parts of leaves.

    Parameters
    ----------
    places, leaf_of : (n,) of each new brick, which old one it comes before, and its leaf.
    leaves : which of the old leaves each leaf is in.
    """
    if not len(attribute.leaves):  # all of them have the default
        return replace(attribute, masks=np.insert(attribute.held(bricks), places, BRICK.type(0)))
    starts = np.repeat(attribute.starts(bricks)[places], BRICK_SIDE**3)
    own = attribute.leaves[np.repeat(leaf_of, BRICK_SIDE**3)]
    values = np.insert(attribute.values, starts, own, axis=0)
    return replace(attribute, values=values, leaves=attribute.leaves[leaves])
