"""Labels of parts that touch: faces that two parts share, where no voxel may be lost or doubled."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.grid import Grid
from voxtool.mesh.joining import join
from voxtool.mesh.mesh import Mesh
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.labels import plan_labels

if TYPE_CHECKING:
    from voxtool.opencl import Device

SIDE = 5  # cubes along a side


@case("labels", "125 cubes that share faces, on voxel faces and through centres: each voxel once",
      "voxels wrong", 0)  # fmt: skip
def cubes_that_share_faces(device: Device, full: bool) -> int:
    """Cubes of whole and of half voxels, moved by whole and half voxels: those of a solid hold as
    many voxels each, all together those of the block."""
    wrong = 0
    for size, moved in product((8, 12), (0.0, 0.5)):
        scale = 8 if full else 1
        side = size * scale
        dim = SIDE * side + 4
        grid = Grid((dim, dim, dim), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        points, faces = shapes.box(np.zeros(3, int), np.ones(3, int))
        corners = 2 + moved + side * np.array(list(product(range(SIDE), repeat=3)))
        cubes = [Mesh(low + side * points, faces.astype(np.int32)) for low in corners]
        octree = plan_labels(join(cubes), grid, "solid", labels="file", device=device).run()
        label = octree.attribute("label")
        volumes = [level.side**3 for level in octree.levels() if level.number
                   for _ in range(np.count_nonzero(level.inside))]  # fmt: skip
        counts = np.bincount(label.values, minlength=len(cubes)).astype(np.float64)
        counts += np.bincount(label.leaves, weights=volumes, minlength=len(cubes))
        wrong += int(np.abs(counts - side**3).sum())
    return wrong


CASES = (cubes_that_share_faces,)
