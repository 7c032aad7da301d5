"""Labels of parts that touch: faces that two parts share, where no voxel may be lost or doubled;
and the meshes of labels."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from voxtool.choices import LABEL_STYLES, VOXEL_FACES
from voxtool.grid import Grid
from voxtool.mesh.joining import join
from voxtool.mesh.mesh import Mesh
from voxtool.mesh.topology import closed_chain
from voxtool.selftest import shapes
from voxtool.selftest.case import case
from voxtool.svo.attribution.labels import plan_labels
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS
from voxtool.svo.octree.octree import Octree
from voxtool.svo.surface.isosurface import LATTICE, LATTICE_BITS
from voxtool.svo.surface.labelled import plan_labelled

if TYPE_CHECKING:
    from voxtool.opencl import Device

SIDE = 5  # cubes along a side
LABELS = 300


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


@case("meshes of labels", "300 labels of one or two voxels that touch at edges, and a chessboard",
      "faces wrong", 0)  # fmt: skip
def meshes_of_labels(device: Device, full: bool) -> int:
    """Each label has a closed mesh with the faces and, in sixths, the volume of its voxels, by a
    dense array; vertices of surface nets stay within half a voxel of their cells' middle."""
    random, wrong = np.random.default_rng(5), 0
    side = 40 if full else 12
    shape = (side, side - 1, side - 3)
    crowd = np.where(random.random(shape) < 0.5, random.integers(0, LABELS, shape), -1)
    board = np.indices(shape).sum(axis=0) % 2
    for labels in (crowd, board, np.where(board == 1, 0, -1)):
        octree = labelled(labels)
        for style in LABEL_STYLES:
            surface = plan_labelled(octree, style=style).run()
            expected = faces_of_labels(labels)
            corners = surface.points[surface.faces].astype(np.int64)
            if style == VOXEL_FACES:
                corners >>= LATTICE_BITS
                a, b, c = np.moveaxis(corners, 1, 0)
                six = (a * np.cross(b, c)).sum(axis=1)
                volumes = [np.bincount(side[side >= 0], six[side >= 0], LABELS)
                           for side in surface.sides.T]  # fmt: skip
                set_ = np.bincount(labels[labels >= 0], minlength=LABELS)
                wrong += int(np.abs(volumes[0] - volumes[1] - 6 * set_).sum())
            else:
                from_corner = surface.points - corner_of_cell(surface.points)
                wrong += int(np.count_nonzero(np.abs(from_corner) >= LATTICE // 2))
            wrong += int(np.abs(surface.triangles - 2 * expected).sum())
            wrong += sum(not closed_chain(mesh) for mesh in surface.meshes())
    return wrong


def labelled(labels: np.ndarray) -> Octree:
    """Return the octree of bricks with the labels of a dense array; -1 where no voxel is set."""
    octree = replace(Octree.from_dense(labels >= 0, mode="surface26"), mode="solid")
    padded = np.pad(labels, [(0, -n % BRICK_SIDE) for n in labels.shape], constant_values=-1)
    kept = np.flatnonzero(octree.bricks)
    cells = octree.levels()[-1].cells[kept][:, None] + BRICK_VOXELS
    values = padded[tuple(np.moveaxis(cells, 2, 0))]
    names = tuple(map(str, range(LABELS)))
    label = Attribute("label", values[values >= 0].astype("u2"), np.empty(0, "u2"), names=names)
    return replace(octree, attributes=(label,))


def faces_of_labels(labels: np.ndarray) -> np.ndarray:
    """Return the faces of each label's voxels to other labels and to unset voxels."""
    around, count = np.pad(labels, 1, constant_values=-1), np.zeros(LABELS, np.int64)
    for axis in range(3):
        for step in (1, -1):
            differ = (around != np.roll(around, step, axis)) & (around >= 0)
            count += np.bincount(around[differ], minlength=LABELS)
    return count


def corner_of_cell(points: np.ndarray) -> np.ndarray:
    """Return the corner of voxels in the middle of the cell of each point."""
    return (points + LATTICE // 2) >> LATTICE_BITS << LATTICE_BITS


CASES = (cubes_that_share_faces, meshes_of_labels)
