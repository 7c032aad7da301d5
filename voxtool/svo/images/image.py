"""An octree as an image: what every export of its voxels is written from.

The cells of an image are voxels, or at level N cubes of 2**N voxels a side, aligned to the grid. A
cell's count is the number of its voxels that are set. Values follow from counts by the dtype: a
float holds the coverage, count / 8**N; a whole number the count itself; a bool whether the coverage
is at least the isovalue. Nothing dense is held: at most four layers of cells, or a few thousand
blocks. If the cells are nodes above the bricks, the octree need not be in memory; otherwise see
image_parts.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from math import prod
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from voxtool.errors import GridError, VoxtoolError
from voxtool.morton import morton_decode
from voxtool.svo.cells.counts import Counts, check_isovalue, counts_of
from voxtool.svo.images.blocks import Leaves, Sorted, keys_of, places_in
from voxtool.svo.images.slabs import THICK, Blocks, Filled, Order, slabs_of
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import descend
from voxtool.svo.octree.octree import Octree

CHUNK = 1 << 21  # cells that are unpacked at once
NODE_BYTES = 40  # bytes of lists of blocks and of counts, a node of the octree
LAYERS = 24  # of cells, more than an export holds
QUANTITIES = {"b": "occupancy", "u": "count", "f": "coverage"}  # by the kind of the dtype
UNIFORM = -1  # instead of the node of a block: wholly set, or unset where the image is inverted
NODES = 3  # the first level whose cells are nodes above the bricks
DTYPES = ("bool", "uint8", "uint16", "uint32", "float32", "float64")
EVERY = (0, 1, 2)


class Cubes(NamedTuple):
    """Cubes of one side that are wholly set, in ascending order of their Morton codes."""

    corners: np.ndarray  # (n, 3) int64: the low cells, counted from the grid's corner
    side: int  # in cells


@dataclass(frozen=True, eq=False)
class VoxelImage:
    """The voxels of an octree as an image.

    Attributes
    ----------
    octree : OctreeContent
        The voxels; an Octree, or of a level from NODES up any octree.
    level : int
        A cell has 2**level voxels a side; 0 for voxels.
    low, shape : (3,) int
        The part: its low cell, counted from the grid's corner, and its cells along each axis.
    invert : bool
        Whether the unset voxels of the grid count instead of the set ones.
    dtype : np.dtype
        The type of the values.
    isovalue : float
        Of bool: the least share of a cell that is set.
    progress : callable
        Called with the share of the image that has been passed on, from 0 to 1.
    whole : OctreeContent, optional
        The octree of which `octree` has what lies in the part; None if that is all of it.
    dense : bool
        Whether whole layers of cells are asked for, not only those that are set.
    attributes : tuple of str
        Attributes of the cells that are written, too; see attribute_image.py.
    tree : bool
        Whether the file is a tree, for which those of all nodes and of the file are held.
    """

    smaller: ClassVar[str] = "a higher --level, or a part by --bbox"
    in_parts: ClassVar[bool] = False  # whether its octree is read in parts

    octree: OctreeContent
    level: int
    low: tuple[int, int, int]
    shape: tuple[int, int, int]
    invert: bool
    dtype: np.dtype
    isovalue: float = 0.5
    progress: Callable[[float], None] = field(default=lambda share: None)
    whole: OctreeContent | None = None
    dense: bool = True
    attributes: tuple[str, ...] = ()
    tree: bool = False

    @classmethod
    def of(
        cls,
        octree: OctreeContent,
        *,
        level: int = 0,
        bbox: Sequence[float] | None = None,
        invert: bool = False,
        dtype: Any = None,
        isovalue: float | None = None,
    ) -> Self:
        """Return the image of an octree.

        Parameters
        ----------
        octree : OctreeContent
            The voxels.
        level : int
            A cell has 2**level voxels a side.
        bbox : (6,) sequence of float, optional
            Box X0 Y0 Z0 X1 Y1 Z1 in world units: only the cells that it touches.
        invert : bool
            Count the unset voxels of the grid instead of the set ones.
        dtype : dtype, optional
            One of DTYPES; by default bool for voxels and with an isovalue, otherwise float32.
        isovalue : float, optional
            The least share of a cell above voxels that is set; by default a half.

        Raises
        ------
        VoxtoolError
            If there is no such level or dtype, the dtype cannot hold a cell's count, or the
            isovalue is no share, or of other values than bool.
        GridError
            If the box touches no cell of the grid.
        """
        coarsest = octree.depth + 1
        if not 0 <= level <= coarsest:
            raise VoxtoolError(
                f"level {level}: choose one from 0 (voxels) to {coarsest} (one cell, of "
                f"{octree.grid.side} voxels a side)"
            )
        check_isovalue(isovalue)
        if isovalue is not None:
            if not level:
                raise VoxtoolError("an isovalue is a share of a cell: choose a level, too")
            dtype = bool if dtype is None else dtype
        held = _dtype(dtype, level)
        whole = cls(octree, level, (0, 0, 0), (1, 1, 1), invert, held)
        if isovalue is not None:
            if held.kind != "b":
                raise VoxtoolError(f"an isovalue makes cells bool, not {held.name}: drop one")
            whole = replace(whole, isovalue=isovalue)
        low, shape = whole._part(bbox)
        return replace(whole, low=low, shape=shape)

    def _part(self, bbox: Sequence[float] | None) -> tuple[Any, Any]:
        """Return the low cell and the shape of the cells that a box touches."""
        cells = self.all_cells
        if bbox is None:
            return self.low, cells
        box = np.asarray(bbox, np.float64).reshape(2, 3)
        if not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise GridError(f"box {' '.join(f'{v:g}' for v in box.ravel())} is empty or not finite")
        box = (box - self.corner) / self.pitch
        low = np.clip(np.floor(box[0]), 0, cells).astype(int)
        high = np.clip(np.ceil(box[1]), 0, cells).astype(int)
        if (low >= high).any():
            raise GridError("the box touches no voxel of the grid: see `voxtool svo-info`")
        return tuple(low.tolist()), tuple((high - low).tolist())

    def layer(self, axis: str, value: int) -> Self:
        """Return the image of the cells that are number `value` along an axis, if there are any."""
        low, shape, a = list(self.low), list(self.shape), "xyz".find(axis)
        if a < 0 or not 0 <= value < shape[a]:
            return self
        low[a], shape[a] = value, 1
        return replace(self, low=tuple(low), shape=tuple(shape))

    # ---- where it lies, and how large it is

    @property
    def side(self) -> int:
        """Voxels along a side of a cell."""
        return 1 << self.level

    @property
    def pitch(self) -> tuple[float, float, float]:
        """World size of a cell."""
        x, y, z = (p * self.side for p in self.octree.grid.pitch)
        return x, y, z

    @property
    def corner(self) -> tuple[float, float, float]:
        """World coordinates of the low corner of the grid's first cell, from which blocks count."""
        return self.octree.grid.origin

    @property
    def origin(self) -> tuple[float, float, float]:
        """World coordinates of the low corner of the part."""
        grid = self.octree.grid
        x, y, z = (
            o + p * (n * self.side)
            for o, p, n in zip(grid.origin, grid.pitch, self.low, strict=True)
        )
        return x, y, z

    @property
    def units(self) -> str:
        """Name of the world unit, or ""."""
        return self.octree.units

    @property
    def all_cells(self) -> tuple[int, int, int]:
        """Cells along each axis of the whole grid."""
        x, y, z = (-(-n // self.side) for n in self.octree.grid.shape)
        return x, y, z

    @property
    def cells(self) -> int:
        """Number of cells."""
        return prod(self.shape)

    @property
    def mixed(self) -> int:
        """Number of cells in the blocks of 4 x 4 x 4 that are neither empty nor wholly set."""
        return THICK**3 * len(self._leaves(THICK.bit_length() - 1).codes)

    @property
    def nbytes(self) -> int:
        """Bytes of all values, as a dense array."""
        return self.cells * self.dtype.itemsize

    @property
    def host_bytes(self) -> int:
        """A bound of the memory of the lists of blocks, and of some layers of cells or the values
        of the blocks."""
        octree = self.octree
        levels = octree.depth - (0 if isinstance(octree, Octree) else max(self.level - 2, 0))
        return NODE_BYTES * int(octree.offsets[levels]) + self.layer_bytes

    @property
    def layer_bytes(self) -> int:
        """A bound of the memory of some layers of cells."""
        a, b = sorted(self.shape)[1:]
        return LAYERS * a * b * self.dtype.itemsize if self.dense else 0

    @property
    def quantity(self) -> str:
        """Name of what the values are."""
        return QUANTITIES[self.dtype.kind]

    @property
    def most(self) -> int:
        """The count of a cell that is wholly set."""
        return self.side**3

    def value(self, counts: Any) -> np.ndarray:
        """Return the values of cells of these counts."""
        counts = np.asarray(counts)
        if self.dtype == bool:
            return counts >= math.ceil(Fraction(self.isovalue) * self.most)
        if self.dtype.kind == "f":
            return counts.astype(self.dtype) / self.dtype.type(self.most)
        return counts.astype(self.dtype)

    def with_dtype(self, dtype: Any) -> VoxelImage:
        """Return the same image with values of another type."""
        return replace(self, dtype=_dtype(dtype, self.level))

    def digest(self) -> str:
        """Return the digest of the octree, also if only a part of it is here."""
        return (self.whole or self.octree).digest()

    # ---- values

    def parts(self, axis: int = 0, least: int = THICK) -> Iterator[VoxelImage]:
        """Yield images that together hold the cells, one after the other along an axis; they meet
        where the cell is a multiple of `least`, a power of two from THICK up."""
        yield self

    def slabs(self, order: Order = EVERY) -> Iterator[np.ndarray]:
        """Yield the values transposed to the axes `order`, in pieces of at most four layers.

        Raises
        ------
        MemoryLimitError
            If the layers do not fit in memory.
        """
        whole = self.value(self.most)

        def row(axis: int, start: int) -> tuple[Blocks, list[Filled]]:
            blocks, cubes = self._row(axis, start)
            return blocks, [Filled(*each, whole) for each in cubes]

        kind = (self.dtype, ())
        return slabs_of(self.low, self.shape, order, kind, row, self.progress)

    def coordinates(self) -> Iterator[np.ndarray]:
        """Yield the cells whose value is not zero, (N, 3) int32 counted from the low cell of the
        part, in lexicographic order, four layers at a time."""
        return (cells for cells, _ in self.listed())

    def listed(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the same cells and their values, (N,) of the image's dtype."""
        low, high = self.low[0], self.low[0] + self.shape[0]
        for start in range(low - low % THICK, high, THICK):
            blocks, cubes = self._row(0, start)
            block, *local = np.nonzero(blocks.values)
            keys = [keys_of(blocks.corners[block].T + np.stack(local))]
            for corners, side in cubes:
                local = np.indices((THICK, side, side)).reshape(3, -1).T
                corners[:, 0] = start
                keys.append(keys_of((corners[:, None] + local).reshape(-1, 3).T))
            found = np.concatenate(keys)
            if self.dtype == bool:
                found.sort()
                values = np.broadcast_to(True, len(found))
            else:
                values = np.full(len(found), self.value(self.most))
                values[: len(keys[0])] = blocks.values[blocks.values != 0]
                order = np.argsort(found)
                found, values = found[order], values[order]
            found -= keys_of(np.array(self.low))
            cells = np.empty((len(found), 3), "<i4")
            for axis, shift in enumerate((42, 21, 0)):
                cells[:, axis] = (found >> shift) & 0x1FFFFF
            self.progress(min((start + THICK - low) / (high - low), 1.0))
            yield cells, values

    def blocks(self, side: int = 8) -> Iterator[Blocks]:
        """Yield the blocks of side**3 cells that are neither empty nor in `cubes(side)`, some
        thousand at a time, in Morton order. Cells outside the part are zero.

        Parameters
        ----------
        side : int
            A power of two, at least 4.
        """
        power = side.bit_length() - 1
        leaves = self._leaves(power)
        step = max(CHUNK >> (3 * power), 1)
        for start in range(0, len(leaves.codes), step):
            chosen = slice(start, start + step)
            blocks = self.unpacked(leaves.codes[chosen], leaves.nodes[chosen], power)
            held = blocks.values.any(axis=(1, 2, 3))
            self.progress(min((start + step) / len(leaves.codes), 1.0))
            yield Blocks(blocks.corners[held], blocks.values[held])

    def block_nodes(self, side: int = 8) -> tuple[np.ndarray, np.ndarray]:
        """Return the low cells of the blocks of `blocks(side)` and some that are empty, (n, 3)
        int64, and the indices of their nodes in their level, or UNIFORM."""
        codes, nodes = self.block_codes(side)
        return morton_decode(codes) * side, nodes

    def block_codes(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the Morton codes of these blocks instead of their low cells."""
        leaves = self._leaves(side.bit_length() - 1)
        return leaves.codes, leaves.nodes

    def cubes(self, side: int = 8) -> list[Cubes]:
        """Return the cubes of `side` or more cells that are wholly set, coarse ones first."""
        return [
            Cubes(morton_decode(codes) * width, width) for codes, width in self.cube_codes(side)
        ]

    def cube_codes(self, side: int = 8) -> list[tuple[np.ndarray, int]]:
        """Return the Morton codes of these cubes, by their side in cells."""
        return self._leaves(side.bit_length() - 1).cubes

    @cached_property
    def count(self) -> int:
        """Number of cells whose value is not zero."""
        if self.level == 0 and self.shape == self.octree.grid.shape:
            return self.cells - self.octree.count if self.invert else self.octree.count
        found = sum(len(cubes.corners) * cubes.side**3 for cubes in self.cubes(THICK))
        return found + sum(int(np.count_nonzero(b.values)) for b in self.blocks(THICK))

    # ---- how they are found

    @cached_property
    def _counts(self) -> Counts:
        return counts_of(self.octree, self.level)

    @cached_property
    def _known(self) -> dict[int, Leaves]:
        return {}

    @cached_property
    def _rows(self) -> dict[int, list[Sorted]]:
        return {}

    def _leaves(self, power: int) -> Leaves:
        """Return the blocks of 2**power cells, and the cubes of that size or more."""
        if power < THICK.bit_length() - 1:
            raise ValueError(f"a block has at least {THICK} cells a side")
        if power not in self._known:
            self._known[power] = self._found(self._counts.level + power, 1 << power)
        return self._known[power]

    def _found(self, target: int, side: int) -> Leaves:
        """Return the leaves at the octree's level `target`, whose nodes are `side` cells wide."""
        levels = self._counts.levels
        if target >= len(levels):  # one block holds the whole grid
            return Leaves(np.zeros(1, np.uint64), np.zeros(1, np.int64), [])
        cubes: list[tuple[np.ndarray, int]] = []
        split = np.empty(0, np.uint64)  # full nodes that the border of the part divides
        for level in levels[target:][::-1]:
            width = side << (level.number - target)  # cells along a side of a node
            full = ~(level.refined | level.inside) if self.invert else level.inside
            found = np.concatenate([descend(split), level.codes[full & (level.number > 0)]])
            within, touching = self._placed(found, width)
            if within.any():
                cubes.append((np.sort(found[within]), width))
            split = found[touching & ~within]
        level, counts = levels[target], self._counts.of_nodes[target]
        holds = counts < level.side**3 if self.invert else counts > 0
        mixed = np.flatnonzero(holds & level.refined)
        mixed = mixed[self._placed(level.codes[mixed], side)[1]]
        codes = np.concatenate([level.codes[mixed], split])
        nodes = np.concatenate([mixed, np.full(len(split), UNIFORM)])
        by_code = np.argsort(codes)
        return Leaves(codes[by_code], nodes[by_code], cubes)

    def _placed(self, codes: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which nodes of a width in cells lie in the part, and which touch it."""
        corners = morton_decode(codes) * width
        low, high = np.array(self.low), np.add(self.low, self.shape)
        within = (corners >= low) & (corners + width <= high)
        if self.invert and self.level:  # a cell may be only partly in the grid
            within &= corners + width <= np.array(self.octree.grid.shape) // self.side
        touching = (corners + width > low) & (corners < high)
        return np.all(within, axis=1), np.all(touching, axis=1)

    def within(
        self, axis: int, start: int
    ) -> tuple[tuple[np.ndarray, np.ndarray], list[tuple[np.ndarray, int]]]:
        """Return the blocks of the four layers from `start` on along an axis, their codes and
        nodes, and the codes of the cubes there by their side in cells."""
        leaves = self._leaves(THICK.bit_length() - 1)
        if axis not in self._rows:
            lists = [(leaves.codes, THICK), *leaves.cubes]
            self._rows[axis] = [Sorted.along(axis, codes, width) for codes, width in lists]
        blocks, *cubes = (column.at(start) for column in self._rows[axis])
        return (leaves.codes[blocks], leaves.nodes[blocks]), [
            (codes[chosen], width)
            for (codes, width), chosen in zip(leaves.cubes, cubes, strict=True)
        ]

    def _row(self, axis: int, start: int) -> tuple[Blocks, list[Cubes]]:
        """Return the blocks and the cubes of the four layers from `start` on along an axis."""
        blocks, cubes = self.within(axis, start)
        found = self.unpacked(*blocks, THICK.bit_length() - 1)
        return found, [Cubes(morton_decode(codes) * width, width) for codes, width in cubes]

    def unpacked(self, codes: np.ndarray, nodes: np.ndarray, power: int) -> Blocks:
        """Return blocks of 2**power cells, by their codes and nodes."""
        side = 1 << power
        level = min(self._counts.level + power, len(self._counts.levels) - 1)
        counts = np.zeros((len(nodes), side**3), self._counts.dtype)
        uniform = nodes == UNIFORM
        found = self._counts.of_cells(level, nodes[~uniform])
        counts[~uniform, : found.shape[1]] = found  # of the whole grid, if a block holds it
        counts[uniform] = 0 if self.invert else self.most
        counts = counts[:, places_in(side)]
        corners = morton_decode(codes) * side
        if self.invert:
            counts = self._volumes(corners, side, self.octree.grid.shape, self.side) - counts
        if self.low != (0, 0, 0) or self.shape != self.all_cells:
            part = self._volumes(corners - self.low, side, self.shape, 1)
            counts *= part.astype(counts.dtype)
        return Blocks(corners, self.value(counts))

    def _volumes(
        self, corners: np.ndarray, side: int, shape: tuple[int, int, int], width: int
    ) -> np.ndarray:
        """Return the voxels of the cells of blocks that lie in a box [0, shape): (n, side, side,
        side). A cell has `width` voxels a side."""
        cells = corners[:, :, None] + np.arange(side)
        lengths = np.clip(np.array(shape)[:, None] - cells * width, 0, width)
        lengths[cells < 0] = 0
        x, y, z = lengths.transpose(1, 0, 2).astype(self._counts.dtype)
        return x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]


def _dtype(dtype: Any, level: int) -> np.dtype:
    """Return the type of an image's values; raise VoxtoolError if it cannot hold them."""
    if dtype is None:
        return np.dtype(np.float32 if level else bool)
    try:
        found = np.dtype(dtype)
    except TypeError:
        found = None
    if found is None or found.name not in DTYPES:
        raise VoxtoolError(f"dtype {dtype!r} is unknown: choose one of {', '.join(DTYPES)}")
    if found.kind == "u" and np.iinfo(found).max < 8**level:
        raise VoxtoolError(
            f"a cell of level {level} has {8**level} voxels, more than {found.name} counts: choose "
            "a wider type, or float32 for the coverage"
        )
    return found
