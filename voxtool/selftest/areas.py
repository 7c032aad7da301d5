"""The surface's area in each voxel: of stiff meshes the sum, beside that of the triangles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import FIXED_POINT_BITS, Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.colours import plan_attributes
from voxtool.svo.voxelization.voxelize import plan_voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

UNIT = 1 << FIXED_POINT_BITS


@case("areas of voxels", "faces on voxel faces, slivers, 1e12, 1e-12: area of the triangles",
      "relative", 1e-6)  # fmt: skip
def areas(device: Device, full: bool) -> float:
    sides = UNIT * (200 if full else 50)
    on_faces = shapes.box(np.full(3, UNIT), np.full(3, sides))
    sliver = shapes.box(np.full(3, UNIT), np.array([UNIT + 1, sides, UNIT + 3]))
    ball, faces = shapes.ball(2)
    round_ = np.rint((np.asarray(ball, np.float64) * 0.45 + 0.5) * sides).astype(np.int64), faces
    errors = []
    for corners, triangles in (on_faces, sliver, round_):
        a, b, c = np.moveaxis(np.asarray(corners, np.float64)[triangles], 1, 0) / UNIT
        exact = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        for scale in (1.0, 1e12, 1e-12):
            mesh = mesh_from_arrays(np.asarray(corners, np.float64) / UNIT * scale, triangles)
            n = sides // UNIT + 1
            grid = Grid((n, n, n), (0.0, 0.0, 0.0), (scale, scale, scale))
            surface = plan_voxelize(mesh, grid, "surface26", device=device)
            octree = plan_attributes(surface, mesh, ("area",)).run()
            found = octree.attribute("area").values.sum(dtype=np.float64)
            errors.append(abs(found / (exact * scale**2) - 1))
    return max(errors)


CASES = (areas,)
