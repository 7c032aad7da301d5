"""The thin parts of a solid: where voxels that touch its mesh may join it.

A solid holds the voxels whose centres are inside. Other voxels that touch a triangle are skin if
they lie within one voxel of a block of 2 x 2 x 2 set ones, and if all set voxels within two voxels
of them are of one component. The others, and the skin beside them, are the
candidates.

A component of the candidates is kept if it reaches farther than REACH voxels from such a block, in
steps through it and the set voxels beside it; or if it touches no component of the solid, or
several. So the tips of solids are left as they are, and no connection is lost: docs/voxels.md has
the proof. On the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np

from voxtool.memory import check_memory
from voxtool.mesh.topology import components
from voxtool.morton import among, distinct, morton_decode, morton_encode
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, BRICK_VOXELS, unite_bricks, unpack_bricks
from voxtool.svo.octree.prune import ALL_VOXELS
from voxtool.svo.sets.components import FEWER, Components
from voxtool.svo.sets.thin import labels_at, with_neighbours
from voxtool.svo.sets.tiling import BRICKS, LEVEL, TILE, Tiling
from voxtool.svo.voxelization.connected.neighbourhoods import CENTRE
from voxtool.svo.voxelization.connected.thinning import HOST_BYTES, neighbours_among

REACH = 4  # voxels from the skin of what is thick, beyond which a part is thin
AROUND = 2  # voxels about a brick that decide what is thick in it, and which components are near
AT_ONCE = 1 << 13  # bricks
BITS = np.uint64(1) << np.arange(64, dtype=np.uint64)


@dataclass(frozen=True)
class Bricks:
    """A set of voxels, as ascending Morton codes of bricks and their masks, (n,) uint64 each."""

    codes: np.ndarray
    masks: np.ndarray

    @classmethod
    def of(cls, voxels: np.ndarray) -> Bricks:
        """Return the set of voxels, given by ascending Morton codes."""
        bits = np.uint64(1) << (voxels & np.uint64(63))
        return cls(*unite_bricks(voxels >> np.uint64(6), bits))

    def where(self, masks: np.ndarray) -> np.ndarray:
        """Return the ascending Morton codes of voxels, given as masks of these
        bricks, (n,) uint64 each."""
        brick, bit = np.nonzero((masks[:, None] & BITS) != 0)
        return (self.codes[brick] << np.uint64(6)) | bit.astype(np.uint64)

    def has(self, voxels: np.ndarray) -> np.ndarray:
        """Return which voxels, given by Morton codes, are in the set, (n,) bool."""
        bricks = voxels >> np.uint64(6)
        place = np.minimum(np.searchsorted(self.codes, bricks), len(self.codes) - 1)
        bits = np.uint64(1) << (voxels & np.uint64(63))
        return (self.codes[place] == bricks) & ((self.masks[place] & bits) != 0)


@dataclass(frozen=True)
class ThinParts:
    """The candidates about the thin parts of a solid, with the voxels of the solid beside them.

    codes : (n,) uint64
        Ascending Morton codes, in the frame.
    added : (n,) bool
        The candidates.
    covered : (n,) bool
        The candidates along a thin part.
    between : (n,) bool
        The candidates between components that are thick there.
    beside : (27, m) int32
        Where the neighbours of each candidate are among the codes; n for those that are not.
    subfields : (m,) int64
        The subfield of each candidate, as thinning takes them. It stays the same if the mesh moves
        by whole voxels.
    """

    codes: np.ndarray
    added: np.ndarray
    covered: np.ndarray
    between: np.ndarray
    beside: np.ndarray
    subfields: np.ndarray


class Solid:
    """A solid, in a frame around its grid, and its components."""

    def __init__(self, voxels: Tiling) -> None:
        self.voxels, self.found = voxels, Components.of(voxels, 26)

    @property
    def pieces(self) -> int:
        """The number of components."""
        return len(self.found.sizes)

    def _mixed(self, bricks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which bricks lie in mixed tiles, (n,) bool; where those are among the bricks of
        these; and the tiles of all."""
        codes, tiles = self.voxels.codes, bricks >> np.uint64(3 * LEVEL)
        held = among(codes, tiles)
        inner = (bricks[held] & np.uint64(BRICKS - 1)).astype(np.int64)
        return held, BRICKS * np.searchsorted(codes, tiles[held]) + inner, tiles

    def masks_of(self, bricks: np.ndarray) -> np.ndarray:
        """Return the masks of bricks, given by their Morton codes."""
        held, places, tiles = self._mixed(bricks)
        masks = np.where(self.voxels.is_full(tiles), ALL_VOXELS, np.uint64(0))
        masks[held] = self.voxels.bricks.ravel()[places]
        return masks

    def has(self, voxels: np.ndarray) -> np.ndarray:
        """Return which voxels, given by Morton codes, are set, (n,) bool."""
        bits = np.uint64(1) << (voxels & np.uint64(63))
        return (self.masks_of(voxels >> np.uint64(6)) & bits) != 0

    def labels_of(self, voxels: np.ndarray) -> np.ndarray:
        """Return the component, from 1 on, of voxels, given by Morton codes, (n,) int64; 0 of unset
        ones."""
        if not self.pieces:
            return np.zeros(len(voxels), np.int64)
        return labels_at(self.found, voxels).astype(np.int64)

    def near_thick(self, bricks: np.ndarray) -> np.ndarray:
        """Return the voxels of bricks that lie within one voxel of 2 x 2 x 2 set ones, as masks."""
        found = [np.empty(0, BRICK)]
        for some, _ in _blocks(bricks):
            filled = np.empty((len(some), *[BRICK_SIDE + 2 * AROUND] * 3), bool)
            cells = morton_decode(some)
            for step, target, source in _pieces_of_window():
                masks = self.masks_of(morton_encode(cells + step))
                filled[:, *target] = unpack_bricks(masks)[:, *source]
            blocks = _folded(filled, 2, np.logical_and)
            thick = _folded(blocks, 2, np.logical_or)
            found.append(_packed(_folded(thick, 3, np.logical_or)))
        return np.concatenate(found)

    def near_several(self, bricks: np.ndarray) -> np.ndarray:
        """Return the voxels of bricks that lie within two voxels of several components, as
        masks."""
        found = np.zeros(len(bricks), BRICK)
        if self.pieces < 2:
            return found
        window = np.indices([BRICK_SIDE + 2 * AROUND] * 3).reshape(3, -1).T - AROUND
        chosen = np.flatnonzero(self._among_several(bricks))
        for some, where in _blocks(bricks[chosen]):
            cells = BRICK_SIDE * morton_decode(some)
            labels = self.labels_of(morton_encode((cells[:, None] + window).reshape(-1, 3)))
            labels = labels.reshape(-1, *[BRICK_SIDE + 2 * AROUND] * 3)
            most = _folded(labels, 5, np.maximum)
            least = _folded(np.where(labels > 0, labels, self.pieces + 1), 5, np.minimum)
            found[chosen[where]] = _packed(least < most)
        return found

    def _among_several(self, bricks: np.ndarray) -> np.ndarray:
        """Return which bricks and their neighbours have voxels of several components, (n,) bool."""
        pieces, of = self.found.pieces, self.found.of_pieces
        low, high = np.full((2, self.voxels.bricks.size), [[len(of)], [-1]])
        np.minimum.at(low, pieces.owners, of[pieces.leaves :])
        np.maximum.at(high, pieces.owners, of[pieces.leaves :])
        least, most = np.full((2, len(bricks)), [[len(of)], [-1]])
        cells = morton_decode(bricks)
        for step in product((-1, 0, 1), repeat=3):
            held, places, tiles = self._mixed(morton_encode(cells + step))
            least[held] = np.minimum(least[held], low[places])
            most[held] = np.maximum(most[held], high[places])
            leaf = pieces.leaf_of(morton_decode(tiles), 0)
            full = leaf >= 0
            least[full] = np.minimum(least[full], of[leaf[full]])
            most[full] = np.maximum(most[full], of[leaf[full]])
        return least < most


def find_thin_parts(solid: Solid, surface: Bricks, max_memory: int) -> ThinParts:
    """Return the candidates of a solid, given the voxels that its mesh touches, in the frame."""
    unset = surface.masks & ~solid.masks_of(surface.codes)
    outer = Bricks(surface.codes[unset != 0], unset[unset != 0])
    skin = outer.masks & solid.near_thick(outer.codes)
    some = skin != 0
    joints = np.zeros_like(skin)
    joints[some] = skin[some] & solid.near_several(outer.codes[some])
    covered, between = outer.where(outer.masks & ~skin), outer.where(joints)
    first = outer.where(outer.masks & (~skin | joints))
    check(len(first), max_memory)
    side = TILE * solid.voxels.side
    around = with_neighbours(first, 26, side)
    candidates = around[outer.has(around)] if len(first) else first
    check(len(candidates), max_memory)
    around = with_neighbours(candidates, 26, side)
    codes = around[solid.has(around) | among(candidates, around)]
    added = among(candidates, codes)
    beside = neighbours_among(codes)
    component, kept = _kept(solid, codes, added, beside)

    used = np.zeros(len(codes) + 1, bool)
    used[beside[:, kept]] = True
    used &= ~np.append(added, True)
    used[kept] = True
    chosen = np.flatnonzero(used)
    place = np.full(len(used), len(chosen), np.int32)
    place[chosen] = np.arange(len(chosen))
    cells = morton_decode(codes[kept])
    corners = np.full((len(codes), 3), side)
    np.minimum.at(corners, component[kept], cells)
    subfields = (cells - corners[component[kept]]) % 3 @ np.array([1, 3, 9])
    codes, added = codes[chosen], added[chosen]
    which = among(covered, codes), among(between, codes)
    return ThinParts(codes, added, *which, place[beside[:, kept]], subfields)


def check(candidates: int, max_memory: int) -> None:
    """Raise MemoryLimitError if this number of candidates does not fit in memory."""
    what = f"{candidates:,} voxels that touch thin parts, to connect them,"
    check_memory(HOST_BYTES * candidates, what, FEWER, max_memory)


def _kept(
    solid: Solid, codes: np.ndarray, added: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the component of each candidate, by the number of its first voxel, (n,) int64, and the
    candidates of the components that are kept."""
    rows = np.flatnonzero(added)
    own = np.append(added, False)
    pairs = [(rows[own[near]], near[own[near]]) for near in beside[:CENTRE, rows]]
    u, v = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    component = components(u, v, len(codes))

    bricks = distinct(codes >> np.uint64(6))
    reached = np.append(Bricks(bricks, solid.near_thick(bricks)).has(codes), False)
    for _ in range(REACH - 1):
        reached[:-1] = reached[beside].any(axis=0)
    chosen = np.zeros(len(codes), bool)
    chosen[component[rows[~reached[rows]]]] = True

    labels = np.append(solid.labels_of(codes), 0)
    ends = component[rows] * (solid.pieces + 1)
    touched = distinct(np.concatenate([distinct(ends + labels[near]) for near in beside[:, rows]]))
    touched = touched[touched % (solid.pieces + 1) > 0]
    chosen |= np.bincount(touched // (solid.pieces + 1), minlength=len(codes)) != 1
    return component, rows[chosen[component[rows]]]


def _blocks(bricks: np.ndarray) -> Iterator[tuple[np.ndarray, slice]]:
    """Yield bricks, AT_ONCE at a time, and where they are."""
    for start in range(0, len(bricks), AT_ONCE):
        where = slice(start, start + AT_ONCE)
        yield bricks[where], where


def _pieces_of_window() -> Iterator[tuple[tuple[int, ...], tuple, tuple]]:
    """Yield the steps to a brick and its neighbours; where each lies in a window of voxels about
    the brick; and which of its voxels."""
    inner = {-1: slice(0, AROUND), 0: slice(AROUND, -AROUND), 1: slice(-AROUND, None)}
    part = {-1: slice(-AROUND, None), 0: slice(None), 1: slice(0, AROUND)}
    for step in product((-1, 0, 1), repeat=3):
        yield step, tuple(inner[s] for s in step), tuple(part[s] for s in step)


def _folded(dense: np.ndarray, width: int, fold: np.ufunc) -> np.ndarray:
    """Return what `fold` makes of each cube of `width` voxels in (n, a, a, a) windows."""
    for axis in (1, 2, 3):
        moved = np.moveaxis(dense, axis, 0)
        size = len(moved) - width + 1
        folded = reduce(fold, (moved[i : i + size] for i in range(width)))
        dense = np.moveaxis(folded, 0, axis)
    return dense


def _packed(dense: np.ndarray) -> np.ndarray:
    """Return the masks of (n, 4, 4, 4) voxels."""
    x, y, z = BRICK_VOXELS.T
    return np.packbits(dense[:, x, y, z].ravel(), bitorder="little").view(BRICK)
