"""Voxels that go out to other programs' formats and come back, without a disk."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from voxtool.files import npz
from voxtool.files.voxels import Rule, octree_of
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.morton import morton_encode
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.image import VoxelImage
from voxtool.svo.octree import Octree
from voxtool.svo.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

DIM = 256


@case("exports and imports", "none, corners at dim 256, a ball: what comes back", "voxels wrong", 0)
def round_trips(device: Device, full: bool) -> int:
    """The voxels as a list, those that are not set as the complement of it, and the sum of the
    counts of coarse cells."""
    corners = (DIM - 1) * np.indices((2, 2, 2)).reshape(3, 8).T
    grid = Grid((DIM, DIM, DIM), (-1.5, 0.1, 1e-3), (0.1, 0.3, 0.7))
    octrees = [Octree.from_voxels(some, grid) for some in (corners[:0], corners[-1:], corners)]
    ball = mesh_from_arrays(*shapes.ball(2))
    octrees.append(voxelize(ball, Grid.fit(ball, 100 if full else 50), device=device))
    wrong = 0
    for octree in octrees:
        back = returned(VoxelImage.of(octree))
        wrong += back.grid != octree.grid or differing(back, octree)
        for level in range(1, octree.depth + 2):
            image = VoxelImage.of(octree, level=level, dtype="float64")
            shares = sum(float(values.sum()) for _, values in image.listed())
            wrong += abs(int(shares * image.most) - octree.count)
    ball_voxels = octrees[-1]
    outside = returned(VoxelImage.of(ball_voxels, invert=True))
    wrong += differing(returned(VoxelImage.of(outside, invert=True)), ball_voxels)
    return int(wrong)


def returned(image: VoxelImage) -> Octree:
    """The octree of the list of an image's cells."""
    file = io.BytesIO()
    npz.write(image, file)
    file.seek(0)
    return octree_of(npz.read(file, file.getbuffer().nbytes), Rule())


def differing(one: Octree, other: Octree) -> int:
    """The number of voxels that only one of two octrees has."""
    return len(np.setxor1d(morton_encode(one.occupied()), morton_encode(other.occupied())))


CASES = (round_trips,)
