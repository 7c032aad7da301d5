"""A field as an image: its distances at the centres of the cells of a grid, slab by slab.

A grid over the field's cube begins at the cube's low corner. Outside the cube a sample is what a
query returns there, a lower bound of the distance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, ClassVar

import numpy as np

from voxtool.adf.field.field import DistanceField
from voxtool.adf.queries.query import FieldQuery
from voxtool.choices import DEFAULT_DIM, MAX_DIM, MIN_DIM
from voxtool.errors import GridError, VoxtoolError
from voxtool.grid import Grid
from voxtool.opencl import Device

AT_ONCE = 1 << 19  # samples that are queried at once
SAMPLE_BYTES = 96  # on host and device: the points, what a query holds of them, and two slabs


def cells_along(source: DistanceField, most: int) -> int:
    """Return the number of cells along a side of a field's cube that are as large as its finest
    leaves, at most `most`."""
    return min(max(1 << source.depth, MIN_DIM), most)


def grid_over(
    source: DistanceField, shape: Any = None, spacing: Any = None, most: int = DEFAULT_DIM
) -> Grid:
    """Return a grid that covers the cube of a field.

    Parameters
    ----------
    source : DistanceField
        The field.
    shape : int or (3,) sequence of int, optional
        Cells along each axis.
    spacing : float or (3,) sequence of float, optional
        World size of a cell, instead; its multiples nearest to the cube's side are covered. By
        default that of the field's finest leaves, if these are at most `most` along a side.

    Raises
    ------
    VoxtoolError
        If both are given.
    GridError
        If the grid is out of range.
    """
    if shape is not None and spacing is not None:
        raise VoxtoolError("a shape and a spacing both say the size of a cell: give one of them")
    if spacing is not None:
        sizes = np.broadcast_to(np.asarray(spacing, np.float64), 3)
        if not (sizes > 0).all() or (source.side / sizes > MAX_DIM).any():
            raise GridError(
                f"a spacing of {spacing}: for this field choose one from "
                f"{source.side / MAX_DIM:g} to {source.side / MIN_DIM:g}"
            )
        counts = np.maximum(np.floor(source.side / sizes + 0.5), 1).astype(int)
    else:
        counts = np.broadcast_to(cells_along(source, most) if shape is None else shape, 3)
        if min(counts) < 1:
            raise GridError(f"a shape of {shape}: every side has at least 1 cell")
        sizes = source.side / counts
    return Grid(tuple(counts.tolist()), source.origin, tuple(sizes.tolist()))


@dataclass(frozen=True, eq=False)
class FieldSamples:
    """The distances of a field at the centres of the cells of a grid, in world units.

    Attributes
    ----------
    source : DistanceField
        The field.
    grid : Grid
        The cells.
    device : Device, optional
        Where to compute; the default device if None.
    progress : callable
        Called with the share of the samples that has been passed on, from 0 to 1.
    """

    level: ClassVar[int] = 0
    dtype: ClassVar[np.dtype] = np.dtype(np.float32)
    quantity: ClassVar[str] = "distance"
    smaller: ClassVar[str] = "a larger --spacing, or a smaller --shape"

    source: DistanceField
    grid: Grid
    device: Device | None = None
    progress: Callable[[float], None] = lambda share: None

    @property
    def shape(self) -> tuple[int, int, int]:
        """The cells along each axis."""
        return self.grid.shape

    @property
    def origin(self) -> tuple[float, float, float]:
        """World coordinates of the low corner."""
        return self.grid.origin

    @property
    def pitch(self) -> tuple[float, float, float]:
        """World size of a cell."""
        return self.grid.pitch

    @property
    def units(self) -> str:
        """Name of the world unit, or ""."""
        return self.source.units

    @property
    def cells(self) -> int:
        """Number of samples."""
        return prod(self.shape)

    @property
    def mixed(self) -> int:
        """Number of samples that compression may not shrink: all."""
        return self.cells

    @property
    def nbytes(self) -> int:
        """Bytes of all samples, as a dense array."""
        return self.cells * self.dtype.itemsize

    @property
    def host_bytes(self) -> int:
        """A bound of the memory that a slab takes, with what is queried at once."""
        a, b = sorted(self.shape)[1:]
        return SAMPLE_BYTES * AT_ONCE + 2 * self.dtype.itemsize * a * b

    @cached_property
    def query(self) -> FieldQuery:
        """The field on the device."""
        return FieldQuery(self.source, self.device)

    def centers(self, axis: int) -> np.ndarray:
        """Return the coordinates of the centres of the cells along an axis, world units."""
        return self.origin[axis] + self.pitch[axis] * (np.arange(self.shape[axis]) + 0.5)

    def slabs(self, order: Sequence[int] = (0, 1, 2)) -> Iterator[np.ndarray]:
        """Yield the samples, transposed to the axes `order`, some layers at a time, float32."""
        a, b, c = (self.centers(axis) for axis in order)
        layers = max(AT_ONCE // (len(b) * len(c)), 1)
        rows = max(AT_ONCE // (layers * len(c)), 1)
        for first in range(0, len(a), layers):
            near = a[first : first + layers]
            slab = np.empty((len(near), len(b), len(c)), self.dtype)
            for row in range(0, len(b), rows):
                part = slab[:, row : row + rows]
                points = np.empty((*part.shape, 3))
                points[..., order[0]] = near[:, None, None]
                points[..., order[1]] = b[row : row + rows, None]
                points[..., order[2]] = c
                part[...] = self.query(points.reshape(-1, 3)).distance.reshape(part.shape)
            self.progress((first + len(near)) / len(a))
            yield slab
