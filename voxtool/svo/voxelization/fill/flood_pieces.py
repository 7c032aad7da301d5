"""The free space of a region as a graph: leaves of an octree, and parts of bricks.

A leaf without surface voxels is one piece, and so is every connected component of the free voxels
of a brick. Pieces that touch are united [Jaiganesh 2018]: the root of a piece is the least number
of its component. Kernels: kernels/svo/voxelization/fill/flood.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Array, Device, program
from voxtool.svo.octree.build import DeviceOctree, build_octree
from voxtool.svo.octree.layout import BRICK, BRICK_SIDE, VALID, descend
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.voxelization.fill.dilation import dilate, grow_outside, reached_nodes
from voxtool.svo.voxelization.fill.rows import unite_nodes
from voxtool.svo.voxelization.plan import CELL

SOURCE = "svo/voxelization/fill/flood.cl"
PARTS = 8  # components that the voxels of a brick can have
NOTHING = 0xFFFFFFFF  # beyond the region
KIND_BITS = np.uint64(8)  # of a key, after the code of a level-1 cell: the octant and the part, or
LEAF = 64  # this and the level of a leaf whose lowest cell it is
HEADERS = {
    "svo/voxelization/fill/flood.h": program.c_constants(
        PARTS=PARTS, NOTHING=NOTHING, EMPTY=EMPTY, FULL=FULL, REFINED=REFINED
    )
}


@dataclass(frozen=True)
class Region:
    """A box of an octree's cube in which pieces are united, in voxels; no leaf reaches across its
    faces, nor across those of the box that it answers for."""

    low: np.ndarray  # (3,) int64
    high: np.ndarray
    own_low: np.ndarray  # the box that it answers for
    own_high: np.ndarray

    @property
    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """The low and the high corner in level-1 cells."""
        return self.low // CELL, self.high // CELL

    def near_faces(self, low: np.ndarray, side: int, reach: int) -> np.ndarray:
        """Return which cubes, given by their (n, 3) low corners, have voxels up to `reach` from the
        faces of its own box, without those that are faces of the region, too."""
        first = np.where(self.own_low > self.low, self.own_low + reach, self.low)
        end = np.where(self.own_high < self.high, self.own_high - reach, self.high)
        out = (low + side <= self.own_low - reach) | (low >= self.own_high + reach)
        within = (low >= first) & (low + side <= end)
        return ~np.logical_or(out.any(axis=1), within.all(axis=1))


class Shared(NamedTuple):
    """The pieces of a region that other regions may have, too."""

    keys: np.ndarray  # (n,) uint64: equal for equal pieces
    roots: np.ndarray  # (n,) uint32
    beyond: np.ndarray  # (m,) uint32: roots of pieces beyond the grid
    size: int  # of the roots: they are below it


def cubes_of(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n, 3) low corners and the (n,) sides of the leaves and bricks of some keys."""
    kind = (keys & np.uint64(255)).astype(np.int64)
    low, leaf = CELL * morton_decode(keys >> KIND_BITS), kind >= LEAF
    octants = morton_decode((kind >> 3 & 7).astype(np.uint64))
    low += BRICK_SIDE * np.where(leaf[:, None], 0, octants)
    return low, np.where(leaf, CELL << np.maximum(kind - LEAF - 1, 0), BRICK_SIDE)


@dataclass(frozen=True)
class Pieces:
    """The pieces of a region, united."""

    region: Region
    tree: DeviceOctree
    codes: np.ndarray  # (n,) uint64 ascending Morton codes of the refined level-1 nodes
    beside: Array  # (27 n,) uint32: what lies around each refined level-1 node
    barrier: Array  # (8 n,) masks of the voxels that are not free
    parts: Array  # (PARTS * 8 n,) masks of the parts of each brick; empty masks follow them
    roots: Array  # uint32, of the coarse nodes, then of the parts

    @property
    def coarse(self) -> int:
        """The number of nodes above level 0."""
        return int(self.tree.offsets[-2])

    def level(self, number: int) -> np.ndarray:
        """Return the ascending Morton codes of the refined nodes of a level."""
        refined = self.tree.refined[number - 1]
        return refined.codes.get(0, refined.n)

    def root_at(self, cell: np.ndarray) -> int:
        """Return the root of a level-1 cell, which is free."""
        (code,) = morton_encode(cell[None])
        index, number = 0, self.tree.top
        while number > 1:
            octant = int(code >> np.uint64(3 * (number - 2))) & 7
            leaf = int(self.tree.offsets[self.tree.top - number + 1]) + 8 * index + octant
            number -= 1
            own = code >> np.uint64(3 * (number - 1))
            refined = self.level(number)
            index = int(np.searchsorted(refined, own))
            if index == len(refined) or refined[index] != own:
                return int(self.roots.get(leaf, leaf + 1)[0])
        part = self.coarse + PARTS * 8 * index
        return int(self.roots.get(part, part + 1)[0])

    def shared(self, reach: int, beyond: list[np.ndarray]) -> Shared:
        """Return the pieces with voxels up to `reach` from the faces of the region's own box, and
        the roots of level-1 cells beyond the grid."""
        region, (low, high) = self.region, self.region.cells
        child = self.tree.nodes.get(0, self.coarse)["child"]
        every = self.roots.get(0, self.coarse)
        keys, roots = [], []
        for level in range(1, self.tree.top):
            first = int(self.tree.offsets[self.tree.top - level])
            codes = descend(self.level(level + 1)) << np.uint64(3 * (level - 1))
            leaf = (child[first : first + len(codes)] & VALID) == 0
            cells = morton_decode(codes[leaf])
            here = region.near_faces(CELL * cells, CELL << (level - 1), reach)
            here &= ((cells >= low) & (cells < high)).all(axis=1)
            keys.append(codes[leaf][here] << KIND_BITS | np.uint64(LEAF + level))
            roots.append(every[first : first + len(codes)][leaf][here])
        nodes = np.flatnonzero(region.near_faces(CELL * morton_decode(self.codes), CELL, reach))
        corners = BRICK_SIDE * morton_decode(descend(self.codes[nodes]))
        chosen = descend(nodes.astype(np.uint64))
        chosen = chosen[region.near_faces(corners, BRICK_SIDE, reach)]
        device, found = self.roots.device, self.roots.device.empty(PARTS * len(chosen), np.uint32)
        find_roots_of = self.tree.kernel(SOURCE, "find_roots_of")
        bricks = device.put(chosen.astype(np.uint32))
        find_roots_of(len(chosen), bricks, self.parts, self.coarse, self.roots, found)
        number = (chosen & np.uint64(7)) << np.uint64(3)
        brick = self.codes[chosen >> np.uint64(3)] << KIND_BITS | number
        parts = (brick[:, None] | np.arange(PARTS, dtype=np.uint64)).ravel()
        of_parts = found.take()
        there = of_parts != NOTHING
        ends = np.array([self.root_at(cell) for cell in beyond], np.uint32)
        keys, roots = [*keys, parts[there]], [*roots, of_parts[there]]
        return Shared(np.concatenate(keys), np.concatenate(roots), ends, self.roots.size)

    def inside(
        self, outside: np.ndarray, steps: int, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the states of the coarse nodes, and the (8 n,) masks of the voxels from low to
        below high that are not outside: in pieces whose roots are given, grown by steps."""
        device, n = self.roots.device, self.barrier.size
        flags = np.zeros(self.roots.size, np.uint8)
        flags[outside] = 1
        reached, states = device.put(flags), device.empty(self.coarse, np.uint8)
        kernel = self.tree.kernel
        kernel(SOURCE, "state_nodes")(self.coarse, self.tree.nodes, self.roots, reached, states)
        voxels = device.empty(n, BRICK)
        collect_outside = kernel(SOURCE, "collect_outside")
        collect_outside(n, self.parts, self.coarse, self.roots, reached, voxels)
        voxels = grow_outside(self.tree, self.beside, states, self.barrier, voxels, steps)
        clip_bricks(self.tree.refined[0].codes, voxels, low, high, inverted=True)
        return states.take(), voxels.take()


def clip_bricks(
    codes: Array, bricks: Array, low: np.ndarray, high: np.ndarray, *, inverted: bool = False
) -> None:
    """Clear the voxels of the bricks of level-1 nodes that do not lie in the box from low to below
    high; `inverted` keeps those in it that are clear instead."""
    name = {4: "uint", 8: "ulong"}[codes.dtype.itemsize]
    clip = bricks.device.kernel(SOURCE, "clip_bricks", CODE=name)
    clip(bricks.size, codes, tuple(low), tuple(high), inverted, bricks)


def find_pieces(
    device: Device,
    side: int,
    region: Region,
    seeds: np.ndarray,
    surface: tuple[np.ndarray, Array],
    steps: int,
) -> Pieces:
    """Return the pieces of a region in an octree of `side` voxels that consist of the voxels more
    than `steps` steps from a surface.

    seeds : Morton codes of level-1 nodes to be refined; surface : the codes of those with surface
    voxels, and the (8 n,) masks of their bricks.
    """
    codes, bricks = surface
    if steps and len(codes):
        bits = 3 * (side // CELL).bit_length()
        reached, n = reached_nodes(device.put(codes), len(codes), bricks, steps, bits)
        seeds = np.append(seeds, reached.get(0, n))
    nodes = np.union1d(codes, seeds)
    masks = device.zeros(8 * len(nodes), BRICK)
    unite_nodes(bricks, np.searchsorted(nodes, codes).astype(np.uint32), masks)
    tree = build_octree(device, side, device.put(nodes), len(nodes))
    beside = _beside(tree, region)
    masks = dilate(tree, beside, masks, steps)
    return Pieces(region, tree, nodes, beside, masks, *_unite(tree, region, beside, masks))


def _beside(tree: DeviceOctree, region: Region) -> Array:
    """Return what lies around each refined level-1 node in a region, (27 n,) uint32."""
    device, level1 = tree.nodes.device, tree.refined[0]
    beside, (low, high) = device.empty(27 * level1.n, np.uint32), region.cells
    find_beside = tree.kernel(SOURCE, "find_beside")
    offsets, box = device.put(tree.offsets), (tuple(low), tuple(high))
    find_beside(level1.n, tree.nodes, offsets, tree.top, level1.codes, *box, beside)
    return beside


def _unite(
    tree: DeviceOctree, region: Region, beside: Array, barrier: Array
) -> tuple[Array, Array]:
    """Return the parts of bricks, and the roots of coarse nodes and of parts."""
    device, n, coarse = tree.nodes.device, barrier.size, int(tree.offsets[-2])
    offsets, roots = device.put(tree.offsets), device.empty(coarse + PARTS * n, np.uint32)
    parts, box = device.empty(PARTS * n, BRICK), [tuple(corner) for corner in region.cells]
    tree.kernel(SOURCE, "number_nodes")(roots.size, roots)
    tree.kernel(SOURCE, "split_bricks")(n, barrier, parts)
    for level in range(1, tree.top):
        above = tree.refined[level]
        link_leaves = tree.kernel(SOURCE, "link_leaves")
        link_leaves(8 * above.n, tree.nodes, offsets, tree.top, level, above.codes, *box, roots)
    tree.kernel(SOURCE, "link_parts")(n, beside, parts, coarse, roots)
    tree.kernel(SOURCE, "find_roots")(roots.size, roots)
    return parts, roots
