"""Surfaces of few voxels in the largest grids."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import MARCHING_CUBES, MAX_DIM, SURFACE_NETS, VOXEL_FACES
from voxtool.grid import Grid
from voxtool.selftest.case import case
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.extract import extract

if TYPE_CHECKING:
    from voxtool.opencl import Device

SMALL = 16
PLACES = ((0, 0, 0), (MAX_DIM - SMALL,) * 3, (MAX_DIM // 2 - 8, 0, MAX_DIM - SMALL))


@case("surfaces at dim 65536", "random voxels in corners and across a middle: those at dim 16",
      "wrong", 0)  # fmt: skip
def surfaces(device: Device, full: bool) -> int:
    """Surfaces that are not those of the same voxels in a small grid, moved."""
    random, wrong = np.random.default_rng(11), 0
    for style in (SURFACE_NETS, MARCHING_CUBES, VOXEL_FACES):
        for share in (0.0, 0.2, 0.5) if full else (0.0, 0.2):
            voxels = np.argwhere(random.random((SMALL,) * 3) < share)
            voxels = voxels if len(voxels) else np.array([[3, 0, SMALL - 1]])
            near = triangles(voxels, SMALL, style, device)
            for place in PLACES:
                far = triangles(voxels + place, MAX_DIM, style, device) - place
                wrong += not np.array_equal(far, near)
    return wrong


def triangles(voxels: np.ndarray, dim: int, style: str, device: Device) -> np.ndarray:
    """Return the corners of the triangles around voxels, (n, 3, 3), in an order that they decide:
    each begins with its first corner along x, then y, then z."""
    octree = Octree.from_voxels(voxels, Grid((dim, dim, dim), (0, 0, 0), (1, 1, 1)))
    surface = extract(octree, style=style, device=device)
    vertices, order = np.unique(surface.vertices, axis=0, return_inverse=True)
    faces = order.reshape(-1)[surface.faces]
    turns = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turns, axis=1)
    return vertices[faces[np.lexsort(faces.T[::-1])]]
