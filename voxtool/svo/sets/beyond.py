"""The part of a set of voxels that lies beyond a grid."""

from __future__ import annotations

import math

import numpy as np

from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, BRICK_VOXELS, INSIDE

FINEST = 1 << 20  # parts of a voxel, in which the ends of the grid are counted


def share_beyond(octree: OctreeContent, grid: Grid) -> float:
    """Return the share of the volume of set voxels that lies beyond a grid; 0 if none is set."""
    ratio = np.array(grid.pitch) / octree.grid.pitch
    low = (np.array(grid.origin) - octree.grid.origin) / octree.grid.pitch
    low, high = (np.rint(end * FINEST) / FINEST for end in (low, low + ratio * grid.shape))
    bounds = octree.bounds()
    if bounds is None or ((low <= bounds[0]).all() and (bounds[1] <= high).all()):
        return 0.0
    within: list[float] = []
    for span in octree.walk():
        side = BRICK_SIDE << span.number
        cells = side * morton_decode(span.codes)
        if span.number:
            held = (span.nodes["child"] & INSIDE) != 0
            within.append(math.fsum(_volumes(cells[held], side, low, high).tolist()))
            continue
        masks = octree.bricks[span.start : span.start + len(span.nodes)]
        inside = ((cells >= low) & (cells + side <= high)).all(axis=1)
        within.append(float(np.bitwise_count(masks[inside]).sum(dtype=np.int64)))
        cut = ~inside & ((cells < high) & (cells + side > low)).all(axis=1)
        for number, place in enumerate(BRICK_VOXELS):
            some = cut & (masks >> BRICK.type(number) & BRICK.type(1) != 0)
            within.append(math.fsum(_volumes(cells[some] + place, 1, low, high).tolist()))
    return min(max(1 - math.fsum(within) / octree.count, 0.0), 1.0)


def _volumes(cells: np.ndarray, side: int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the volumes, in voxels, of the parts of cubes between two corners."""
    x, y, z = np.maximum(np.minimum(cells + side, high) - np.maximum(cells, low), 0.0).T
    return x * y * z
