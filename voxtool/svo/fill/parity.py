"""Fill rules: which voxels are inside, from the crossings of rows along x.

Parity, as in the thesis (section 3.2, fig. 3.6): a voxel is inside where the number of crossings
before its centre is odd. A tile of 8 x 8 rows walks the octree from low x to high: nodes of level 1
turn its state by their flips, leaves above are inside where every tile in them says so.

Where tiles disagree in a leaf, or the grid ends in it, parity does not follow the nodes that
triangles touch: the mesh is open, or is cut. There the leaf is refined until every leaf is of one
kind, so that the octree holds exactly the set that the rule defines.

Kernels: kernels/svo/fill/parity.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Array, Device, program
from voxtool.svo.build import DeviceOctree, build_from_lists, code_name
from voxtool.svo.layout import BRICK, BRICK_BYTES, LINK, MAX_LINK, NODE_BYTES, VALID

SOURCE = "svo/fill/parity.cl"
MIXED = np.uint32(1 << 29)  # a leaf that must be refined
HEADERS = {"svo/fill/parity.h": program.c_constants(MIXED=MIXED)}
ALL_ROWS = np.uint64(0xFFFFFFFFFFFFFFFF)


@dataclass(frozen=True)
class Rows:
    """The rows of a grid along x, in tiles of 8 x 8.

    shape : voxels of the grid; entry : (tiles,) uint64 states at x = 0, or None where all are 0.
    """

    shape: tuple[int, int, int]
    entry: Array | None

    @property
    def tiles_y(self) -> int:
        return -(-self.shape[1] // 8)

    @property
    def tiles(self) -> int:
        return self.tiles_y * -(-self.shape[2] // 8)


def fill_parity(
    device: Device, tree: DeviceOctree, flips: Array, rows: Rows, max_memory: int
) -> tuple[DeviceOctree, Array, np.ndarray | None]:
    """From the flips of the active nodes to the inside voxels and leaves.

    Parameters
    ----------
    tree : the octree of the active nodes, consumed; flips : its bricks, consumed: 1 where a row
        of voxels changes between inside and outside; max_memory : bytes that the octree of an
        open mesh, which no plan can tell, may take on the device.

    Returns
    -------
    The octree with its inside leaves; its bricks; and where the active nodes are among its refined
    level-1 nodes ((n,) uint32, None if they are all).
    """
    with device.stage("rows"):
        entries, unresolved = _walk_rows(device, tree, flips, rows)
    positions = None
    if unresolved:
        with device.stage("refine open rows"):
            lists, positions = _refine(device, tree, flips, rows, entries, max_memory)
            tree.release()
            tree = build_from_lists(device, lists)
            flips = _move(device, flips, positions, tree.refined[0].n)
            entries.release()
            entries, unresolved = _walk_rows(device, tree, flips, rows)
            if unresolved:
                raise VoxtoolError(
                    f"{unresolved} leaves are still of no one kind: report this mesh"
                )
    with device.stage("fill"):
        level1 = tree.refined[0]
        fill_bricks = device.kernel(SOURCE, "fill_bricks", CODE=code_name(level1.codes.dtype))
        shape = np.array([*rows.shape, 0], np.int32)
        fill_bricks(level1.n, level1.codes, np.uint32(level1.n), shape, entries, flips)
        entries.release()
    return tree, flips, positions


def _walk_rows(device: Device, tree: DeviceOctree, flips: Array, rows: Rows) -> tuple[Array, int]:
    """The states of rows on entry to each level-1 node; and how many leaves are of no one kind."""
    coarse = int(tree.offsets[-2])
    entries = device.empty(tree.refined[0].n, np.uint64)
    fills = device.zeros(coarse, np.uint32)
    _sweep(device, tree, flips, rows, entries, fills=fills)
    unresolved = device.zeros(1, np.uint32)
    mark_leaves = device.kernel(SOURCE, "mark_leaves", CODE=code_name(tree.refined[0].codes.dtype))
    offsets = device.put(tree.offsets)
    top, n = np.uint32(tree.top), np.uint32(coarse)
    mark_leaves(coarse, tree.nodes, offsets, top, n, fills, unresolved)
    count = int(unresolved.take()[0])
    fills.release()
    offsets.release()
    return entries, count


def _sweep(
    device: Device,
    tree: DeviceOctree,
    flips: Array,
    rows: Rows,
    entries: Array,
    *,
    fills: Array | None = None,
    states: Array | None = None,
    tiles: np.ndarray | None = None,
) -> None:
    """Walk the rows, and count what fills each leaf in `fills`; or only those of the given tiles,
    and record their `states` in the leaves to refine."""
    sweep_rows = device.kernel(SOURCE, "sweep_rows", CODE=code_name(tree.refined[0].codes.dtype))
    offsets = device.put(tree.offsets)
    chosen = offsets if tiles is None else device.put(tiles.astype(np.uint32))
    count = rows.tiles if tiles is None else len(tiles)
    sweep_rows(
        count,
        tree.nodes,
        offsets,
        np.uint32(tree.top),
        np.array([*rows.shape, 0], np.int32),
        np.uint32(rows.tiles_y),
        np.uint32(count),
        chosen,
        np.uint32(tiles is not None),
        rows.entry or offsets,
        np.uint32(rows.entry is not None),
        flips,
        entries,
        fills or entries,
        states or entries,
    )
    if tiles is not None:
        chosen.release()
    offsets.release()


def _move(device: Device, flips: Array, positions: np.ndarray, n: int) -> Array:
    """The flips at their nodes' new places, zero elsewhere."""
    moved = device.zeros(8 * n, BRICK)
    kernel = device.kernel(SOURCE, "move_bricks", CODE="uint")
    places = device.put(positions)
    kernel(flips.size, flips, places, np.uint32(flips.size), moved)
    places.release()
    flips.release()
    return moved


def unite(device: Device, bricks: Array, added: Array, positions: np.ndarray | None) -> None:
    """Set in the bricks the voxels of `added`, whose nodes are at `positions` (None: the same)."""
    if positions is None:
        positions = np.arange(added.size // 8, dtype=np.uint32)
    places = device.put(positions)
    kernel = device.kernel(SOURCE, "unite_bricks", CODE="uint")
    kernel(added.size, added, places, np.uint32(added.size), bricks)
    places.release()
    added.release()


# ---- leaves that rows disagree in


def _refine(
    device: Device,
    tree: DeviceOctree,
    flips: Array,
    rows: Rows,
    entries: Array,
    max_memory: int,
) -> tuple[list[np.ndarray], np.ndarray]:
    """The refined nodes with those added whose voxels are not all alike, and where the level-1
    nodes that there were are among them."""
    nodes = tree.nodes.get(0, int(tree.offsets[-2]))
    leaves = np.flatnonzero((nodes["child"] & (VALID | MIXED)) == MIXED)
    level, cells = _locate(tree, nodes["parent"], leaves)
    tiles = 4 ** (level - 1)  # of a leaf: a layer of it across x
    slots = np.concatenate([[0], np.cumsum(tiles)])
    _refuse_beyond(max_memory, tree, 0, int(slots[-1]))
    nodes["child"][leaves] = slots[:-1] + 1
    device.write(tree.nodes, nodes)
    states = device.zeros(int(slots[-1]), np.uint64)
    passed = _tiles_of(cells, level, rows)
    _sweep(device, tree, flips, rows, entries, states=states, tiles=passed)
    found = states.get()
    states.release()

    bars = []
    for number in np.unique(level):
        chosen = level == number
        side = 1 << (int(number) - 1)
        layers = found[slots[:-1][chosen][:, None] + np.arange(side * side)]
        layers = layers.reshape(-1, side, side)
        bars += _differing_bars(layers, cells[chosen], int(number), rows.shape[0])
    _refuse_beyond(max_memory, tree, sum(int(lengths.sum()) for _, _, lengths in bars))

    lists = [refined.codes.get(0, refined.n) for refined in tree.refined]
    added: list[list[np.ndarray]] = [[] for _ in lists]
    for number, first, lengths in bars:
        added[number - 1].append(_codes_of_bars(first, lengths).astype(lists[0].dtype))
    new = [
        np.sort(np.concatenate([old[:0], *parts])) for old, parts in zip(lists, added, strict=True)
    ]
    places = [np.searchsorted(old, codes) for old, codes in zip(lists, new, strict=True)]
    merged = [np.insert(*each) for each in zip(lists, places, new, strict=True)]
    before = np.bincount(places[0], minlength=len(lists[0]) + 1)[:-1]
    return merged, (np.arange(len(lists[0])) + np.cumsum(before)).astype(np.uint32)


def _tiles_of(cells: np.ndarray, level: np.ndarray, rows: Rows) -> np.ndarray:
    """The tiles whose rows pass through leaves, each once."""
    passed = np.zeros((rows.tiles // rows.tiles_y, rows.tiles_y), bool)
    for number in np.unique(level):
        across = np.arange(1 << (int(number) - 1))
        y = cells[level == number, 1, None] + across
        z = cells[level == number, 2, None] + across
        y, z = np.minimum(y, passed.shape[1] - 1), np.minimum(z, passed.shape[0] - 1)
        passed[z[:, :, None], y[:, None, :]] = True
    return np.flatnonzero(passed)


def _locate(
    tree: DeviceOctree, parents: np.ndarray, leaves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The levels of nodes, and their low corners in level-1 cells ((n, 3) int64)."""
    depth = np.searchsorted(tree.offsets, leaves, side="right") - 1
    level = tree.top - depth
    codes = np.zeros(len(leaves), np.uint64)
    node = leaves - tree.offsets[depth]
    for step in range(int(depth.max())):
        below = depth > 0  # those that have not reached the root
        octant = (node & 7).astype(np.uint64) << np.uint64(3 * step)
        codes[below] |= octant[below]
        parent = parents[tree.offsets[depth] + node] & LINK
        node = np.where(below, parent, node)
        depth = np.where(below, depth - 1, depth)
    return level, morton_decode(codes) << (level - 1)[:, None]


def _refuse_beyond(max_memory: int, tree: DeviceOctree, added: int, slots: int = 0) -> None:
    """Open rows may add more nodes than any plan of the mesh can tell."""
    nodes = int(tree.offsets[-1]) + 8 * added
    needed = nodes * (NODE_BYTES + 2 * BRICK_BYTES) + 8 * slots  # the bricks are moved
    if max(nodes, slots) >= MAX_LINK or needed > max_memory:
        raise MemoryLimitError(
            f"rows that leak through this open mesh refine the octree to {nodes:,} nodes, "
            f"{needed / 1e6:,.1f} MB, more than fits: close the mesh, or choose a smaller dim or a "
            "surface mode"
        )


def _differing_bars(
    layers: np.ndarray, corners: np.ndarray, level: int, nx: int
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """The nodes, in leaves of one level, whose voxels are not all alike, as bars along x.

    Along x nothing changes in a leaf but where the grid ends, at voxel nx.

    Parameters
    ----------
    layers : (n, side, side) uint64 states of a leaf's tiles, [z, y]; corners : (n, 3) of the
        leaves, in level-1 cells.

    Returns
    -------
    For each level below and this one: its number, the (m, 3) first nodes of the bars, counted in
    nodes, and their (m,) lengths.
    """
    bars = []
    every, some = layers, layers
    for number in range(1, level + 1):
        size = 1 << (number - 1)  # of a node, in cells
        places = 1 << (level - number)  # along x in a leaf
        if number > 1:
            every = _halve(every, np.bitwise_and)
            some = _halve(some, np.bitwise_or)
        whole = np.clip((nx // 8 - corners[:, 0]) // size, 0, places)  # nodes before the end
        cut = (whole < places) & (8 * (corners[:, 0] + size * whole) < nx)  # one holds the end

        leaf, k, j = np.nonzero((some != 0) & (every != ALL_ROWS))
        first = corners[leaf] // size + np.stack([np.zeros_like(j), j, k], axis=1)
        bars.append((number, first, whole[leaf]))

        leaf, k, j = np.nonzero((some != 0) & cut[:, None, None])
        first = corners[leaf] // size + np.stack([whole[leaf], j, k], axis=1)
        bars.append((number, first, np.ones_like(leaf)))
    return bars


def _codes_of_bars(first: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The Morton codes of the nodes of bars along x."""
    nodes = np.repeat(first, lengths, axis=0)
    nodes[:, 0] += np.arange(len(nodes)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return morton_encode(nodes)


def _halve(layers: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combine 2 x 2 tiles into one."""
    rows = combine(layers[:, 0::2], layers[:, 1::2])
    return combine(rows[:, :, 0::2], rows[:, :, 1::2])
