"""The flood rule: a voxel is inside if the outside cannot reach it.

The surface is "surface26": no path through voxels that share a face, an edge or a corner passes it.
The outside consists of the voxels that such paths reach from beyond the grid. The flood works on
the octree, whose free space is a graph of pieces (pieces.py); those that are connected with a leaf
beyond the grid are outside.

With a gap of N voxels, the outside first stays ceil(N / 2) voxels away from the surface, so that it
does not pass openings of up to N voxels. Then it grows by the same number of steps, so that closing
gaps does not thicken the solid: dilation.py.

A grid whose graph is too large for the memory is flooded in regions: slabs along z, or the windows
of tiles/flooding.py. Neighbouring regions overlap by a block, so a piece near a face of a region is
a piece of its neighbours, too; their components are united by such pieces (outside.py). Then every
region is made again and answers for its voxels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Array, Device
from voxtool.svo.octree.links import FULL
from voxtool.svo.octree.prune import states_by_level
from voxtool.svo.voxelization.fill.flood_pieces import (
    Pieces,
    Region,
    Shared,
    clip_bricks,
    find_pieces,
)
from voxtool.svo.voxelization.fill.outside import Outside
from voxtool.svo.voxelization.plan import CELL, flood_block, flood_steps

# The active level-1 nodes of a window of the grid, given by its low corner and its shape, and the
# masks of their bricks with the surface; the window may begin before the grid.
Walls = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, Array]]
Answer = tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]


@dataclass(frozen=True)
class Frame:
    """The octree's cube around a grid: the window that is asked for is an aligned cube of it."""

    side: int  # voxels along a side
    window: int  # along a side of the window's cube
    corner: np.ndarray  # (3,) int64: where the grid begins
    end: np.ndarray  # where it ends
    low: np.ndarray  # where the window begins
    high: np.ndarray
    block: int  # no leaf near a region's faces is larger
    gap: int
    regions: tuple[Region, ...]

    @property
    def steps(self) -> int:
        """The steps that the outside stays away from the surface."""
        return flood_steps(self.gap)

    @property
    def divided(self) -> bool:
        """True if there are other regions."""
        return self.block > CELL

    @property
    def reach(self) -> int:
        """The voxels around a region's own box whose pieces matter to it."""
        return max(self.steps, 1)

    def box(self, region: Region) -> tuple[np.ndarray, np.ndarray]:
        """Return the low corner and the high one of the part of the grid whose surface matters to a
        region; it begins with a level-1 node."""
        low = np.maximum(region.low - self.steps, self.corner)
        return low // CELL * CELL, np.minimum(region.high + self.steps, self.end)

    def seeds(self, region: Region) -> np.ndarray:
        """Return the Morton codes of level-1 nodes that are refined so that no leaf reaches across
        the faces of the region, of its own box, or of the window."""
        cells = [region.low[None], self.low[None]]
        for axis in range(3 * self.divided):
            for face in (region.own_low[axis], region.own_high[axis]):
                low, high = region.low.copy(), region.high.copy()
                low[axis], high[axis] = face - self.block, face + self.block
                low, high = np.maximum(low, region.low), np.minimum(high, region.high)
                cells.append(_lattice(low, high, self.block))
        for axis in np.flatnonzero((self.high < self.end) & (self.high % self.window > 0)):
            step = int(self.high[axis] & -self.high[axis])
            low = self.low.copy()
            low[axis] = self.high[axis] - 1
            cells.append(_lattice(low, self.high, max(step, CELL)))
        every = np.concatenate(cells)
        return morton_encode(
            every[((every >= region.low) & (every < region.high)).all(axis=1)] // CELL
        )

    def beyond(self, region: Region) -> list[np.ndarray]:
        """Return level-1 cells of a region beyond the faces of the grid that its own box reaches;
        the surface, and the steps around it, are farther away."""
        cells = []
        for axis in range(3):
            if region.own_low[axis] <= self.corner[axis]:
                cells.append(region.low // CELL)
            if region.own_high[axis] >= self.end[axis]:
                cell = region.low // CELL
                cell[axis] = region.high[axis] // CELL - 1
                cells.append(cell)
        return cells


def _lattice(low: np.ndarray, high: np.ndarray, step: int) -> np.ndarray:
    """Return the points from low to below high, (n, 3), in steps."""
    axes = (np.arange(a, b, step) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def frame_of(
    grid: tuple[int, int, int], low: np.ndarray, shape: np.ndarray, gap: int, slabs: int
) -> Frame:
    """Return the frame of a window of a grid that is flooded in one piece, or in slabs."""
    window = 1 << (int(shape.max()) - 1).bit_length()
    block = flood_block(max(grid), gap) if slabs > 1 else CELL
    margin = block if slabs > 1 else flood_steps(gap) + 2 * CELL  # voxels 8 to 15 are beyond
    align = max(window, block)
    corner = align * -(-(low + margin) // align) - low
    end = corner + grid
    side = 1 << (int(end.max()) + margin + block - 1).bit_length()
    regions = _slabs(corner, end, block, slabs) if slabs > 1 else [_whole(side)]
    place = (corner, end, corner + low, corner + low + shape)
    return Frame(side, window, *place, block, gap, tuple(regions))


def _whole(side: int) -> Region:
    """Return the region that is all of a cube."""
    low, high = np.zeros(3, np.int64), np.full(3, side)
    return Region(low, high, low, high)


def _slabs(corner: np.ndarray, end: np.ndarray, block: int, slabs: int) -> list[Region]:
    """Return the regions from low to high along z that a grid is divided into."""
    low, high = corner // block, -(-end // block)
    cuts = block * np.linspace(low[2], high[2], slabs + 1).astype(np.int64)
    low, high = block * (low - 1), block * (high + 1)
    regions = []
    for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        own_low, own_high = np.append(low[:2], a), np.append(high[:2], b)
        z = np.array([0, 0, block])
        regions += [Region(own_low - z, own_high + z, own_low, own_high)] * (a < b)
    return regions


def window_frame(grid: tuple[int, int, int], key: tuple[int, int, int, int], gap: int) -> Frame:
    """Return the frame of a cube of a grid, given by its low corner and its side, with what lies
    around it: one of the windows that a grid is flooded in. All of them are in one cube."""
    block = flood_block(0, gap)
    root = max(1 << (max(grid) - 1).bit_length(), block)
    corner = np.full(3, root)
    low, end = corner + key[:3], corner + grid
    region = Region(low - block, low + key[3] + block, low, low + key[3])
    high = np.minimum(region.own_high, end)
    return Frame(4 * root, key[3], corner, end, low, high, block, gap, (region,))


def flood(
    device: Device, walls: Walls, frame: Frame
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the octree of the window's voxels that the outside cannot reach, with the surface: the
    codes of the refined level-1 nodes, the states of all nodes by level, from level 1 up, the masks
    of the bricks, and the codes of the active level-1 nodes."""
    if not frame.divided:
        (region,) = frame.regions
        pieces, active = _pieces(device, walls, frame, region)
        outside = np.array([pieces.root_at(frame.beyond(region)[0])])
        return _joined(frame, [_answer(frame, pieces, active, outside)])
    found = Outside()
    for region in frame.regions:
        pieces, _ = _pieces(device, walls, frame, region)
        found.add(pieces.shared(frame.reach, frame.beyond(region)))
    answers = [
        _answer(frame, *_pieces(device, walls, frame, region), outside)
        for region, outside in zip(frame.regions, found.roots(), strict=True)
        if (region.own_low < frame.high).all() and (frame.low < region.own_high).all()
    ]
    return _joined(frame, answers)


def shared_pieces(device: Device, walls: Walls, frame: Frame) -> Shared:
    """Return the pieces of one of many windows that others may have, too."""
    (region,) = frame.regions
    pieces, _ = _pieces(device, walls, frame, region)
    return pieces.shared(frame.reach, frame.beyond(region))


def flooded_window(
    device: Device, walls: Walls, frame: Frame, outside: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the octree of a window, as `flood` does, from the roots of its pieces outside."""
    (region,) = frame.regions
    return _joined(frame, [_answer(frame, *_pieces(device, walls, frame, region), outside)])


def _pieces(
    device: Device, walls: Walls, frame: Frame, region: Region
) -> tuple[Pieces, np.ndarray]:
    """Return the pieces of a region, and the codes of its active level-1 nodes."""
    corner, high = frame.box(region)
    low = np.maximum(region.low - frame.steps, frame.corner)
    codes, bricks = walls(corner - frame.corner, high - corner)
    if (corner < low).any():
        clip_bricks(device.put(codes), bricks, low - corner, high - corner)
    codes = morton_encode(morton_decode(codes) + corner // CELL)
    seeds = frame.seeds(region)
    pieces = find_pieces(device, frame.side, region, seeds, (codes, bricks), frame.steps)
    return pieces, codes


def _answer(frame: Frame, pieces: Pieces, active: np.ndarray, outside: np.ndarray) -> Answer:
    """Return what a region knows of the window: the codes of its refined level-1 nodes, their
    masks, the codes of its active nodes, and those of its FULL leaves by level."""
    states, inside = pieces.inside(outside, frame.steps, frame.low, frame.high)
    here = _within(frame, pieces.region, pieces.codes)
    masks = inside.reshape(-1, 8)[here]
    full = _full_leaves(frame, pieces, states)
    return pieces.codes[here], masks, active[_within(frame, pieces.region, active)], full


def _joined(
    frame: Frame, answers: list[Answer]
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return what several regions know together, as `flood` does."""
    codes, masks, active, leaves = zip(*answers, strict=True)
    order = np.argsort(np.concatenate(codes), kind="stable")
    own = np.uint64((frame.window // CELL) ** 3 - 1)  # bits of a level-1 code in the window's cube
    ascending = np.concatenate(codes)[order] & own
    full = [np.concatenate(level) for level in zip(*leaves, strict=True)]
    states = states_by_level(ascending, full)
    return ascending, states, np.concatenate(masks)[order].ravel(), np.concatenate(active) & own


def _within(frame: Frame, region: Region, codes: np.ndarray) -> np.ndarray:
    """Return which level-1 nodes a region answers for, and lie in the window."""
    bits = np.uint64(3 * ((frame.window // CELL).bit_length() - 1))
    here = codes >> bits == morton_encode(frame.low[None] // frame.window)
    low, high = region.own_low // CELL, np.minimum(region.own_high, frame.high + CELL - 1) // CELL
    for cells, least, end in zip(morton_decode(codes).T, low, high, strict=True):
        here &= (cells >= least) & (cells < end)
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
