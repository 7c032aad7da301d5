"""Rows of voxel centres along x: their crossings with a mesh, and the voxels between flips
([voCCeL], section 3.2, eq. 3.5 and fig. 3.6).

A flip is a voxel at which a row changes between inside and outside: a voxel is inside if the number
of flips up to it along x is odd. With the parity rule, every crossing flips the first voxel at or
beyond it. The other rules first list and sort the crossings and count them along the row: +1 where
it enters, -1 where it leaves. A voxel flips where the rule's answer for this count changes.

A work-item traverses the octree along a bundle of 8 x 8 rows, from low x to high. The flips of a
level-1 node change the states of the rows. A leaf above level 0 is inside if all rows through it
are inside.

A leaf in which only some rows are inside is MIXED. No triangle touches such a leaf. It exists if
the mesh is open, or if the grid ends in the leaf. It is refined until all voxels of every leaf are
equal, so that the octree holds exactly the set that the fill rule defines.

A check tells whether parity fills what winding numbers do. The number of the voxels of a row that
winding numbers count is the sum over its crossings, with their signs, of the voxels after each. So
is the sum of their places. If all numbers are 0 and 1, these sums are those of the voxels that
parity sets; if they are 0 and -1, their negative. Sums are taken in bundles, weighed by
pseudo-random numbers, modulo 2^32 (sums.h). They can agree by chance with a probability of 2^-64,
or where in each bundle voxels with a number of 2 or more and voxels with a negative one are as many
and have the same middle.

Kernels: crossings.cl and rows.cl in kernels/svo/voxelization/fill.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from voxtool.errors import MemoryLimitError, VoxtoolError, human
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Array, program
from voxtool.opencl.primitives import exclusive_scan, radix_sort, unique
from voxtool.svo.octree.build import DeviceOctree, build_from_lists
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES, MAX_LINK, NODE_BYTES, VALID
from voxtool.svo.voxelization.scan_conversion import CROSSED, ActiveNodes, Scan

CROSSINGS, SOURCE = "svo/voxelization/fill/crossings.cl", "svo/voxelization/fill/rows.cl"
# Bit 0 of a key is unused: Oclgrind 21.10 does not support the shift that it would need.
ENTERS = 2
MIXED = np.uint32(1 << 29)  # a leaf that must be refined
HEADERS = {
    "svo/voxelization/fill/crossings.h": program.c_constants(ENTERS=ENTERS),
    "svo/voxelization/fill/rows.h": program.c_constants(MIXED=MIXED),
}
ALL_ROWS = ~np.uint64(0)


@dataclass(frozen=True)
class Crossings:
    """The sorted crossings of rows with a mesh.

    A key holds the row, then in x_bits - 2 bits the first voxel at or beyond the crossing, counted
    from -1, and ENTERS if the row enters the mesh there.
    """

    keys: Array  # (n,) uint64
    n: int
    x_bits: int
    faces: Array | None  # (n,) uint32 faces crossed, if they were asked for


@dataclass(frozen=True)
class Flips:
    """The voxels at which rows change between inside and outside."""

    bricks: Array  # (8 n,) uint64 masks of the n active nodes
    shape: tuple[int, int, int]  # voxels of the grid
    entry: Array | None  # (bundles,) uint64 states at x = 0, one bit a row; None if all are outside
    sums: Array | None = None  # (m, 2) uint32 of crossings, to be checked; None if they are not

    @property
    def bundles(self) -> int:
        """Bundles of 8 x 8 rows."""
        return self.bundles_y * -(-self.shape[2] // 8)

    @property
    def bundles_y(self) -> int:
        """Bundles along y."""
        return -(-self.shape[1] // 8)


def no_flips(scan: Scan, active: ActiveNodes) -> Flips:
    """Return flips of which none is set."""
    bricks, shape = scan.device.zeros(8 * active.nodes.n, BRICK), scan.plan.shape
    bundles = Flips(bricks, shape, None).bundles
    return Flips(bricks, shape, scan.device.zeros(bundles, np.uint64) if scan.plan.entry else None)


def flip_crossings(scan: Scan, active: ActiveNodes) -> Flips:
    """Return the flips of the parity rule."""
    flips = no_flips(scan, active)
    n, triangles = scan.shares(CROSSED)
    sums = scan.device.zeros(2 * n, np.uint32) if scan.plan.checked else None
    flip = scan.kernel(CROSSINGS, "flip_crossings")
    flip(n, flips.bricks, flips.entry, sums, **triangles, **active.lookup)
    return replace(flips, sums=sums)


def list_crossings(scan: Scan, *, axis: int = 0, with_faces: bool = False) -> Crossings:
    """Return the crossings with the mesh and its caps; those of equal keys in the order of the
    faces. The coordinates of the mesh and its grid were rotated so that `axis` comes first."""
    nx, ny, nz = scan.plan.shape
    x_bits = nx.bit_length() + 2
    n, triangles = scan.shares(CROSSED, faces=scan.mesh.closed)
    firsts = scan.device.empty(n + 1, np.uint32)
    list_crossings = scan.kernel(CROSSINGS, "list_crossings", LISTED=1)
    list_crossings(n, firsts, x_bits, axis, None, None, **triangles)
    count = exclusive_scan(firsts, n)
    keys = scan.device.empty(count, np.uint64)
    faces = scan.device.empty(count, np.uint32) if with_faces else None
    list_crossings(n, firsts, x_bits, axis, keys, faces, **triangles)
    bits = (ny * nz - 1).bit_length() + x_bits
    if faces is None:
        keys, _ = radix_sort(keys, count, bits)
    else:
        keys, faces = radix_sort(keys, count, bits, faces)
    return Crossings(keys, count, x_bits, faces)


def flip_changes(scan: Scan, active: ActiveNodes, crossings: Crossings) -> Flips:
    """Return the flips of the rules that count directions: nonzero, and winding far from holes."""
    flips = no_flips(scan, active)
    keys, n, x_bits = crossings.keys, crossings.n, crossings.x_bits
    nonzero, shape = scan.plan.fill == "nonzero", scan.plan.shape
    flip = scan.kernel(CROSSINGS, "flip_changes", LISTED=1)
    flip(n, keys, x_bits, nonzero, shape, flips.bricks, flips.entry, **active.lookup)
    return flips


@dataclass(frozen=True)
class Filled:
    """An octree on the device with its inside voxels and leaves."""

    tree: DeviceOctree
    bricks: Array  # (8 n,) uint64 masks
    # (m,) uint32 index of each active node among the refined level-1 nodes; None if they are equal
    positions: np.ndarray | None
    certain: bool = True  # False if winding numbers other than 0 and 1 were found by a check

    def unite(self, added: Array) -> None:
        """Add the voxels of the active nodes' bricks `added`."""
        positions = self.positions
        if positions is None:
            positions = np.arange(added.size // 8, dtype=np.uint32)
        unite_nodes(added, positions, self.bricks)


def fill_rows(tree: DeviceOctree, flips: Flips, max_memory: int, by_levels: bool = False) -> Filled:
    """Return the octree of the active nodes, filled between flips; changes the tree's nodes and the
    flips' bricks. Raises MemoryLimitError if an open mesh needs an octree of more than max_memory
    bytes, which a plan cannot predict. If `by_levels`, rows are walked only where flips cannot be
    propagated level by level."""
    device, positions = tree.nodes.device, None
    if by_levels and flips.entry is None:
        with device.stage("levels"):
            from voxtool.svo.voxelization.fill.propagation import propagate

            bricks = propagate(tree, flips.bricks, flips.shape)
        if bricks is not None:
            return Filled(tree, bricks, None)
    with device.stage("rows"):
        entries, leaves, unresolved = _walk_rows(tree, flips)
    if unresolved:
        with device.stage("refine open rows"):
            lists, positions = _refine_open_rows(tree, flips, max_memory)
            moved = device.zeros(8 * len(lists[0]), BRICK)
            unite_nodes(flips.bricks, positions, moved)
            tree, flips = build_from_lists(device, lists), replace(flips, bricks=moved)
            entries, leaves, unresolved = _walk_rows(tree, flips)
            if unresolved:
                raise VoxtoolError(
                    f"{unresolved} leaves are neither inside nor outside: report this mesh"
                )
    with device.stage("fill"):
        level1 = tree.refined[0]
        sums = device.empty(2 * level1.n, np.uint32) if flips.sums else None
        fill_bricks = tree.kernel(SOURCE, "fill_bricks")
        fill_bricks(level1.n, level1.codes, flips.shape, entries, flips.bricks, sums)
    certain = not (flips.sums and sums and leaves) or _agree(flips.sums, sums, leaves)
    return Filled(tree, flips.bricks, positions, certain)


def _agree(crossings: Array, *voxels: Array) -> bool:
    """Return whether the sums of crossings are those of the voxels that parity sets, or their
    negative."""
    counted, *filled = (
        np.array([numbers[i::2].sum(dtype=np.uint32) for i in range(2)])
        for numbers in (array.take() for array in (crossings, *voxels))
    )
    found = np.sum(filled, axis=0, dtype=np.uint32)
    return np.array_equal(counted, found) or np.array_equal(counted, np.uint32(0) - found)


def unite_nodes(added: Array, positions: np.ndarray, bricks: Array) -> None:
    """Add the voxels of the bricks of level-1 nodes to those of the nodes at their positions."""
    device = added.device
    unite_bricks = device.kernel(SOURCE, "unite_bricks", CODE="uint")
    unite_bricks(added.size, added, device.put(positions), bricks)


def _walk_rows(tree: DeviceOctree, flips: Flips) -> tuple[Array, Array | None, int]:
    """Mark leaves of the tree as INSIDE, or as MIXED if only some of their rows are inside. Return
    the states of rows where they enter the level-1 nodes, (n,) uint64, the sums of leaves if flips
    have some, and the number of MIXED leaves."""
    device, coarse = tree.nodes.device, int(tree.offsets[-2])
    entries = device.empty(tree.refined[0].n, np.uint64)
    fills = device.zeros(coarse, np.uint32)
    chosen, n = _crossed_bundles(tree, flips)
    sums = device.empty(2 * n, np.uint32) if flips.sums else None
    _sweep_rows(tree, flips, n, chosen=chosen, entries=entries, fills=fills, sums=sums)
    unresolved = device.zeros(1, np.uint32)
    offsets = device.put(tree.offsets)
    tree.kernel(SOURCE, "mark_leaves")(coarse, tree.nodes, offsets, tree.top, fills, unresolved)
    return entries, sums, int(unresolved.take()[0])


def _crossed_bundles(tree: DeviceOctree, flips: Flips) -> tuple[Array | None, int]:
    """Return the bundles that need to be traversed, and their number; None: all. If all rows begin
    outside, only those that pass through level-1 nodes change, which are listed if that is less
    work."""
    level1 = tree.refined[0]
    if flips.entry is not None or level1.n >= flips.bundles:
        return None, flips.bundles
    bundles = tree.nodes.device.empty(level1.n, np.uint32)
    tree.kernel(SOURCE, "list_bundles")(level1.n, level1.codes, flips.shape, bundles)
    bundles, _ = radix_sort(bundles, level1.n, (flips.bundles - 1).bit_length())
    return unique(bundles, level1.n)


def _sweep_rows(tree: DeviceOctree, flips: Flips, bundles: int, **recorded: Array | None) -> None:
    """Traverse rows, all or the `chosen` bundles, and record the states where they enter level-1
    nodes in `entries`, and how leaves are filled in `fills`; or their `states` in the leaves that
    are to be refined."""
    arguments: dict[str, Any] = {
        **dict.fromkeys(("chosen", "entries", "fills", "states", "sums")),
        "nodes": tree.nodes,
        "offsets": tree.nodes.device.put(tree.offsets),
        "top": tree.top,
        "shape": flips.shape,
        "entry": flips.entry,
        "bricks": flips.bricks,
        **recorded,
    }
    tree.kernel(SOURCE, "sweep_rows")(bundles, **arguments)


def _refine_open_rows(
    tree: DeviceOctree, flips: Flips, max_memory: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Refine the MIXED leaves of a tree; raise MemoryLimitError if this takes more than max_memory
    bytes. Return the ascending Morton codes of the refined nodes by level, from level 1 up, and the
    (n,) uint32 positions of the tree's level-1 nodes among them."""
    device, nodes = tree.nodes.device, tree.nodes.get(0, int(tree.offsets[-2]))
    lists = [refined.codes.get(0, refined.n) for refined in tree.refined]
    mixed = (nodes["child"] & (VALID | MIXED)) == MIXED
    leaves, slots = [], 0  # a slot holds the state of a bundle in a leaf
    for level in range(1, tree.top + 1):
        first, end = tree.offsets[tree.top - level : tree.top - level + 2].tolist()
        leaf = np.flatnonzero(mixed[first:end])
        codes = leaf.astype(np.uint64)
        if level < tree.top:
            codes = lists[level][leaf >> 3].astype(np.uint64) << np.uint64(3) | codes & np.uint64(7)
        side = 1 << (level - 1)  # of a leaf, in level-1 cells
        places = slots + side * side * np.arange(len(leaf) + 1)
        slots = int(places[-1])
        leaves.append((level, first + leaf, morton_decode(codes) * side, places))
    refuse_beyond(tree, 0, slots, max_memory)
    for _, own, _, places in leaves:
        nodes["child"][own] = places[:-1] + 1
    device.write(tree.nodes, nodes)
    states = device.zeros(slots, np.uint64)
    chosen = _bundles_of(leaves, flips)
    _sweep_rows(tree, flips, len(chosen), chosen=device.put(chosen), states=states)
    found = states.take()

    bars = []
    for level, _, corners, places in leaves:
        layers = found[places[0] : places[-1]].reshape(-1, 1 << (level - 1), 1 << (level - 1))
        bars += _differing_bars(layers, corners, level, flips.shape[0])
    added = sum(int(lengths.sum()) for _, _, lengths in bars)
    refuse_beyond(tree, added, 0, max_memory)

    merged = []
    for number, old in enumerate(lists, 1):
        own = [bar[1:] for bar in bars if bar[0] == number]
        codes = _codes_of_bars(*(np.concatenate(each) for each in zip(*own, strict=True)))
        merged.append(np.sort(np.concatenate([old, codes.astype(old.dtype)])))
    return merged, np.searchsorted(merged[0], lists[0]).astype(np.uint32)


def refuse_beyond(tree: DeviceOctree, added: int, slots: int, max_memory: int) -> None:
    """Raise MemoryLimitError if a tree with added refined nodes and slots does not fit."""
    nodes = int(tree.offsets[-1]) + 8 * added
    needed = nodes * (NODE_BYTES + 2 * BRICK_BYTES) + 8 * slots  # moving copies the bricks
    if max(nodes, slots) >= MAX_LINK or needed > max_memory:
        raise MemoryLimitError(
            f"the fill leaks from this open mesh and refines the octree to {nodes:,} nodes, "
            f"{human(needed)}, more than fits: close the mesh, or choose a smaller dim or a "
            "surface mode"
        )


def _bundles_of(leaves: list[tuple[int, Any, np.ndarray, Any]], flips: Flips) -> np.ndarray:
    """Return the bundles whose rows pass through leaves, without duplicates, (n,) uint32."""
    passed = np.zeros((flips.bundles // flips.bundles_y, flips.bundles_y), bool)
    for level, _, corners, _ in leaves:
        y, z = (corners[:, a, None] + np.arange(1 << (level - 1)) for a in (1, 2))
        y, z = np.minimum(y, passed.shape[1] - 1), np.minimum(z, passed.shape[0] - 1)
        passed[z[:, :, None], y[:, None, :]] = True
    return np.flatnonzero(passed).astype(np.uint32)


def _differing_bars(
    layers: np.ndarray, corners: np.ndarray, level: int, nx: int
) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return the nodes in leaves of one level whose voxels differ, as bars along x: for each level
    up to that of the leaves, its number, the (m, 3) first nodes of bars, and their (m,) lengths.

    `layers` holds the states of the leaves' bundles, (n, side, side) uint64 [leaf, z, y], and
    `corners` their (n, 3) low corners in level-1 cells. Along x, a leaf changes only where the grid
    ends, at voxel nx.
    """
    bars = []
    every, some = layers, layers
    for number in range(1, level + 1):
        size = 1 << (number - 1)  # of a node, in cells
        places = 1 << (level - number)  # nodes along x in a leaf
        if number > 1:
            every, some = _halve(every, np.bitwise_and), _halve(some, np.bitwise_or)
        whole = (nx // 8 - corners[:, 0]) // size  # nodes before the end of the grid
        whole = np.clip(whole, 0, places)
        cut = (whole < places) & (8 * (corners[:, 0] + size * whole) < nx)  # the end lies in a node

        leaf, k, j = np.nonzero((some != 0) & (every != ALL_ROWS))
        first = corners[leaf] // size + np.stack([np.zeros_like(j), j, k], axis=1)
        bars.append((number, first, whole[leaf]))

        leaf, k, j = np.nonzero((some != 0) & cut[:, None, None])
        first = corners[leaf] // size + np.stack([whole[leaf], j, k], axis=1)
        bars.append((number, first, np.ones_like(leaf)))
    return bars


def _codes_of_bars(first: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the Morton codes of the nodes of bars along x."""
    nodes = np.repeat(first, lengths, axis=0)
    nodes[:, 0] += np.arange(len(nodes)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return morton_encode(nodes)


def _halve(layers: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combine 2 x 2 bundles into one."""
    rows = combine(layers[:, 0::2], layers[:, 1::2])
    return combine(rows[:, :, 0::2], rows[:, :, 1::2])
