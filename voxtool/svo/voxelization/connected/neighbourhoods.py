"""Neighbourhoods of 3 x 3 x 3 voxels as masks of 27 bits, and what a voxel does in them.

Set voxels are 26-connected, unset ones 6-connected. A set voxel is simple if removing it changes no
component, tunnel or cavity of either: its set 26-neighbours are one component, and so are the unset
voxels among its 18 neighbours that reach one of its faces [Bertrand 1994]. It separates if these
unset voxels are more than one component, as inside a sheet.

Bit 13 is the voxel itself; bits count along x, then y, then z.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

STEPS = np.array([(x, y, z) for z, y, x in product((-1, 0, 1), repeat=3)])
CENTRE = 13
BIT_OF = np.uint32(1) << np.arange(27, dtype=np.uint32)


def _mask(chosen: np.ndarray) -> np.uint32:
    return np.uint32(BIT_OF[chosen].sum())


_DISTANCE = np.abs(STEPS).sum(axis=1)
FACES, NEAR = _mask(_DISTANCE == 1), _mask((_DISTANCE > 0) & (_DISTANCE < 3))
OTHERS = _mask(_DISTANCE > 0)
# For each axis: the distance to the next bit along it, and the bits that have one above and below.
AXES = [
    (np.uint32(3**axis), _mask(STEPS[:, axis] < 1), _mask(STEPS[:, axis] > -1)) for axis in range(3)
]


def grown_26(masks: np.ndarray) -> np.ndarray:
    """Return masks with the 26-neighbours of their voxels."""
    for bits, above, below in AXES:
        masks = masks | (masks & above) << bits | (masks & below) >> bits
    return masks


def grown_6(masks: np.ndarray) -> np.ndarray:
    """Return masks with the 6-neighbours of their voxels."""
    found = masks
    for bits, above, below in AXES:
        found = found | (masks & above) << bits | (masks & below) >> bits
    return found


def component(
    masks: np.ndarray, seeds: np.ndarray, grown: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the component of each mask that holds the lowest bit of its seeds."""
    reached = seeds & (~seeds + np.uint32(1))
    while not np.array_equal(more := grown(reached) & masks, reached):
        reached = more
    return reached


def is_simple(masks: np.ndarray) -> np.ndarray:
    """Return which voxels are simple, (n,) bool."""
    others, outside = masks & OTHERS, ~masks & NEAR
    faces = outside & FACES
    whole = component(others, others, grown_26) == others
    single = component(outside, faces, grown_6) & FACES == faces
    return (others != 0) & (faces != 0) & whole & single


def separates(masks: np.ndarray) -> np.ndarray:
    """Return which voxels separate unset ones in their neighbourhoods, (n,) bool."""
    outside = ~masks & NEAR
    faces = outside & FACES
    return component(outside, faces, grown_6) & FACES != faces
