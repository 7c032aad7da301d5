"""Exposed voxels of boxes that touch none of their voxels have the normal of the nearest side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.octree.attributes import BITS
from voxtool.svo.octree.layout import BRICK_VOXELS
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

UNIT = 1 << FIXED_POINT_BITS


@case("exposed voxels", "boxes that touch none of their voxels: normals of the nearest side",
      "voxels wrong", 0)  # fmt: skip
def boxes(device: Device, full: bool) -> int:
    """Sides lie between the centres of the last voxels outside and the cubes of the first inside;
    of sides that are equally near the first counts."""
    wrong = 0
    for first, last in ((8, 20), (5, 60 if full else 28)):
        low, high = np.array([first, 8, 16]) * UNIT - (70, 90, 100), np.full(3, last) * UNIT + 80
        corners, faces = shapes.box(low, high)
        n = last + 6
        grid = Grid((n, n, n), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        mesh = mesh_from_arrays(corners / UNIT, faces)
        octree = plan_attributes(
            plan_voxelize(mesh, grid, "solid", device=device), mesh, ("normal",)
        ).run()
        normal = octree.attribute("normal")
        brick, bit = np.nonzero((normal.held(octree.bricks)[:, None] & BITS) != 0)
        voxels = octree.levels()[-1].cells[brick] + BRICK_VOXELS[bit]
        shell = (voxels == (first, 8, 16)) | (voxels == last - 1)
        size = last - np.array([first, 8, 16])
        wrong += abs(len(voxels) - int(np.prod(size) - np.prod(size - 2)))
        wrong += int(np.count_nonzero(~shell.any(axis=1)))
        centres = voxels * UNIT + UNIT // 2
        apart = np.stack([centres - low, high - centres], axis=2).reshape(-1, 6)
        side = np.argmin(apart, axis=1)
        expected = np.zeros((len(voxels), 3))
        expected[np.arange(len(voxels)), side // 2] = 2 * (side % 2) - 1
        wrong += int(np.count_nonzero((normal.values != expected).any(axis=1)))
    return wrong


CASES = (boxes,)
