"""The flood rule: a voxel is inside if the outside cannot reach it.

The surface is "surface26": no path through voxels that share a face, an edge or a corner passes it.
The outside consists of the voxels that such paths reach from beyond the grid. The flood works on
the octree: a leaf without surface voxels is one node of a graph, and so is every connected
component of the free voxels of a brick. Nodes that touch are linked; the component of a far corner
is outside.

With a gap of N voxels, the outside first stays ceil(N / 2) voxels away from the surface, so that it
does not pass openings of up to N voxels. Then it grows by the same number of steps, so that closing
gaps does not thicken the solid.
"""

from __future__ import annotations

import itertools

import numpy as np

from voxtool.mesh.topology import components
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.layout import descend, unite_bricks, voxels_within
from voxtool.svo.prune import EMPTY, FULL, REFINED, child_places

ALL = ~np.uint64(0)
HERE = (0, 0, 0)
AROUND = [(x, y, z) for x, y, z in itertools.product((-1, 0, 1), repeat=3) if x or y or z]
# The voxels of coordinate 0 along an axis; those of 1, 2 and 3 lie 1, 8 and 9 << axis bits above.
LOW = [np.uint64(m) for m in (0x0055005500550055, 0x0000333300003333, 0x000000000F0F0F0F)]


def flood(
    nodes: np.ndarray, surface: np.ndarray, side: int, shape: tuple[int, int, int], gap: int
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Return the octree of the voxels that the outside cannot reach, including the surface: the
    codes of the refined nodes by level, from level 1 up, the states of all nodes by level, and the
    masks of the bricks.

    `nodes` holds the ascending Morton codes of the level-1 nodes with surface voxels, and `surface`
    the (8 n,) masks of their bricks. The outside does not pass openings of up to `gap` voxels.
    """
    steps = -(-gap // 2)
    top = (side // 8).bit_length()  # the root's level
    if not len(nodes):
        root = np.full(1, EMPTY, np.uint8)
        return [nodes] * top, [root[:0]] * (top - 1) + [root], surface
    around = np.uint64(7 << 3 * (top - 1))  # the grid becomes cube (1, 1, 1) of 4 x 4 x 4
    nodes, barrier = _dilate(nodes.astype(np.uint64) | around, surface, steps)
    octree = _Octree(nodes, top + 2)
    reached, outside = _reach(octree, ~barrier)
    for _ in range(steps):
        outside |= octree.spread(outside, reached) & barrier

    lists, states = [], []
    for level in range(1, top + 1):
        shift = np.uint64(3 * (top - level))
        codes, refined = descend(octree.refined[level]), octree.refined[level - 1]
        codes, refined = (each[each >> shift == 7] for each in (codes, refined))
        state = np.where(reached[octree.leaf_at(codes, level)], EMPTY, FULL).astype(np.uint8)
        state[np.searchsorted(codes, refined)] = REFINED
        lists.append(refined ^ (np.uint64(7) << shift))
        states.append(state)
    inside = ~outside[np.repeat(nodes >> np.uint64(3 * (top - 1)) == 7, 8)]
    return lists, states, inside & voxels_within(morton_decode(descend(lists[0])), shape)


class _Octree:
    """The octree of given level-1 nodes. These nodes and the leaves are numbered in Morton order.

    `refined` holds the codes of the refined nodes by level, from level 1 up; `starts` the codes of
    the first level-1 cells of the numbered nodes; `levels` the levels of leaves, and 0 for the
    given nodes; and `ranks` the positions of the given nodes among each other, and -1 for leaves.
    """

    def __init__(self, nodes: np.ndarray, top: int) -> None:
        self.refined, starts, levels = [nodes], [nodes], [np.zeros(len(nodes), np.int64)]
        for level in range(1, top):
            codes = self.refined[-1]
            parents = np.unique(codes >> np.uint64(3))
            leaves = np.delete(descend(parents), child_places(codes, parents))
            self.refined.append(parents)
            starts.append(leaves << np.uint64(3 * (level - 1)))
            levels.append(np.full(len(leaves), level))
        order = np.argsort(np.concatenate(starts))
        self.starts, self.levels = np.concatenate(starts)[order], np.concatenate(levels)[order]
        self.ranks = np.where(self.levels == 0, np.cumsum(self.levels == 0) - 1, -1)
        self.side = 1 << (top - 1)  # in level-1 cells
        cells = morton_decode(nodes)
        self._beside = {d: self._beside_cells(cells + d) for d in (HERE, *AROUND)}

    def leaf_at(self, codes: np.ndarray, level: int) -> np.ndarray:
        """Return the number of the first leaf or level-1 node in each cell of a level, or of the
        leaf around the cell."""
        return np.searchsorted(self.starts, codes << np.uint64(3 * (level - 1)), "right") - 1

    def holds(self, cells: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) bool, True for cells of a level that lie in the octree."""
        return np.all((cells >= 0) & (cells < self.side >> (level - 1)), axis=1)

    def _beside_cells(self, cells: np.ndarray) -> np.ndarray:
        """Return the numbers of the nodes at level-1 cells; the last leaf stands for all that lies
        beyond the octree, for both are outside."""
        numbers = np.full(len(cells), len(self.starts) - 1)
        within = self.holds(cells, 1)
        numbers[within] = self.leaf_at(morton_encode(cells[within]), 1)
        return numbers

    def neighbours(self, d: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the brick next to each brick in direction d, or -1, and the number of the node
        that holds the place."""
        place = morton_decode(np.arange(8)) + np.array(d)
        numbers = np.stack([self._beside[x, y, z] for x, y, z in (place >> 1).tolist()], axis=1)
        ranks, octants = self.ranks[numbers], morton_encode(place & 1).astype(np.int64)
        return np.where(ranks >= 0, 8 * ranks + octants, -1).ravel(), numbers.ravel()

    def spread(self, masks: np.ndarray, reached: np.ndarray) -> np.ndarray:
        """Return the voxels of bricks that touch voxels of masks or reached leaves."""
        found = _spilled(masks, HERE)
        for d in AROUND:
            brick, leaf = self.neighbours(d)
            beside = np.where(brick >= 0, masks[brick], np.where(reached[leaf], ALL, ALL ^ ALL))
            found |= _spilled(beside, (-d[0], -d[1], -d[2]))
        return found


def _reach(octree: _Octree, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what the outside reaches: (nodes,) bool for leaves, and the (bricks,) masks of free
    voxels."""
    brick, part = _parts(free)
    first = np.searchsorted(brick, np.arange(len(free) + 1))
    count = np.diff(first)
    base = len(octree.starts)  # leaves are numbered before parts
    links = []
    for d in AROUND:
        other, leaf = (each[brick] for each in octree.neighbours(d))
        spilled = _spilled(part, d)
        touches = spilled != 0
        at = np.flatnonzero(touches & (other < 0))
        links.append((base + at, leaf[at]))
        if d < HERE:
            continue  # found from the other side
        at = np.flatnonzero(touches & (other >= 0))
        for i in range(int(count.max(initial=0))):
            at = at[count[other[at]] > i]
            match = first[other[at]] + i
            met = (spilled[at] & part[match]) != 0
            links.append((base + at[met], base + match[met]))
    for level in range(1, len(octree.refined)):
        own = np.flatnonzero(octree.levels == level)
        cells = morton_decode(octree.starts[own] >> np.uint64(3 * (level - 1)))
        for d in AROUND:
            beside = cells + d
            at = np.flatnonzero(octree.holds(beside, level))
            found = octree.leaf_at(morton_encode(beside[at]), level)
            large = octree.levels[found] >= level  # the leaves in a refined node find this one
            links.append((own[at[large]], found[large]))
    u, v = (np.concatenate(ends) for ends in zip(*links, strict=True))
    root = components(u, v, base + len(part))
    is_out = root == root[base - 1]  # the last leaf lies in a far corner
    masks = np.zeros(len(free), np.uint64)
    out = np.flatnonzero(is_out[base:])
    np.bitwise_or.at(masks, brick[out], part[out])
    return is_out[:base], masks


# ---- masks of bricks


def _spilled(mask: np.ndarray, d: tuple[int, int, int]) -> np.ndarray:
    """Return the voxels of the brick in direction d that touch voxels of a mask."""
    for axis, step in enumerate(d):
        mask = _spilled_along(axis, mask, step)
    return mask


def _spilled_along(axis: int, mask: np.ndarray, step: int) -> np.ndarray:
    """Return the same along one axis: voxels that differ in the other coordinates do not touch."""
    low, one, two, three = LOW[axis], *(np.uint64(n << axis) for n in (1, 8, 9))
    if step > 0:
        return (mask >> three) & low
    if step < 0:
        return (mask & low) << three
    up = (mask & (low | low << two)) << one | (mask & low << one) << (two - one)
    down = (mask >> one) & (low | low << two) | (mask >> (two - one)) & low << one
    return mask | up | down


def _parts(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the connected components of bricks: (n,) ascending bricks, and (n,) masks."""
    bricks, parts = [], []
    brick = np.flatnonzero(free)
    left = free[brick]
    while len(brick):
        part = left & (~left + np.uint64(1))  # the lowest voxel
        grows = np.arange(len(part))
        while len(grows):
            grown = _spilled(part[grows], HERE) & left[grows]
            changed = grown != part[grows]
            part[grows] = grown
            grows = grows[changed]
        bricks.append(brick)
        parts.append(part)
        left = left & ~part
        brick, left = brick[left != 0], left[left != 0]
    if not bricks:
        return np.empty(0, np.int64), np.empty(0, np.uint64)
    found, masks = np.concatenate(bricks), np.concatenate(parts)
    order = np.argsort(found, kind="stable")
    return found[order], masks[order]


def _dilate(nodes: np.ndarray, surface: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the voxels up to a number of steps from a surface: the given level-1 nodes and those
    that hold the voxels, and the masks of their bricks."""
    codes, masks = descend(nodes)[surface != 0], surface[surface != 0]
    for axis in [0, 1, 2] * steps:
        cells, found, grown = morton_decode(codes), [], []
        for step in (-1, 0, 1):
            spilled = _spilled_along(axis, masks, step)
            some = spilled != 0
            found.append(morton_encode(cells[some] + step * np.eye(3, dtype=np.int64)[axis]))
            grown.append(spilled[some])
        codes = np.concatenate(found)
        order = np.argsort(codes, kind="stable")
        codes, masks = unite_bricks(codes[order], np.concatenate(grown)[order])
    wider = np.union1d(nodes, codes >> np.uint64(3))
    barrier = np.zeros(8 * len(wider), np.uint64)
    barrier[child_places(codes, wider)] = masks
    return wider, barrier
