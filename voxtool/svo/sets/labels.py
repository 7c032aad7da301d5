"""The connected components of a set of voxels, labelled and described: sizes, boxes and centres.

Labels are those of components.py: 1 is the largest component, 0 is unset. They are kept by piece, a
leaf or a connected part of a brick, and unpacked four layers at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar

import numpy as np

from voxtool.arrays import digest_of
from voxtool.choices import MAX_DIM, NEIGHBOURS
from voxtool.job import Job
from voxtool.memory import check_memory
from voxtool.morton import morton_decode
from voxtool.svo.images.blocks import Sorted
from voxtool.svo.images.image import EVERY
from voxtool.svo.images.slabs import Order
from voxtool.svo.octree.layout import BRICK_SIDE, BRICK_VOXELS, unpack_bricks
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.components import LABEL, Components, ComponentsPlan, check_neighbours
from voxtool.svo.sets.tiling import TILE, Tiling


def voxels_where(flags: np.ndarray) -> np.uint64:
    """Return the mask of the voxels of a brick whose flag in the (64,) bool array is set."""
    return np.packbits(flags, bitorder="little").view("<u8")[0]


@dataclass(frozen=True, eq=False)
class Labels:
    """The connected components of an octree, the largest first.

    Attributes
    ----------
    octree : Octree
        The voxels.
    neighbours : int
        6: voxels are connected across faces; 18: also across edges; 26: also across corners.
    sizes : (n,) int64
        The voxels of each component.
    boxes : (n, 2, 3) int64
        The lowest voxel of each along each axis, and the end of the highest one.
    centers : (n, 3) float64
        The centroid of each, in world units.
    """

    level: ClassVar[int] = 0
    quantity: ClassVar[str] = "label"
    smaller: ClassVar[str] = "a smaller dim"

    octree: Octree
    neighbours: int
    sizes: np.ndarray
    boxes: np.ndarray
    centers: np.ndarray
    _found: Components

    @classmethod
    def of(cls, octree: Octree, voxels: Tiling, neighbours: int) -> Labels:
        """Return the labels of an octree, which is given as tiles, too."""
        found = Components.of(voxels, neighbours)
        boxes, sums = _described(found)
        centers = octree.grid.to_world(sums / np.maximum(found.sizes, 1)[:, None] + 0.5)
        return cls(octree, neighbours, found.sizes, boxes, centers, found)

    def __len__(self) -> int:
        return len(self.sizes)

    def summary(self) -> dict[str, Any]:
        """Return the components in JSON types: `box` in voxels, all else in world units."""
        grid = self.octree.grid
        bounds = grid.to_world(self.boxes.reshape(-1, 3)).reshape(-1, 2, 3)
        columns = (self.sizes, self.centers, self.boxes, bounds)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return {
            "neighbours": self.neighbours,
            "count": len(self),
            "components": [
                {
                    "label": label,
                    "voxels": size,
                    "volume": size * grid.voxel_volume,
                    "center": center,
                    "box": box,
                    "bounds": ends,
                }
                for label, (size, center, box, ends) in enumerate(rows, 1)
            ],
        }

    def digest(self) -> str:
        """Return the SHA-256 of the set of voxels, the neighbours, the sizes and the boxes. Equal
        labels have an equal digest on every platform."""
        head = {"set": self.octree.set_digest(), "neighbours": self.neighbours}
        return digest_of(head, self.sizes, self.boxes)

    # ---- as an image, which exports are written from

    @property
    def dtype(self) -> np.dtype:
        """The smallest of uint8, uint16 and uint32 that holds all labels."""
        return np.min_scalar_type(len(self))

    @property
    def shape(self) -> tuple[int, int, int]:
        """The voxels along each axis."""
        return self.octree.grid.shape

    @property
    def origin(self) -> tuple[float, float, float]:
        """World coordinates of the low corner."""
        return self.octree.grid.origin

    @property
    def pitch(self) -> tuple[float, float, float]:
        """World size of a voxel."""
        return self.octree.grid.pitch

    @property
    def units(self) -> str:
        """Name of the world unit, or ""."""
        return self.octree.units

    @property
    def cells(self) -> int:
        """Number of voxels of the grid."""
        return prod(self.shape)

    @property
    def mixed(self) -> int:
        """Number of voxels that compression may not shrink: those of bricks."""
        return BRICK_SIDE**3 * len(self.octree.bricks)

    @property
    def nbytes(self) -> int:
        """Bytes of all labels, as a dense array."""
        return self.cells * self.dtype.itemsize

    @property
    def host_bytes(self) -> int:
        """A bound of the memory of four layers, with what is made of them."""
        a, b = sorted(self.shape)[1:]
        return 4 * BRICK_SIDE * a * b * self.dtype.itemsize

    def slabs(self, order: Order = EVERY) -> Iterator[np.ndarray]:
        """Yield the labels transposed to the axes `order`, at most four layers at a time.

        Raises
        ------
        MemoryLimitError
            If the layers do not fit in memory.
        """
        shape = [self.shape[axis] for axis in order]
        _, a, b = (-(-n // BRICK_SIDE) for n in shape)
        size = BRICK_SIDE**3 * a * b * self.dtype.itemsize
        check_memory(2 * size, f"{BRICK_SIDE} layers of {shape[1]} x {shape[2]} labels")
        groups = list(self._groups())
        rows = [Sorted.along(order[0], codes, side) for codes, side, _, _ in groups]
        corner = self._found.pieces.voxels.corner
        for start in range(0, shape[0], BRICK_SIDE):
            slab = np.zeros((BRICK_SIDE, a, BRICK_SIDE, b, BRICK_SIDE), self.dtype)
            bricks = slab.transpose(1, 3, 0, 2, 4)
            for (codes, side, labels, masks), row in zip(groups, rows, strict=True):
                here = row.at(corner + start)
                cells = morton_decode(codes[here]) * side - corner
                j, k = (cells[:, order[n]] // BRICK_SIDE for n in (1, 2))
                if masks is None:
                    steps = np.arange(side // BRICK_SIDE)
                    places = j[:, None, None] + steps[:, None], k[:, None, None] + steps
                    bricks[places] = labels[here][:, None, None, None, None, None]
                else:
                    held = unpack_bricks(masks[here]).transpose(0, *(n + 1 for n in order))
                    part, *local = np.nonzero(held)
                    bricks[j[part], k[part], *local] = labels[here][part]
            slab = slab.reshape(BRICK_SIDE, BRICK_SIDE * a, BRICK_SIDE * b)
            yield slab[: shape[0] - start, : shape[1], : shape[2]]

    def to_dense(self) -> np.ndarray:
        """Return the labels as a dense array, (nx, ny, nz) of `dtype`.

        Raises
        ------
        MemoryLimitError
            If the array does not fit in memory.
        """
        check_memory(2 * self.nbytes, "a dense array of labels")
        return np.concatenate(list(self.slabs()))

    def _groups(self) -> Iterator[tuple[np.ndarray, int, np.ndarray, np.ndarray | None]]:
        """Yield pieces of one side: their codes, side, labels, and the masks of parts of bricks."""
        pieces, labels = self._found.pieces, (self._found.of_pieces + 1).astype(self.dtype)
        for level, codes in enumerate(pieces.voxels.full):
            yield codes, TILE << level, labels[pieces.starts[level] :][: len(codes)], None
        yield pieces.brick_codes(), BRICK_SIDE, labels[pieces.leaves :], pieces.parts


def _described(found: Components) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes of components, and the sums of their voxels' coordinates, (n, 3) int64."""
    pieces, n = found.pieces, len(found.sizes)
    sizes, full = pieces.sizes(), pieces.voxels.full
    lows = [(TILE << level) * morton_decode(codes) for level, codes in enumerate(full)]
    sides = np.concatenate([np.full(len(codes), TILE << level) for level, codes in enumerate(full)])
    low = np.concatenate([*lows, BRICK_SIDE * morton_decode(pieces.brick_codes())])
    low -= pieces.voxels.corner
    boxes, sums = np.zeros((n, 2, 3), np.int64), np.zeros((n, 3), np.int64)
    boxes[:, 0] = MAX_DIM
    for axis in range(3):
        first, end, total = _along(axis, pieces.parts)
        # of the voxels of a leaf, coordinates run from 0 to side - 1
        total = np.concatenate([sides**3 * (sides - 1) // 2, total])
        np.minimum.at(
            boxes[:, 0, axis], found.of_pieces, low[:, axis] + np.append(0 * sides, first)
        )
        np.maximum.at(boxes[:, 1, axis], found.of_pieces, low[:, axis] + np.append(sides, end))
        np.add.at(sums[:, axis], found.of_pieces, sizes * low[:, axis] + total)
    return boxes, sums


def _along(axis: int, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first voxel of masks along an axis, the end of the last one, and the sum of the
    voxels' coordinates, (n,) int64 each."""
    layers = [masks & voxels_where(BRICK_VOXELS[:, axis] == c) for c in range(BRICK_SIDE)]
    held = np.stack(layers) != 0
    counts = [np.bitwise_count(layer).astype(np.int64) for layer in layers]
    total = sum((c * count for c, count in enumerate(counts)), np.zeros(len(masks), np.int64))
    return held.argmax(axis=0), BRICK_SIDE - held[::-1].argmax(axis=0), total


class LabelJob(Job[Labels]):
    """The planned labelling of components.

    Attributes
    ----------
    octree : Octree
        The voxels.
    plan : ComponentsPlan
        The decisions.
    """

    plan: ComponentsPlan
    device = None

    def __init__(
        self, octree: Octree, voxels: Tiling, plan: ComponentsPlan, max_memory: int | None
    ) -> None:
        self.octree, self._voxels = octree, voxels
        self.plan, self.max_memory = plan, max_memory

    def _run(self) -> Labels:
        with self.stage(self.plan.stages[0]):
            return Labels.of(self.octree, self._voxels, self.plan.neighbours)


def plan_components(
    octree: Octree, neighbours: int = NEIGHBOURS[0], *, max_memory: int | None = None
) -> LabelJob:
    """Return the planned job of `components`; see `voxtool.components`."""
    check_neighbours(neighbours)
    voxels = Tiling.of(octree, 0)
    return LabelJob(
        octree, voxels, ComponentsPlan(LABEL, neighbours, len(voxels.codes)), max_memory
    )
