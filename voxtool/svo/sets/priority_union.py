"""Several octrees united into one, whose voxels carry the octree that comes first.

The octrees lie on one lattice. A node of the union is refined if it is in any of them, so that all
are constant in its leaves. Kernels: kernels/svo/sets/priority_union.cl.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from voxtool.morton import distinct
from voxtool.opencl import Array, Device
from voxtool.svo.octree.layout import BRICK
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import child_places

SOURCE = "svo/sets/priority_union.cl"
NONE = (1 << 32) - 1  # no octree
HEADERS = {"svo/sets/priority_union.h": f"#define NONE {NONE:#x}u"}


@dataclass
class Nodes:
    """Nodes of octrees that lie on one lattice, each list with the ranks of the octrees.

    refined : by level, from level 1 up: codes of refined nodes
    full : by level, from level 1 up: codes and ranks of inside leaves
    codes, masks, ranks : those of bricks
    """

    refined: list[list[np.ndarray]]
    full: list[list[tuple[np.ndarray, np.ndarray]]]
    codes: list[np.ndarray] = field(default_factory=list)
    masks: list[np.ndarray] = field(default_factory=list)
    ranks: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of_depth(cls, depth: int) -> Nodes:
        """Return no nodes, for octrees of `depth` levels."""
        return cls([[] for _ in range(depth - 1)], [[] for _ in range(depth - 1)])

    def add(self, level: int, codes: np.ndarray, ranks: np.ndarray, refined: np.ndarray,
            inside: np.ndarray) -> None:  # fmt: skip
        """Add the nodes of a level above 0."""
        self.refined[level - 1].append(codes[refined])
        if inside.any():
            self.full[level - 1].append((codes[inside], ranks[inside]))

    def add_bricks(self, codes: np.ndarray, ranks: np.ndarray, masks: np.ndarray) -> None:
        """Add bricks; the empty ones are passed over."""
        some = masks != 0
        self.codes.append(codes[some])
        self.masks.append(masks[some])
        self.ranks.append(ranks[some])

    def add_octree(self, octree: Octree, rank: int) -> None:
        """Add all nodes of an octree of the same lattice."""
        for level in octree.levels():
            ranks = np.full(len(level.codes), rank, np.uint32)
            if level.number:
                self.add(level.number, level.codes, ranks, level.refined, level.inside)
            else:
                self.add_bricks(level.codes, ranks, octree.bricks)


@dataclass(frozen=True)
class Union:
    """The union on the device and the host.

    codes : (n,) uint64, of the refined level-1 nodes
    levels : states of the nodes, from the root down to level 1
    leaves : (L,) uint32, the rank of the octree of each inside leaf, in the order of the nodes
    bricks, shared : (8 n,) uint64, the voxels that any octree sets, and those that several set
    starts : uint32, set voxels before each brick
    entries : those of the kernels
    """

    codes: np.ndarray
    levels: list[np.ndarray]
    leaves: np.ndarray
    bricks: Array
    shared: Array
    starts: np.ndarray
    entries: dict[str, Array]

    @property
    def values(self) -> int:
        """Set voxels of the bricks."""
        return int(self.starts[-1])


def unite(device: Device, nodes: Nodes) -> Union:
    """Return the union of the octrees of some nodes."""
    refined = _refined(nodes)
    states, first = [], np.full(1, NONE, np.uint32)  # of the root: what fills it first
    leaves = []
    top = len(refined)
    for number in range(top, 0, -1):
        parents = refined[number] if number < top else None
        state = np.full(len(first), EMPTY, np.uint8)
        for codes, ranks in nodes.full[number - 1]:
            places = np.zeros(1, int) if parents is None else child_places(codes, parents)
            np.minimum.at(first, places, ranks)
        state[first != NONE] = FULL
        own = refined[number - 1]
        places = own.astype(int) if parents is None else child_places(own, parents)
        state[places] = REFINED
        leaves.append(first[state == FULL])
        states.append(state)
        first = np.repeat(first[state == REFINED], 8)
    return _bricks(device, nodes, refined[0], states, np.concatenate(leaves), first)


def _refined(nodes: Nodes) -> list[np.ndarray]:
    """Return the codes of the refined nodes by level, from level 1 up; they ascend."""
    none = np.empty(0, np.uint64)
    lists: list[np.ndarray] = []
    for own in nodes.refined:
        above = lists[-1] >> np.uint64(3) if lists else none
        lists.append(distinct(np.concatenate([above, *own])))
    return lists


def _bricks(
    device: Device,
    nodes: Nodes,
    codes: np.ndarray,
    states: list[np.ndarray],
    leaves: np.ndarray,
    behind: np.ndarray,
) -> Union:
    """Return the union, whose bricks are united on the device."""
    n = len(behind)
    places = child_places(_joined(nodes.codes, np.uint64), codes)
    ranks, masks = _joined(nodes.ranks, np.uint32), _joined(nodes.masks, BRICK)
    order = np.lexsort([NONE - ranks, places])  # the last octree first
    firsts = np.concatenate([[0], np.cumsum(np.bincount(places, minlength=n))])
    entries = {
        "firsts": device.put(firsts.astype(np.uint32)),
        "ranks": device.put(ranks[order]),
        "masks": device.put(masks[order]),
        "behind": device.put(behind),
    }
    bricks, shared = (device.empty(n, BRICK) for _ in range(2))
    if n:
        kernel = device.kernel(SOURCE, "unite_bricks", VALUE="uint")
        kernel(n, **entries, bricks=bricks, shared=shared)
    counts = np.bitwise_count(bricks.get())
    starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    return Union(codes, states, leaves, bricks, shared, starts, entries)


def _joined(lists: Iterable[np.ndarray], dtype: np.dtype | type) -> np.ndarray:
    return np.concatenate([np.empty(0, dtype), *lists])


def painted(device: Device, union: Union, value_of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of the set voxels of the bricks and of the inside leaves.

    Parameters
    ----------
    value_of : (ranks,) uint8, uint16 or uint32
        The value of each octree.
    """
    name = {1: "uchar", 2: "ushort", 4: "uint"}[value_of.dtype.itemsize]
    values = device.empty(max(union.values, 1), value_of.dtype)
    if union.values:
        device.kernel(SOURCE, "paint_bricks", VALUE=name)(
            len(union.starts) - 1, **union.entries, bricks=union.bricks,
            starts=device.put(union.starts[:-1].astype(np.uint32)),
            value_of=device.put(value_of), values=values,
        )  # fmt: skip
    return values.get(0, union.values), value_of[union.leaves]
