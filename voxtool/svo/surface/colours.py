"""The colours of a surface, from the colours of the voxels.

A cell is a sample of the surface: a voxel, or a node with the mean of its coloured voxels. It has
colour if one of its voxels has a colour of its own that is not wholly transparent.

A face of voxel faces has the colour of the cell behind it. A vertex of another style has the
trilinear interpolation, in linear light, of those of the eight cells around it that have colour.
Where there is none, both have the colour of the nearest coloured voxel. Weights are products of
whole numbers, and sums have one order, so colours are the same everywhere.
"""

from __future__ import annotations

import numpy as np

from voxtool.choices import VOXEL_FACES
from voxtool.mesh import srgb
from voxtool.morton import morton_encode
from voxtool.opencl import Device
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.octree.attributes import COLOUR
from voxtool.svo.octree.octree import Octree
from voxtool.svo.pictures.painting import part_of, values_of_cubes
from voxtool.svo.queries.query import OctreeQuery
from voxtool.svo.surface.isosurface import LATTICE, LATTICE_BITS, in_world

CHUNK = 1 << 17  # vertices or faces at once
CORNERS = np.indices((2, 2, 2)).reshape(3, -1).T


def surface_colours(
    octree: Octree,
    style: str,
    side: int,
    points: np.ndarray,
    faces: np.ndarray,
    device: Device | None,
    labels: np.ndarray | None = None,
) -> np.ndarray:
    """Return the colours of a surface, uint8 in sRGB and opacity: those of its vertices, (V, 4), or
    those of its triangles, (F, 4), if they are voxel faces.

    Parameters
    ----------
    octree : has the attribute.
    style, side, points, faces : as those of an Isosurface.
    labels : (V,), the label of the voxels that give each vertex its colour; None: all do.
    """
    cells = _Cells(octree, side, device)
    rows = faces if style == VOXEL_FACES else points
    found = np.empty((len(rows), 4), np.uint8)
    for first in range(0, len(rows), CHUNK):
        part = slice(first, first + CHUNK)
        if style == VOXEL_FACES:
            found[part] = cells.behind(points[faces[part]])
        else:
            found[part] = cells.around(points[part], None if labels is None else labels[part])
    return found


class _Cells:
    """The cells of an octree whose voxels have colours."""

    def __init__(self, octree: Octree, side: int, device: Device | None) -> None:
        colour = octree.attribute(COLOUR)
        inside = sum(int(level.inside.sum()) for level in octree.levels() if level.number)
        leaves = np.full(inside, len(colour.leaves) > 0 or colour.masks is None)
        self.coloured = part_of(octree, colour.held(octree.bricks), leaves)
        self.size, self.side, self.device = side.bit_length() - 1, side, device
        self.values = CellValues(self.coloured, COLOUR, self.size)
        self.blank = colour.blank

    def of(self, cells: np.ndarray, values: CellValues | None = None) -> np.ndarray:
        """Return the colours of cells, (..., 4), or other values of theirs; 0 of those without."""
        values = values or self.values
        within = (cells >= 0).all(axis=-1)
        distinct, places = np.unique(morton_encode(cells[within]), return_inverse=True)
        found = np.zeros((*within.shape, *values.row), values.dtype)
        found[within] = values_of_cubes(values, distinct, self.size)[places.ravel()]
        return found

    def behind(self, corners: np.ndarray) -> np.ndarray:
        """Return the colours of triangles of voxel faces, (n, 4), given their corners."""
        low, high = corners.min(axis=1), corners.max(axis=1)
        p, q = (corners[:, i] - corners[:, 0] >> LATTICE_BITS for i in (1, 2))
        outward = np.cross(p, q)
        found = self.of((low >> LATTICE_BITS) - (outward > 0))
        return self._filled(found, found[:, 3] > 0, (low + high) / 2)

    def around(self, points: np.ndarray, labels: np.ndarray | None) -> np.ndarray:
        """Return the colours of vertices, (n, 4)."""
        cells, rest = np.divmod(points.astype(np.int64) - LATTICE // 2, LATTICE)
        values = self.of(cells[:, None] + CORNERS)
        weights = np.where(CORNERS, rest[:, None], LATTICE - rest[:, None]).prod(axis=2)
        has = values[..., 3] > 0
        if labels is not None:
            of_voxels = CellValues(self.coloured, "label", self.size)
            has &= self.of(cells[:, None] + CORNERS, of_voxels) == labels[:, None]
        weights = np.where(has, weights, 0).astype(np.float64)
        total = weights.sum(axis=1)
        channels = np.concatenate([srgb.linear_table()[values[..., :3]], values[..., 3:]], axis=2)
        sums = sum(weights[:, i, None] * channels[:, i] for i in range(len(CORNERS)))
        means = sums / np.where(total > 0, total, 1.0)[:, None]
        found = np.empty((len(points), 4), np.uint8)
        found[:, :3] = srgb.to_levels(means[:, :3].astype(np.int64))
        found[:, 3] = (means[:, 3] + 0.5).astype(np.uint8)
        return self._filled(found, total > 0, points)

    def _filled(self, found: np.ndarray, has: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return colours, those of points that have none from their nearest coloured voxels."""
        without = np.flatnonzero(~has)
        if not len(without):
            return found
        if not self.coloured.count:
            found[without] = self.blank
            return found
        world = in_world(points[without], self.side, self.coloured.grid)
        nearest = OctreeQuery(self.coloured, device=self.device, nearest=True)(world).nearest
        assert nearest is not None
        codes, places = np.unique(morton_encode(nearest), return_inverse=True)
        voxels = CellValues(self.coloured, COLOUR, 0)
        found[without] = values_of_cubes(voxels, codes, 0)[places.ravel()]
        return found
