"""Boxes that overlap, contain one another and are inside out, as one mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.distances import plan_distance
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

SIDE = 48
CUBE = np.indices((2, 2, 2)).reshape(3, -1).T


@case("parts that overlap", "boxes, a third inside out, also 1e8 off: the union by their corners",
      "wrong", 0)  # fmt: skip
def unions(device: Device, full: bool) -> int:
    """Voxels, and signs of distances at their centres, that differ from the union of boxes."""
    random, wrong = np.random.default_rng(9), 0
    for offset in (0.0, 1e8):
        for _ in range(30 if full else 6):
            low = random.integers(2, SIDE - 8, (10, 3))
            high = np.minimum(low + random.integers(3, 30, (10, 3)), SIDE - 2)
            inward = random.random(10) < 1 / 3
            boxes = [
                (a + CUBE * (b - a) + offset + 0.25, shapes.BOX_FACES[:, :: 1 - 2 * turned])
                for a, b, turned in zip(low, high, inward.tolist(), strict=True)
            ]
            mesh = mesh_from_arrays(*shapes.join(*boxes))
            grid = Grid((SIDE, SIDE, SIDE), (offset, offset, offset), (1.0, 1.0, 1.0))
            expected = _union(low, high, inward)
            found = np.concatenate(list(VoxelImage.of(voxelize(mesh, grid, device=device)).slabs()))
            centres = grid.to_world(np.indices(grid.shape).reshape(3, -1).T + 0.5)
            distances = plan_distance(mesh, device=device).run()(centres).reshape(grid.shape)
            wrong += int(np.count_nonzero(found != expected))
            wrong += int(np.count_nonzero((distances < 0) != expected))
    return wrong


def _union(low: np.ndarray, high: np.ndarray, inward: np.ndarray) -> np.ndarray:
    """Return the voxels whose winding number is 1 or more, once each box is turned by the outermost
    one around it; faces lie a quarter of a voxel beyond whole numbers."""
    around = np.array(((low[:, None] <= low) & (high <= high[:, None])).all(axis=2))
    around &= ((low[:, None] < low) | (high < high[:, None])).any(axis=2)  # [outer, inner]
    volume = (high - low).prod(axis=1)
    number = np.zeros((SIDE,) * 3, np.int64)
    for box, (a, b) in enumerate(zip(low, high, strict=True)):
        root = box
        while around[:, root].any():
            outer = np.flatnonzero(around[:, root])
            root = int(outer[volume[outer].argmin()])
        way = 1 if inward[box] == inward[root] else -1
        number[a[0] : b[0], a[1] : b[1], a[2] : b[2]] += way
    return number >= 1
