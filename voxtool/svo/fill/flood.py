"""The flood rule: a voxel is inside if the outside cannot reach it.

The surface is "surface26": no path through voxels that share a face, an edge or a corner passes it.
The outside consists of the voxels that such paths reach from beyond the grid. The flood works on
the octree, whose free space is a graph of pieces (pieces.py); those that are connected with a leaf
beyond the grid are outside.

With a gap of N voxels, the outside first stays ceil(N / 2) voxels away from the surface, so that it
does not pass openings of up to N voxels. Then it grows by the same number of steps, so that closing
gaps does not thicken the solid: dilation.py.

A grid whose graph is too large for the memory is flooded in slabs along z. Neighbouring slabs
overlap, and a piece in the overlap is a piece of both, so the components of all slabs are united by
the roots that such pieces have in either. Then every slab is made again and answers for its voxels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from voxtool.mesh.topology import components
from voxtool.morton import distinct, gather_bits, morton_decode, morton_encode
from voxtool.opencl import Array, Device
from voxtool.svo.fill.pieces import Pieces, Region, clip_bricks, find_pieces
from voxtool.svo.links import FULL
from voxtool.svo.plan import CELL, flood_block, flood_steps
from voxtool.svo.prune import states_by_level

# The active level-1 nodes of a window of the grid, given by its low corner and its shape, and the
# masks of their bricks with the surface; the window may begin before the grid.
Walls = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, Array]]


@dataclass(frozen=True)
class Frame:
    """The octree's cube around a grid: the window that is asked for is an aligned cube of it."""

    side: int  # voxels along a side
    window: int  # along a side of the window's cube
    corner: np.ndarray  # (3,) int64: where the grid begins
    end: np.ndarray  # where it ends
    low: np.ndarray  # where the window begins
    high: np.ndarray
    block: int  # no leaf of a slab is larger
    slabs: int

    @property
    def regions(self) -> list[Region]:
        """The slabs, from low to high."""
        if self.slabs == 1:
            return [Region(np.zeros(3, np.int64), np.full(3, self.side), (0, self.side))]
        low, high = self.corner // self.block, -(-self.end // self.block)
        cuts = self.block * np.linspace(low[2], high[2], self.slabs + 1).astype(np.int64)
        low, high = self.block * (low - 1), self.block * (high + 1)
        return [
            Region(np.append(low[:2], a - self.block), np.append(high[:2], b + self.block), (a, b))
            for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
            if a < b
        ]

    def seeds(self, region: Region) -> np.ndarray:
        """Return the Morton codes of level-1 nodes that are refined so that no leaf reaches across
        the faces of the region or of the window."""
        ends = region.low + self.block if self.slabs == 1 else region.high
        cells = [_lattice(region.low, ends, self.block), self.low[None]]
        for axis in np.flatnonzero((self.high < self.end) & (self.high % self.window > 0)):
            step = int(self.high[axis] & -self.high[axis])
            low = self.low.copy()
            low[axis] = self.high[axis] - 1
            cells.append(_lattice(low, self.high, max(step, CELL)))
        every = np.concatenate(cells)
        return morton_encode(
            every[((every >= region.low) & (every < region.high)).all(axis=1)] // CELL
        )


def _lattice(low: np.ndarray, high: np.ndarray, step: int) -> np.ndarray:
    """Return the points from low to below high, (n, 3), in steps."""
    axes = (np.arange(a, b, step) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def frame_of(
    grid: tuple[int, int, int], low: np.ndarray, shape: np.ndarray, gap: int, slabs: int
) -> Frame:
    """Return the frame of a window of a grid."""
    window = 1 << (int(shape.max()) - 1).bit_length()
    block = flood_block(max(grid), gap) if slabs > 1 else CELL
    margin = block if slabs > 1 else flood_steps(gap) + 2 * CELL  # voxels 8 to 15 are beyond
    align = max(window, block)
    corner = align * -(-(low + margin) // align) - low
    end = corner + grid
    side = 1 << (int(end.max()) + margin + block - 1).bit_length()
    return Frame(side, window, corner, end, corner + low, corner + low + shape, block, slabs)


def flood(
    device: Device, walls: Walls, frame: Frame, gap: int
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the octree of the window's voxels that the outside cannot reach, with the surface: the
    codes of the refined level-1 nodes, the states of all nodes by level, from level 1 up, the masks
    of the bricks, and the codes of the active level-1 nodes.

    The outside does not pass openings of up to `gap` voxels.
    """
    regions, steps = frame.regions, flood_steps(gap)
    kept = {}
    if len(regions) == 1:
        kept[0] = _pieces(device, walls, frame, regions[0], steps)
        outside = [np.array([kept[0][0].beyond])]
    else:
        outside = _outside(_pieces(device, walls, frame, r, steps)[0] for r in regions)
    codes, masks, active = [], [], []
    full: list[list[np.ndarray]] = [[] for _ in range((frame.window // CELL).bit_length())]
    for i, region in enumerate(regions):
        if region.own[0] < frame.high[2] and frame.low[2] < region.own[1]:
            pieces, found = kept.pop(i, None) or _pieces(device, walls, frame, region, steps)
            states, inside = pieces.inside(outside[i], steps, frame.low, frame.high)
            here = _within(frame, region, pieces.codes)
            codes.append(pieces.codes[here])
            masks.append(inside.reshape(-1, 8)[here])
            active.append(found[_within(frame, region, found)])
            for level, leaves in enumerate(_full_leaves(frame, pieces, states)):
                full[level].append(leaves)
    order = np.argsort(np.concatenate(codes), kind="stable")
    own = np.uint64((1 << 3 * (len(full) - 1)) - 1)  # bits of a level-1 code in the window's cube
    ascending = np.concatenate(codes)[order] & own
    states = states_by_level(ascending, [np.concatenate(leaves) for leaves in full])
    return ascending, states, np.concatenate(masks)[order].ravel(), np.concatenate(active) & own


def _pieces(
    device: Device, walls: Walls, frame: Frame, region: Region, steps: int
) -> tuple[Pieces, np.ndarray]:
    """Return the pieces of a region, and the codes of its active level-1 nodes."""
    low = np.maximum(region.low - steps, frame.corner)
    high = np.minimum(region.high + steps, frame.end)
    corner = low // CELL * CELL
    codes, bricks = walls(corner - frame.corner, high - corner)
    if (corner < low).any():
        clip_bricks(device.put(codes), bricks, low - corner, high - corner)
    codes = morton_encode(morton_decode(codes) + corner // CELL)
    seeds = frame.seeds(region)
    return find_pieces(device, frame.side, region, seeds, (codes, bricks), steps), codes


def _outside(slabs: Iterator[Pieces]) -> list[np.ndarray]:
    """Return the roots of each slab's pieces that are outside."""
    links, beyond, starts, above = [], [], [0], np.empty(0, np.int64)
    for pieces in slabs:
        first, (low, high) = starts[-1], pieces.region.own
        if len(starts) > 1:
            below = first + pieces.roots_at(low - 1).astype(np.int64)
            links.append(np.unique(np.stack([above, below]), axis=1))
        above = first + pieces.roots_at(high - 1).astype(np.int64)
        beyond.append(first + pieces.beyond)
        starts.append(first + pieces.roots.size)
    u, v = np.concatenate(links, axis=1)
    numbers = distinct(np.concatenate([u, v, beyond]))
    u, v = np.searchsorted(numbers, u), np.searchsorted(numbers, v)
    least = components(u, v, len(numbers))
    outside = numbers[np.isin(least, least[np.searchsorted(numbers, beyond)])]
    parts = np.split(outside, np.searchsorted(outside, starts[1:-1]))
    return [part - first for part, first in zip(parts, starts, strict=False)]


def _within(frame: Frame, region: Region, codes: np.ndarray) -> np.ndarray:
    """Return which level-1 nodes a region answers for, and lie in the window."""
    bits = np.uint64(3 * ((frame.window // CELL).bit_length() - 1))
    here = codes >> bits == morton_encode(frame.low[None] // frame.window)
    others = (frame.high < frame.end) | (frame.slabs > 1)  # nodes beyond the window, not outside
    for axis in np.flatnonzero(others & (frame.high % frame.window > 0)):
        here &= gather_bits(codes >> np.uint64(axis)) < -(-frame.high[axis] // CELL)
    if frame.slabs > 1:
        z = CELL * gather_bits(codes >> np.uint64(2))
        here &= (region.own[0] <= z) & (z < region.own[1])
    return here


def _full_leaves(frame: Frame, pieces: Pieces, states: np.ndarray) -> list[np.ndarray]:
    """Return the codes, in the window's cube, of the FULL leaves that a region answers for, by
    level from level 1 up."""
    tree, leaves, top = pieces.tree, [], (frame.window // CELL).bit_length()
    for level in range(1, top + 1):
        first, end = tree.offsets[tree.top - level : tree.top - level + 2].tolist()
        full = np.flatnonzero(states[first:end] == FULL)
        codes = pieces.level(level + 1)[full >> 3] << np.uint64(3) | (full & 7).astype(np.uint64)
        corners = codes << np.uint64(3 * (level - 1))
        here = codes[_within(frame, pieces.region, corners)]
        leaves.append(here & np.uint64((1 << 3 * (top - level)) - 1))
    return leaves
