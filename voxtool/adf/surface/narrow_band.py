"""A level set: samples of a field on a regular grid, in blocks, near the surface only.

Sample (i, j, k) is at the centre of a voxel: origin + spacing * (i + 1/2, j + 1/2, k + 1/2), from
the low corner of the field's cube. In a leaf the field is trilinear, and so it is in every box
within it: there it lies between the least and the greatest of the values at the box's corners.
So boxes far from the surface are left out, and large boxes near it are halved until they are small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from voxtool.adf.construction.stages import OCTANTS
from voxtool.adf.field.cells import cell_of
from voxtool.adf.field.field import DistanceField
from voxtool.adf.pictures.raycast import refined_children
from voxtool.adf.queries.query import FieldQuery
from voxtool.adf.queries.samples import cells_along
from voxtool.errors import VoxtoolError
from voxtool.grid import MAX_DIM, MIN_DIM, Grid
from voxtool.morton import distinct
from voxtool.opencl import Device

BAND = 3.0  # voxels, OpenVDB's own half-width
BLOCK_SIDE = 8
MOST_BOXES = 1 << 22
BLOCK_BYTES = 3 << 10  # a block with its distances and its place
KEY_BITS = 20  # bits of a block along an axis
ROUNDING = 2.0**-20  # sides: more than single precision rounds distances in the cube by
AT_ONCE = 1 << 9  # blocks that are sampled at once
STEPS = np.indices((BLOCK_SIDE,) * 3).reshape(3, -1).T  # of the samples of a block, z fastest


class Boxes(NamedTuple):
    """Boxes in leaves, in sides of the cube: low corners (n, 3), edges (n,) and the field's values
    at their corners (n, 2, 2, 2) [z, y, x]."""

    low: np.ndarray
    edge: np.ndarray
    values: np.ndarray

    def chosen(self, which: np.ndarray) -> Boxes:
        return Boxes(*(part[which] for part in self))


@dataclass(frozen=True, eq=False)
class LevelSet:
    """The samples of a field whose distances are less than `background`.

    Attributes
    ----------
    source : DistanceField
        The field.
    grid : Grid
        The voxels whose centres are the samples.
    background : float
        The half-width of the band, world units.
    corners : (n, 3) int64
        The low samples of all blocks of 8 a side that can hold such samples.
    device : Device, optional
        Where to compute; the default device if None.
    progress : callable
        Called with the share of the blocks that has been sampled.
    """

    level: ClassVar[int] = 0
    dtype: ClassVar[np.dtype] = np.dtype(np.float32)
    smaller: ClassVar[str] = "a larger --spacing, or a narrower --band"

    source: DistanceField
    grid: Grid
    background: float
    corners: np.ndarray = field(repr=False)
    device: Device | None = None
    progress: Callable[[float], None] = lambda share: None

    @classmethod
    def of(
        cls,
        source: DistanceField,
        band: float | None = None,
        spacing: float | None = None,
    ) -> LevelSet:
        """Return the level set of a field.

        Parameters
        ----------
        source : DistanceField
            A field with signs.
        band : float, optional
            Half-width in voxels, at least 1; by default 3.
        spacing : float, optional
            Edge of a voxel, in world units; by default that of the field's finest leaves.

        Raises
        ------
        VoxtoolError
            If the field has no signs, or the band or the spacing is out of range.
        """
        band = BAND if band is None else band
        if spacing is None:
            spacing = source.side / cells_along(source, MAX_DIM)
        if source.sign == "none":
            raise VoxtoolError(
                "a level set has an inside, and this field has none: build it without --fill none"
            )
        if not 1 <= band <= MAX_DIM:
            raise VoxtoolError(f"a band of {band:g} voxels: it has 1 to {MAX_DIM:,}")
        least, most = source.side / MAX_DIM, source.side / MIN_DIM
        if not least <= spacing <= most:
            raise VoxtoolError(
                f"a spacing of {spacing:g}: for this field choose one from {least:g} to {most:g}"
            )
        samples = math.floor(source.side / spacing + 0.5)  # those in the cube
        grid = Grid((samples, samples, samples), source.origin, (spacing, spacing, spacing))
        blocks = near_blocks(source, spacing, band * spacing)
        return cls(source, grid, band * spacing, BLOCK_SIDE * blocks)

    @property
    def shape(self) -> tuple[int, int, int]:
        """The samples along each axis."""
        return self.grid.shape

    @property
    def origin(self) -> tuple[float, float, float]:
        """The low corner of the first voxel, world units."""
        return self.grid.origin

    @property
    def pitch(self) -> tuple[float, float, float]:
        """The edges of a voxel, world units."""
        return self.grid.pitch

    @property
    def host_bytes(self) -> int:
        """A bound of the memory that the blocks take, with their values."""
        return BLOCK_BYTES * len(self.corners)

    @property
    def middle(self) -> np.ndarray:
        """The first sample, (3,) world units."""
        return np.array(self.origin) + np.array(self.pitch) / 2

    @cached_property
    def query(self) -> FieldQuery:
        """The field on the device."""
        return FieldQuery(self.source, self.device)

    def distances(self, samples: np.ndarray) -> np.ndarray:
        """Return the distances at (n, 3) samples, (n,) float32, world units; outside the cube the
        background."""
        found = self.query(self.middle + np.array(self.pitch) * samples)
        return np.where(found.outside, self.background, found.distance).astype(np.float32)

    def sampled(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the low samples (n, 3) of blocks, and their distances (n, 512), z fastest."""
        for first in range(0, len(self.corners), AT_ONCE):
            corners = self.corners[first : first + AT_ONCE]
            found = self.distances((corners[:, None] + STEPS).reshape(-1, 3))
            self.progress(min(first + AT_ONCE, len(self.corners)) / len(self.corners))
            yield corners, found.reshape(len(corners), -1)


def near_blocks(source: DistanceField, spacing: float, reach: float) -> np.ndarray:
    """Return the blocks that may hold samples whose distances are at most `reach`, world units:
    (n, 3) int64, in blocks, in lexicographic order."""
    limit, block = reach / source.side + ROUNDING, BLOCK_SIDE * spacing / source.side
    boxes, found = leaves_of(source), [np.empty(0, np.int64)]
    while len(boxes.edge):
        least, most = (pick(boxes.values, axis=(1, 2, 3)) for pick in (np.min, np.max))
        boxes = boxes.chosen((least <= limit) & (most >= -limit))
        small = boxes.edge <= block
        found.append(_overlapped(boxes.chosen(small), block))
        boxes = boxes.chosen(~small)
        if 8 * len(boxes.edge) + sum(map(len, found)) > MOST_BOXES:
            raise VoxtoolError(
                f"a spacing of {spacing:g} takes more than {MOST_BOXES:,} blocks of "
                f"{BLOCK_SIDE}^3 samples: choose a larger --spacing, or a narrower --band"
            )
        boxes = _halved(boxes)
    keys = distinct(np.concatenate(found))
    bits = (1 << KEY_BITS) - 1
    return np.stack([keys >> 2 * KEY_BITS, keys >> KEY_BITS & bits, keys & bits], axis=1)


def leaves_of(source: DistanceField) -> Boxes:
    """Return the leaves of a field as boxes."""
    levels, cells = cell_of(source.blocks)
    refined, parts = refined_children(source), []
    for bit, octant in enumerate(OCTANTS.T):
        leaf = refined >> bit & 1 == 0
        edge = np.ldexp(1.0, -(levels[leaf] + 1))
        x, y, z = (slice(n, n + 2) for n in octant.tolist())
        values = source.voxels[leaf, z, y, x].astype(np.float64)
        parts.append(Boxes((2 * cells[leaf] + octant) * edge[:, None], edge, values))
    return Boxes(*map(np.concatenate, zip(*parts, strict=True)))


def _halved(boxes: Boxes) -> Boxes:
    """Return the eight halves of each box, whose values follow from its corners'."""
    values = boxes.values
    for axis in (1, 2, 3):
        first, last = (values.take([n], axis) for n in (0, 1))
        values = np.concatenate([first, (first + last) / 2, last], axis)
    edge, parts = boxes.edge / 2, []
    for octant in OCTANTS.T:
        x, y, z = (slice(n, n + 2) for n in octant.tolist())
        parts.append(Boxes(boxes.low + octant * edge[:, None], edge, values[:, z, y, x]))
    return Boxes(*map(np.concatenate, zip(*parts, strict=True)))


def _overlapped(boxes: Boxes, block: float) -> np.ndarray:
    """Return the keys of the blocks that boxes overlap, which are at most as large as a block."""
    first = np.floor(boxes.low / block).astype(np.int64)
    last = np.ceil((boxes.low + boxes.edge[:, None]) / block).astype(np.int64) - 1
    ends = (np.where(octant, last, first) for octant in OCTANTS.T)
    keys = [(x << KEY_BITS | y) << KEY_BITS | z for x, y, z in (end.T for end in ends)]
    return distinct(np.concatenate(keys))
