"""An octree of pieces, boxes of voxels and cubes in any order, without a dense array."""

from __future__ import annotations

import numpy as np

from voxtool.errors import GridError, MemoryLimitError, human
from voxtool.grid import Grid
from voxtool.memory import available_memory, check_memory
from voxtool.morton import distinct, morton_decode, morton_encode
from voxtool.svo.octree.layout import (
    BRICK,
    BRICK_SIDE,
    BRICK_VOXELS,
    pack_array,
    pack_voxels,
    unite_bricks,
    voxels_within,
)
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import ALL_VOXELS, octree_of_bricks

APART = 1 << 22  # bricks that are kept before they are united
BRICK_BYTES = 384  # while the octree is made: a brick that is alone among its siblings
OCTANTS = np.indices((2, 2, 2)).reshape(3, -1).T


class Collector:
    """Collects the voxels of an octree; one that is added twice counts once.

    Parameters
    ----------
    grid : Grid
        The grid of the voxels.
    max_memory : int, optional
        Bytes that it may take; by default those that are free at the beginning.
    """

    def __init__(self, grid: Grid, max_memory: int | None = None) -> None:
        self.grid = grid
        self.most = available_memory() if max_memory is None else max_memory
        self._bricks: list[tuple[np.ndarray, np.ndarray]] = []  # codes and masks
        self._united = self._apart = 0  # bricks that have been united, and the others
        self._reaches_beyond = False  # whether a box or cube does, set or not
        # Codes of cubes that are wholly set, by level from 1 to the root's.
        levels = (grid.side // BRICK_SIDE).bit_length() - 1
        self._full: list[list[np.ndarray]] = [[] for _ in range(levels)]

    def add_boxes(self, corners: np.ndarray, values: np.ndarray) -> None:
        """Add boxes of one shape.

        Parameters
        ----------
        corners : (n, 3) int
            Their low voxels; none is negative.
        values : (n, a, b, c) bool
            Their voxels, indexed [box, x, y, z].
        """
        self._look(corners, values.shape[1:])
        if len(values) == 1:
            before = corners[0] % BRICK_SIDE
            box = np.pad(values[0], [(int(n), 0) for n in before]) if before.any() else values[0]
            codes, masks = pack_array(box)
            cells = morton_decode(codes) + corners[0] // BRICK_SIDE
            self._add(morton_encode(cells), masks)
        elif (
            not (np.array(values.shape[1:]) % BRICK_SIDE).any() and not (corners % BRICK_SIDE).any()
        ):
            self._add(*_bricks_of(np.asarray(corners) // BRICK_SIDE, values))
        else:
            box, *local = np.nonzero(values)
            self._add(*pack_voxels(corners[box] + np.stack(local, axis=1)))

    def add_cubes(self, corners: np.ndarray, side: int) -> None:
        """Add cubes that are wholly set; those whose corners are no multiples of their side are
        divided.

        Parameters
        ----------
        corners : (n, 3) int
            Their low voxels; none is negative.
        side : int
            A power of two.
        """
        if not len(corners):
            return
        self._look(corners, (side,) * 3)
        while side > 1 and (side > self.grid.side or (corners % side).any()):
            side //= 2
            check_memory(8 * 24 * len(corners), f"cubes of {side} voxels a side")
            corners = (corners[:, None] + side * OCTANTS).reshape(-1, 3)
        if side < BRICK_SIDE:
            local = np.indices((side,) * 3).reshape(3, -1).T
            self._add(*pack_voxels((corners[:, None] + local).reshape(-1, 3)))
            return
        codes = distinct(morton_encode(corners // side))
        if side == BRICK_SIDE:
            self._add(codes, np.full(len(codes), ALL_VOXELS))
        else:
            self._full[(side // BRICK_SIDE).bit_length() - 2].append(codes)

    def octree(self, units: str = "") -> Octree:
        """Return the octree, with mode "solid" and fill "none".

        Raises
        ------
        GridError
            If a voxel is not in the grid.
        """
        self._unite()
        codes, masks = self._bricks[0]
        full = [distinct(np.concatenate([codes[:0], *parts])) for parts in self._full]
        for level in range(len(full) - 1, -1, -1):  # what lies in a larger cube is there already
            for finer in range(level):
                full[finer] = full[finer][_outside(full[finer], full[level], level - finer)]
            kept = _outside(codes, full[level], level + 1)
            codes, masks = codes[kept], masks[kept]
        if self._reaches_beyond:
            self._check(codes, masks, full)
        arrays = octree_of_bricks(self.grid.side, codes, masks, full, collapse=True)
        return Octree(self.grid, "solid", "none", *arrays, units=units)

    def _look(self, corners: np.ndarray, size: tuple[int, ...]) -> None:
        """Take note whether a box reaches beyond the grid."""
        if len(corners):
            self._reaches_beyond |= bool((corners.max(axis=0) + size > self.grid.shape).any())

    def _add(self, codes: np.ndarray, masks: np.ndarray) -> None:
        self._bricks.append((codes, masks))
        self._apart += len(codes)
        if self._apart > APART or self._held * BRICK_BYTES > self.most:
            self._unite()
        if self._held * BRICK_BYTES > self.most:
            held = self._held
            raise MemoryLimitError(
                f"{held:,} bricks of {BRICK_SIDE}^3 voxels hold some that are set, which need "
                f"{human(held * BRICK_BYTES)} of memory, of {human(self.most)} allowed: choose "
                "fewer voxels by --threshold or --label (see --max-memory)"
            )

    @property
    def _held(self) -> int:
        """Number of bricks."""
        return self._united + self._apart

    def _unite(self) -> None:
        """Unite the bricks that are equal in code, and make cubes of eight that are wholly set."""
        codes = np.concatenate([np.empty(0, np.uint64), *(codes for codes, _ in self._bricks)])
        masks = np.concatenate([np.empty(0, np.uint64), *(masks for _, masks in self._bricks)])
        order = np.argsort(codes, kind="stable")
        codes, masks = unite_bricks(codes[order], masks[order])
        whole = codes[masks == ALL_VOXELS] >> np.uint64(3)
        whole = whole[:-7][whole[:-7] == whole[7:]] if len(whole) > 7 else whole[:0]
        self._full[0].append(whole)
        kept = _outside(codes, whole, 1)
        self._bricks = [(codes[kept], masks[kept])]
        self._united, self._apart = int(np.count_nonzero(kept)), 0

    def _check(self, codes: np.ndarray, masks: np.ndarray, full: list[np.ndarray]) -> None:
        """Raise GridError if a voxel is not in the grid."""
        beyond = (masks & ~voxels_within(morton_decode(codes), self.grid.shape)).any()
        for level, cubes in enumerate(full, 1):
            side = BRICK_SIDE << level
            beyond |= ((morton_decode(cubes) + 1) * side > self.grid.shape).any()
        if beyond:
            raise GridError(
                f"a voxel is not in the grid of {' x '.join(map(str, self.grid.shape))}"
            )


def _bricks_of(cells: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the codes and masks of the bricks of boxes of whole bricks, from the brick cells."""
    shape = [size // BRICK_SIDE for size in values.shape[1:]]
    parts = [size for side in shape for size in (side, BRICK_SIDE)]
    blocks = values.reshape(-1, *parts).transpose(0, 1, 3, 5, 2, 4, 6).reshape(-1, BRICK_SIDE**3)
    places = np.ravel_multi_index(tuple(BRICK_VOXELS.T), (BRICK_SIDE,) * 3)
    masks = np.packbits(blocks.take(places, axis=1), axis=1, bitorder="little").view(BRICK).ravel()
    steps = np.indices(shape).reshape(3, -1).T
    held = np.flatnonzero(masks)
    return morton_encode((cells[:, None] + steps).reshape(-1, 3)[held]), masks[held]


def _outside(codes: np.ndarray, cubes: np.ndarray, levels: int) -> np.ndarray:
    """Return which codes lie in none of the cubes, which are some levels coarser; both ascend."""
    shift = np.uint64(3 * levels)
    starts = np.searchsorted(codes, cubes << shift)
    ends = np.searchsorted(codes, (cubes + np.uint64(1)) << shift)
    held = starts < ends
    steps = np.zeros(len(codes) + 1, np.int8)
    steps[starts[held]] += 1
    steps[ends[held]] -= 1
    return np.cumsum(steps[:-1], dtype=np.int8) == 0
