"""Solids of wires that are thinner than a voxel, far from the origin."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.sets.labels import plan_components
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

SIDE = 4096
TURN = np.array([(2, -1, 2), (2, 2, -1), (-1, 2, 2)]) / 3  # a rotation


@case("connected", "turned frames of wire 1/8 voxel thick at dim 4096: components and Euler number",
      "wrong", 0)  # fmt: skip
def frames(device: Device, full: bool) -> int:
    """A frame is one component with one tunnel."""
    wrong = 0
    for half in (9.0, 14.3, 27.7, 40.1) if full else (14.3,):
        ends = np.array([half, half, 0]) + 1 / 16
        bars = []
        for axis, side in product((0, 1), (-1, 1)):
            low, high = -ends, ends.copy()
            (low if side > 0 else high)[axis] += side * (2 * half)
            bars.append(shapes.box(low, high))
        vertices, faces = shapes.join(*bars)
        turned = sum(vertices[:, axis, None] * TURN[:, axis] for axis in range(3))
        mesh = mesh_from_arrays(turned + (SIDE - 70.3), faces)
        grid = Grid((SIDE, SIDE, SIDE), (0, 0, 0), (1, 1, 1))
        octree = voxelize(mesh, grid, fill="nonzero", connected=True, device=device)
        components = plan_components(octree, neighbours=26).run().sizes
        wrong += abs(len(components) - 1) + abs(euler_number(octree.occupied()))
    return wrong


def euler_number(voxels: np.ndarray) -> int:
    """Return the corners less the edges plus the faces less the cubes of closed voxels, (n, 3)."""
    total = 0
    for cell in product((0, 1), repeat=3):
        ends = [np.array([0] if open_ else [0, 1]) for open_ in cell]
        steps = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, 3)
        cells = (voxels[:, None] + steps).reshape(-1, 3)
        total += (-1) ** sum(cell) * len(np.unique(cells, axis=0))
    return total
