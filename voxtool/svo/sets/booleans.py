"""Union, intersection, difference and exclusive or of octrees of one lattice.

Every operation is an exclusive or of the octrees, or an or of some octrees and some complements,
perhaps complemented in the end: A - B - C is the complement of (complement of A) | B | C. The
octrees are traversed together, from the root down. A node of the result is open while an operand
that can still decide it is refined there; so coarse leaves decide large blocks at once. Then nodes
are settled from the bricks up: a node whose children are all empty, or all full, becomes a leaf.
Hundreds of octrees are combined in one pass, as only those that are refined at a node are listed
there.

Kernels: kernels/svo/sets/booleans.cl.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from voxtool.choices import OPERATIONS
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError, count_of
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan, one_call
from voxtool.opencl import Array, Device, default_device, program
from voxtool.opencl.builder import Request
from voxtool.opencl.primitives import SCAN, exclusive_scan
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import (
    BRICK,
    BRICK_BYTES,
    BRICK_SIDE,
    INSIDE,
    LINK,
    MAX_LINK,
    NODE,
    NODE_BYTES,
)
from voxtool.svo.octree.links import EMPTY, FULL, REFINED, states_of
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.attribute_transfer import carried, lost
from voxtool.svo.sets.placing import common_grid, place
from voxtool.units import difference

SOURCE = "svo/sets/booleans.cl"
HEADERS = {"svo/sets/booleans.h": program.c_constants(EMPTY=EMPTY, FULL=FULL, REFINED=REFINED)}
PROGRAMS: list[Request] = [(SOURCE, {}), (SCAN, {})]
STAGES = ("place", "open nodes", "bricks", "settle", "link", "read back")
# Bytes on the device of an open node, with its eight children, without bricks and nodes, and of an
# entry: a refined operand of an open node.
OPEN_BYTES, ENTRY_BYTES = 8 * (4 + 4 + 1) + 4 + 1 + 4 + 1 + 4, 8


@dataclass(frozen=True)
class Terms:
    """An operation on sets: `exclusive`, or the or of operands, of which some are `inverted`."""

    inverted: np.ndarray  # (n,) uint32, 0 or 1
    exclusive: bool = False
    complement: bool = False  # of the result

    def state(self, states: np.ndarray) -> int:
        """Return the state of a node of the result, of the (n,) states of its operands: REFINED if
        refined ones can decide it."""
        value = self.of_leaves(states)
        if (states == REFINED).any() and (self.exclusive or not value):
            return REFINED
        return FULL if value != self.complement else EMPTY

    def of_leaves(self, states: np.ndarray) -> bool:
        """Return what the operands that are leaves make of a node, before the complement."""
        leaves = ((states == FULL) ^ (self.inverted != 0))[states != REFINED]
        return bool(np.bitwise_xor.reduce(leaves) if self.exclusive else leaves.any())

    @classmethod
    def of(cls, operation: str, n: int) -> Terms:
        """Return the terms of one of OPERATIONS with n operands."""
        none = np.zeros(n, np.uint32)
        if operation == "intersection":
            return cls(none + np.uint32(1), complement=True)
        if operation == "difference":
            none[0] = 1
            return cls(none, complement=True)
        return cls(none, exclusive=operation == "xor")


@dataclass(frozen=True)
class CombinePlan(Plan):
    """The plan of a combination, from the numbers of nodes of its operands."""

    stages = STAGES
    facts = (
        "operation", "operands", "moved", "shape: grid.shape", "origin: grid.origin",
        "pitch: grid.pitch", "refined",
    )  # fmt: skip
    costs = ("device", "host")
    refusal = (
        "{plan.operation} of {plan.operands} octrees {shortage}: combine fewer at once, voxelize "
        "at a smaller dim, or allow more (see --max-memory)"
    )

    operation: str
    grid: Grid
    operands: int
    moved: int  # operands whose origin is not that of the result
    refined: tuple[int, ...]  # refined nodes of all operands by level, from level 1 up

    @property
    def open_nodes(self) -> list[int]:
        """The most open nodes of each level, from level 1 up."""
        sides = (self.grid.side // (2 * BRICK_SIDE << level) for level in range(len(self.refined)))
        return [min(n, side**3) for n, side in zip(self.refined, sides, strict=True)]

    @property
    def cost(self) -> Cost:
        """The most bytes on the device, and those of the result on the host."""
        nodes, bricks = NODE_BYTES * (8 * sum(self.open_nodes) + 1), 64 * self.open_nodes[0]
        given = 8 * BRICK_BYTES * self.refined[0]
        entries = ENTRY_BYTES * (self.refined[0] + max(self.refined[1:], default=0))
        working = OPEN_BYTES * sum(self.open_nodes) + entries + 32 * sum(self.refined)
        return Cost(given + working + 2 * bricks + nodes, nodes + bricks, max(given, nodes))

    def rows(self) -> list[tuple[str, str]]:
        shape = " x ".join(map(str, self.grid.shape))
        return [
            ("operation", f"{self.operation}, of {count_of(self.operands, 'octree')}"),
            (
                "octrees",
                f"{8 * self.refined[0]:,} bricks, {sum(self.refined):,} refined nodes; "
                f"{self.moved} moved",
            ),
            ("grid", f"{shape} voxels"),
        ]


def plan_combine(
    octrees: Sequence[OctreeContent],
    operation: str = OPERATIONS[0],
    *,
    device: Device | None = None,
    max_memory: int | None = None,
) -> CombineJob:
    """Return the planned job of `combine`; see `voxtool.combine`. Octrees may stay in files until
    it runs."""
    if operation not in OPERATIONS:
        raise VoxtoolError(
            f"operation {operation!r} is unknown: choose one of {', '.join(OPERATIONS)}"
        )
    if not octrees:
        raise VoxtoolError("there is no octree to combine: give one or more")
    known = [(number, octree.units) for number, octree in enumerate(octrees, 1) if octree.units]
    for number, units in known[1:]:
        hint = "voxelize one again with --lattice, naming the other"
        if message := difference(known[0][1], units, hint):
            raise GridError(f"octrees {known[0][0]} and {number} are {message}")
    grid, lows = common_grid([octree.grid for octree in octrees])
    sizes = [np.diff(octree.offsets.astype(np.int64))[:0:-1] // 8 for octree in octrees]
    plan = plan_of(sizes, lows, grid, operation)
    given: list[Any] = list(octrees)
    return CombineJob(given, lows, plan, device or default_device(), max_memory)


def plan_of(
    sizes: Sequence[np.ndarray], lows: np.ndarray, grid: Grid, operation: str
) -> CombinePlan:
    """Return the plan for octrees.

    sizes : the numbers of refined nodes of each octree, by level from level 1 up; lows : its low
    corner in the grid of the result, in voxels.
    """
    refined = np.zeros((grid.side // BRICK_SIDE).bit_length() - 1, np.int64)
    for own, low in zip(sizes, lows, strict=True):
        own = own[: len(refined)]
        refined[: len(own)] += own * (8 if low.any() else 1)
        refined[len(own) :] += 8 if low.any() else 1
    moved = int(lows.any(axis=1).sum())
    return CombinePlan(operation, grid, len(sizes), moved, tuple(refined.tolist()))


@dataclass
class CombineJob(Job[Octree]):
    """The planned combination of octrees.

    Attributes
    ----------
    octrees : list of Octree
        The operands, in order.
    plan : CombinePlan
        The decisions.
    """

    octrees: list[Octree]
    lows: np.ndarray  # (n, 3) their low corners in the grid of the result
    plan: CombinePlan
    device: Device
    max_memory: int | None = None

    def _run(self) -> Octree:
        self.device.prepare(*PROGRAMS)
        with self.stage("place"):
            operands = self.upload()
        octree = self.octree(*combined(operands, Terms.of(self.plan.operation, operands.n)))
        return self._carried(octree)

    def _carried(self, octree: Octree) -> Octree:
        """Return the result with the attributes of the operands that its voxels are from."""
        sources = self.sources
        if not any(one.attributes for one in sources):
            return octree
        with self.stage("attributes"):
            return carried(octree, sources, list(self.lows[: len(sources)]), self.device)

    @property
    def sources(self) -> list[Octree]:
        """The operands that voxels of the result are from."""
        alone = self.plan.operation in ("intersection", "difference")
        return self.octrees[:1] if alone else self.octrees

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield which attributes are not kept."""
        return lost(self.octrees, result.attributes)

    def upload(self) -> Operands:
        """Return the operands on the device, in the grid of the result."""
        return upload(self.device, self.octrees, self.plan.grid, self.lows)

    def octree(self, *arrays: np.ndarray) -> Octree:
        """Return the octree of a combination's offsets, nodes and bricks."""
        offsets, nodes, bricks = arrays
        content = (self.plan.grid, "solid", "none", offsets, nodes, bricks)
        return Octree(*content, **self.described)

    @property
    def described(self) -> dict[str, Any]:
        """The attributes of the result beside its content."""
        units = next((octree.units for octree in self.octrees if octree.units), "")
        transforms = {octree.transform for octree in self.octrees}
        return {
            "plan": {"operation": self.plan.operation, "operands": self.plan.operands},
            "units": units,
            "transform": transforms.pop() if len(transforms) == 1 else (),
        }


combine = one_call(plan_combine, "combine", Octree)


# ---- on the device


@dataclass(frozen=True)
class Operands:
    """Octrees on the device, in the grid of the result."""

    n: int
    words: Array  # uint32 `child` words of all nodes above level 0
    bricks: Array  # uint64
    roots: np.ndarray  # (n,) uint32 `child` words of the roots
    # (n,) uint32 index of the first node of each operand by level, root first; at level 0, of its
    # first brick
    bases: list[np.ndarray]


@dataclass
class OpenNodes:
    """The open nodes of a level."""

    n: int
    starts: Array  # (n + 1,) uint32 first entry of each node
    operands: Array  # (entries,) uint32
    firsts: Array  # (entries,) uint32 index of the first child of the operand's node
    states: Array  # (n,) uint8 FULL or EMPTY: what the other operands make of the node
    slots: Array | None  # (n,) uint32 place among the children of the level above
    ranks: Array | None = None  # (8 n + 1,) uint32 open children before each child
    child_states: Array | None = None  # (8 n,) uint8
    settled: Array | None = None  # (n,) uint8 state in the result
    kept: Array | None = None  # (n + 1,) uint32 refined nodes of the result before each node
    refined: int = 0


def upload(device: Device, octrees: Sequence[Octree], grid: Grid, lows: np.ndarray) -> Operands:
    """Return octrees on the device, with their low corners at these voxels of a grid."""
    placed = [place(octree, grid, low) for octree, low in zip(octrees, lows, strict=True)]
    sizes = np.array([[*map(len, one.words), len(one.bricks)] for one in placed])
    if max(sizes[:, :-1].sum(), sizes[:, -1].sum()) >> 32:
        raise MemoryLimitError(
            f"{len(octrees)} octrees have more than 2^32 nodes: combine fewer at once"
        )
    ends = np.cumsum(sizes[:, :-1]).reshape(sizes[:, :-1].shape)
    bases = [*(ends - sizes[:, :-1]).T, np.cumsum(sizes[:, -1]) - sizes[:, -1]]
    bases = [base.astype(np.uint32) for base in bases]
    bricks = device.empty(int(sizes[:, -1].sum()), BRICK)
    for one, base in zip(placed, bases[-1].tolist(), strict=True):
        device.write(bricks, one.bricks, base)
    words = device.put(np.concatenate([level for one in placed for level in one.words]))
    roots = np.array([one.words[0][0] for one in placed])
    return Operands(len(placed), words, bricks, roots, bases)


def combined(operands: Operands, terms: Terms) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the offsets, nodes and bricks of a combination."""
    device = operands.words.device
    inverted = device.put(terms.inverted)
    options = {"exclusive": terms.exclusive, "complement": terms.complement, "inverted": inverted}
    with device.stage("open nodes"):
        root = _open_root(operands, terms)
        if isinstance(root, int):
            return _leaf(root, len(operands.bases))
        levels = [root]
        for base in operands.bases[2:]:
            levels.append(_open_children(operands, levels[-1], base, options))
    with device.stage("bricks"):
        bricks = _combine_bricks(operands, levels[-1], options)
    with device.stage("settle"):
        for level, below in zip(levels[-2::-1], levels[:0:-1], strict=True):
            _settle(level, below)
    if not root.refined:
        assert root.settled
        return _leaf(int(root.settled.get()[0]), len(operands.bases))
    return _linked(levels, bricks)


def _leaf(state: int, depth: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the octree whose root is a leaf."""
    nodes = np.zeros(1, NODE)
    nodes["child"] = INSIDE if state == FULL else 0
    return np.minimum(np.arange(depth + 1), 1).astype(np.uint32), nodes, np.empty(0, BRICK)


def _open_root(operands: Operands, terms: Terms) -> OpenNodes | int:
    """Return the root, or its state if no operand that could decide it is refined."""
    device, roots = operands.words.device, operands.roots
    states = states_of(roots)
    state = terms.state(states)
    if state != REFINED:
        return state
    refined = np.flatnonzero(states == REFINED).astype(np.uint32)
    others = terms.of_leaves(states)
    firsts = operands.bases[1][refined] + (roots[refined] & LINK)
    return OpenNodes(
        1,
        device.put(np.array([0, len(refined)], np.uint32)),
        device.put(refined),
        device.put(firsts),
        device.put(np.array([FULL if others else EMPTY], np.uint8)),
        None,
    )


def _open_children(
    operands: Operands, level: OpenNodes, bases: np.ndarray, options: dict[str, Any]
) -> OpenNodes:
    """Return the open nodes among the children of a level's."""
    device, n = operands.words.device, 8 * level.n
    places, ranks = (device.empty(n + 1, np.uint32) for _ in range(2))
    states = device.empty(n, np.uint8)
    entries = (level.starts, level.operands, level.firsts)
    device.kernel(SOURCE, "close_children")(
        n, *entries, level.states, words=operands.words, counts=places, open=ranks,
        child_states=states, **options,
    )  # fmt: skip
    total, found = exclusive_scan(places, n), exclusive_scan(ranks, n)
    below = OpenNodes(
        found,
        device.empty(found + 1, np.uint32),
        device.empty(total, np.uint32),
        device.empty(total, np.uint32),
        device.empty(found, np.uint8),
        device.empty(found, np.uint32),
    )
    device.kernel(SOURCE, "list_entries")(
        n, *entries, operands.words, places, ranks, states, device.put(bases), below.starts,
        below.operands, below.firsts, below.states, below.slots,
    )  # fmt: skip
    level.ranks, level.child_states = ranks, states
    return below


def _combine_bricks(operands: Operands, level: OpenNodes, options: dict[str, Any]) -> Array:
    """Settle the open level-1 nodes; return their bricks."""
    device, n = operands.words.device, level.n
    bricks = device.empty(8 * n, BRICK)
    _settling(level, device.kernel(SOURCE, "combine_bricks"), level.starts, level.operands,
        level.firsts, level.states, bricks=operands.bricks, combined=bricks, **options)  # fmt: skip
    return bricks


def _settle(level: OpenNodes, below: OpenNodes) -> None:
    """Settle the open nodes of a level above level 1."""
    settle = level.starts.device.kernel(SOURCE, "settle_nodes")
    _settling(level, settle, level.ranks, below.settled, level.child_states)


def _settling(level: OpenNodes, settle: Callable[..., None], *args: Any, **named: Any) -> None:
    """Call a kernel that settles the nodes of a level; number those that stay refined."""
    device = level.starts.device
    level.settled = device.empty(level.n, np.uint8)
    level.kept = device.empty(level.n + 1, np.uint32)
    settle(level.n, *args, settled=level.settled, refined=level.kept, **named)
    level.refined = exclusive_scan(level.kept, level.n)


def _linked(levels: list[OpenNodes], combined: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the offsets, nodes and bricks of the result."""
    device = combined.device
    offsets = np.cumsum([0, 1, *(8 * level.refined for level in levels)])
    if offsets[-1] > MAX_LINK:
        raise MemoryLimitError(
            f"an octree of {offsets[-1]:,} nodes exceeds links of 30 bits: choose a smaller dim"
        )
    nodes = device.empty(int(offsets[-1]), NODE)
    bricks = device.empty(8 * levels[-1].refined, BRICK)
    link_nodes = device.kernel(SOURCE, "link_nodes")
    device.write(nodes, np.zeros(1, NODE))  # the root has no parent
    above = None
    with device.stage("link"):
        for level, (first, below) in zip(levels, pairwise(offsets[:-1].tolist()), strict=True):
            link_nodes(level.n, level.kept, above, level.slots, first, below, level.child_states,
                combined, nodes, bricks)  # fmt: skip
            above = level.kept
    with device.stage("read back"):
        return offsets.astype(np.uint32), nodes.take(), bricks.take()
