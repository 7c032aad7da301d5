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
        first, end = (np.uint64(cube << 3 * (top - level)) for cube in (7, 8))
        kept = slice(*np.searchsorted(octree.lists[level - 1], [first, end]).tolist())
        lists.append(octree.lists[level - 1][kept] ^ first)
        number, codes = octree.nodes(level)
        state = np.where(reached[number], EMPTY, FULL).astype(np.uint8)
        state[octree.refined[level - 1]] = REFINED
        states.append(state[slice(*np.searchsorted(codes, [first, end]).tolist())])
        if level == 1:
            bricks = slice(8 * kept.start, 8 * kept.stop)
    within = voxels_within(morton_decode(descend(lists[0])), shape)
    return lists, states, ~outside[bricks] & within


class _Octree:
    """The octree of given level-1 nodes, with the neighbours of its bricks.

    `lists` holds the codes of the refined nodes by level, from level 1 up, and `refined` their
    positions among all nodes of their level. Nodes are numbered from `first` of their level on.
    """

    def __init__(self, nodes: np.ndarray, top: int) -> None:
        self.lists = [nodes]
        for _ in range(top - 1):
            self.lists.append(np.unique(self.lists[-1] >> np.uint64(3)))
        self.refined, sizes = [], []
        for codes, above in zip(self.lists[:-1], self.lists[1:], strict=True):
            self.refined.append(child_places(codes, above))
            sizes.append(8 * len(above))
        self.refined.append(np.zeros(len(self.lists[-1]), np.int64))
        *self.first, self.total = np.cumsum([0, *sizes, 1]).tolist()
        cells = morton_decode(nodes)
        self.beside = {d: self._node_at(cells + d) for d in AROUND}

    def _node_at(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ranks of the level-1 nodes at cells (-1 if there is none), and the numbers of
        the leaves there (-1 if there is none, or beyond the octree)."""
        rank, leaf = np.full(len(cells), -1), np.full(len(cells), -1)
        some = np.flatnonzero(self.holds(cells, 1))
        level, number = self.find(morton_encode(cells[some]), 1)
        inner = level == 0
        rank[some[inner]], leaf[some[~inner]] = number[inner], number[~inner]
        return rank, leaf

    def find(self, codes: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the level and the number of the leaf that holds each cell of level `least`; for a
        refined cell, 0 and its rank among the refined cells."""
        levels, numbers = np.zeros(len(codes), np.int64), np.zeros(len(codes), np.int64)
        left, parent = np.arange(len(codes)), np.zeros(len(codes), np.int64)
        for level in range(len(self.lists), least - 1, -1):
            code = codes[left] >> np.uint64(3 * (level - least))
            is_root = level == len(self.lists)
            number = np.zeros(len(left), np.int64)
            if not is_root:
                number = 8 * parent + (code & np.uint64(7)).astype(np.int64)
            known = self.lists[level - 1]
            rank = np.minimum(np.searchsorted(known, code), max(len(known) - 1, 0))
            found = known[rank] == code if len(known) else np.zeros(len(code), bool)
            leaf = left[~found]
            levels[leaf], numbers[leaf] = level, self.first[level - 1] + number[~found]
            left, parent = left[found], rank[found]
        numbers[left] = parent
        return levels, numbers

    def nodes(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers and the codes of all nodes of a level."""
        is_root = level == len(self.lists)
        codes = np.zeros(1, np.uint64) if is_root else descend(self.lists[level])
        return self.first[level - 1] + np.arange(len(codes)), codes

    def holds(self, cells: np.ndarray, level: int) -> np.ndarray:
        """Return (n,) bool, True for cells of a level that lie in the octree."""
        within = (cells >= 0) & (cells < 1 << (len(self.lists) - level))
        return np.all(within, axis=1)

    def neighbours(self, d: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the brick next to each brick in direction d, or -1, and the leaf there, or -1."""
        octant = np.arange(8)
        place = np.stack([octant & 1, octant >> 1 & 1, octant >> 2], axis=1) + d
        step = place >> 1  # to the neighbouring node
        other = (place & 1) @ np.array([1, 2, 4])
        ranks, leaves = (np.empty((len(self.lists[0]), 8), np.int64) for _ in range(2))
        for o in range(8):
            if not step[o].any():
                ranks[:, o], leaves[:, o] = 8 * np.arange(len(ranks)) + other[o], -1
                continue
            rank, leaf = self.beside[tuple(step[o].tolist())]
            ranks[:, o], leaves[:, o] = np.where(rank >= 0, 8 * rank + other[o], -1), leaf
        return ranks.ravel(), leaves.ravel()

    def spread(self, masks: np.ndarray, reached: np.ndarray) -> np.ndarray:
        """Return the voxels of bricks that touch voxels of masks or reached leaves."""
        found = _spilled(masks, HERE)
        for d in AROUND:
            rank, leaf = self.neighbours(d)
            beside = np.where(rank >= 0, masks[rank], np.uint64(0))
            beside[(leaf >= 0) & reached[leaf]] = ALL
            found |= _spilled(beside, (-d[0], -d[1], -d[2]))
        return found


def _reach(octree: _Octree, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what the outside reaches: (nodes,) bool for leaves, and the (bricks,) masks of free
    voxels."""
    brick, part = _parts(free)
    first = np.searchsorted(brick, np.arange(len(free) + 1))
    count = np.diff(first)
    base = octree.total  # leaves are numbered before parts
    links = []
    for d in AROUND:
        rank, leaf = octree.neighbours(d)
        spilled = _spilled(part, d)
        touches = spilled != 0
        beside = leaf[brick]
        at = np.flatnonzero(touches & (beside >= 0))
        links.append((base + at, beside[at]))
        if d < HERE:
            continue  # found from the other side
        other = rank[brick]
        at = np.flatnonzero(touches & (other >= 0))
        for i in range(int(count.max(initial=0))):
            at = at[count[other[at]] > i]
            match = first[other[at]] + i
            met = (spilled[at] & part[match]) != 0
            links.append((base + at[met], base + match[met]))
    for level in range(1, len(octree.lists) + 1):
        own, codes = octree.nodes(level)
        leaves = np.delete(np.arange(len(own)), octree.refined[level - 1])
        own, cells = own[leaves], morton_decode(codes[leaves])
        for d in AROUND:
            beside = cells + d
            at = np.flatnonzero(octree.holds(beside, level))
            found, number = octree.find(morton_encode(beside[at]), level)
            leaf = found > 0  # the leaves in a refined node find this one
            links.append((own[at[leaf]], number[leaf]))
    u, v = (np.concatenate(ends) for ends in zip(*links, strict=True))
    root = components(u, v, base + len(part))
    far = np.full(1, 8 ** (len(octree.lists) - 1) - 1, np.uint64)  # the last cell
    is_out = root == root[octree.find(far, 1)[1]]
    masks = np.zeros(len(free), np.uint64)
    out = np.flatnonzero(is_out[base:])
    np.bitwise_or.at(masks, brick[out], part[out])
    return is_out[:base], masks


# ---- masks of bricks


def _spilled(mask: np.ndarray, d: tuple[int, int, int]) -> np.ndarray:
    """Return the voxels of the brick in direction d that touch voxels of a mask."""
    for axis, step in enumerate(d):
        low, one, two, three = LOW[axis], *(np.uint64(n << axis) for n in (1, 8, 9))
        if step > 0:
            mask = (mask >> three) & low
        elif step < 0:
            mask = (mask & low) << three
        else:
            up = (mask & (low | low << two)) << one | (mask & low << one) << (two - one)
            down = (mask >> one) & (low | low << two) | (mask >> (two - one)) & low << one
            mask = mask | up | down
    return mask


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
    for _ in range(steps):
        cells, found, grown = morton_decode(codes), [codes], [_spilled(masks, HERE)]
        for d in AROUND:
            spilled = _spilled(masks, d)
            some = spilled != 0
            found.append(morton_encode(cells[some] + d))
            grown.append(spilled[some])
        codes = np.concatenate(found)
        order = np.argsort(codes)
        codes, masks = unite_bricks(codes[order], np.concatenate(grown)[order])
    wider = np.union1d(nodes, codes >> np.uint64(3))
    barrier = np.zeros(8 * len(wider), np.uint64)
    barrier[child_places(codes, wider)] = masks
    return wider, barrier
