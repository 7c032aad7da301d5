"""Voxels that go out to other programs' formats and come back, without a disk; fields of images."""

from __future__ import annotations

import io
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.construction.from_image import field_of_image
from voxtool.adf.queries.query import query_adf
from voxtool.files.cells import inp, msh, vtu
from voxtool.files.grids import npz
from voxtool.files.grids.voxels import Rule, octree_of
from voxtool.grid import Grid
from voxtool.mesh.mesh import mesh_from_arrays
from voxtool.morton import morton_encode
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.spatial.sampling import sample_cube
from voxtool.svo.images.image import VoxelImage
from voxtool.svo.octree.octree import Octree
from voxtool.svo.solvers.hexahedra import SIDES, Hexahedra
from voxtool.svo.solvers.leaf_hexahedra import LeafHexahedra
from voxtool.svo.voxelization.voxelize import voxelize

if TYPE_CHECKING:
    from voxtool.opencl import Device

DIM = 256
MOST = 1 << 30  # bytes of the largest cubes


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


@case("hexahedra", "a ball, what is around it, corners: their faces, files", "counts wrong", 0)
def hexahedra(device: Device, full: bool) -> int:
    """The hexahedra, by the sums of the places of faces on both sides along each axis; the voxels
    of the largest cubes; and the bytes that files were to have."""
    ball = mesh_from_arrays(*shapes.ball(2))
    octree = voxelize(ball, Grid.fit(ball, 100 if full else 50), device=device)
    corners = 49 * np.indices((2, 2, 2)).reshape(3, 8).T
    images = [VoxelImage.of(octree), VoxelImage.of(octree, invert=True)]
    images.append(VoxelImage.of(Octree.from_voxels(corners, octree.grid)))
    wrong = 0
    for image in images:
        mesh, sums = Hexahedra.of(image), np.zeros(len(SIDES), np.int64)
        layers: Any = mesh.layers()
        for layer in layers:
            y, z = np.divmod(layer.cells.keys.astype(np.int64), layer.width)
            places = (np.full(len(y), layer.x), y, z)
            for key, faces in layer.faces:
                sums[key.side] += np.sum(places[key.side // 2][faces] + key.side % 2)
        wrong += np.count_nonzero(sums[1::2] - sums[::2] != image.count)
        leaves = LeafHexahedra.of(image, limit=MOST)
        wrong += int((8 ** leaves.cubes.powers.astype(int)).sum()) != image.count
        for module, own in product((vtu, msh, inp), (mesh, leaves)):
            file = io.BytesIO()
            module.write(own, file)
            wrong += file.getbuffer().nbytes != module.size(own)
    return int(wrong)


def returned(image: VoxelImage) -> Octree:
    """Return the octree of the list of an image's cells."""
    file = io.BytesIO()
    npz.write(image, file)
    file.seek(0)
    return octree_of(npz.read(file, file.getbuffer().nbytes), Rule())


def differing(one: Octree, other: Octree) -> int:
    """Return the number of voxels that only one of two octrees has."""
    return len(np.setxor1d(morton_encode(one.occupied()), morton_encode(other.occupied())))


@case("fields of images", "noise in oblong voxels: its interpolation, numpy", "of the bound", 1)
def images(device: Device, full: bool) -> float:
    """Answers in leaves that the planes of samples cut, and beyond the samples."""
    grid = Grid((11, 9, 8), (-1.5, 0.1, 1e3), (0.1, 0.3, 0.7))
    values = np.random.default_rng(6).normal(size=grid.shape)
    field = field_of_image(values, grid, tolerance=1e-2, max_level=6 if full else 4, device=device)
    points = np.array(field.origin) + field.side * sample_cube(1 << (16 if full else 12))
    found = query_adf(field, points, bounds=True, device=device)
    at = ((points - grid.origin) / grid.pitch - 0.5).clip(0, np.array(grid.shape) - 1)
    low = np.minimum(at.astype(int), np.array(grid.shape) - 2)
    expected = np.zeros(len(points))
    for corner in np.indices((2, 2, 2)).reshape(3, 8).T:
        weights = np.where(corner, at - low, 1 - (at - low)).prod(axis=1)
        expected += weights * values[tuple((low + corner).T)]
    assert found.bound is not None
    return float((abs(found.distance - expected) / found.bound).max())


CASES = (round_trips, hexahedra, images)
