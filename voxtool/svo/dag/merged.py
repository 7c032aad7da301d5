"""A merged octree: equal subtrees of an octree are stored once, as a directed acyclic graph.

The octree that it stands for is never made whole unless `expanded` is called: counts follow from
how often each subtree occurs, digests from the states of the nodes, a byte each above the bricks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any, Self

import numpy as np

from voxtool.arrays import Blocks, Data, blocks_of, digest_of_blocks
from voxtool.errors import FileError, MemoryLimitError, human
from voxtool.grid import Grid
from voxtool.memory import check_memory
from voxtool.morton import morton_decode
from voxtool.svo.dag.merge import SUBTREE, Subtrees, merge
from voxtool.svo.dag.merged_checks import check_subtrees, check_tables
from voxtool.svo.octree.content import BLOCK, OctreeContent
from voxtool.svo.octree.layout import (
    BRICK,
    BRICK_BYTES,
    BRICK_SIDE,
    MAX_LINK,
    NODE,
    NODE_BYTES,
    unpack_bricks,
)
from voxtool.svo.octree.links import FULL, REFINED, level_states, nodes_of, offsets_of
from voxtool.svo.octree.octree import Octree, PointQueries
from voxtool.svo.octree.prune import ALL_VOXELS, kinds_of_bricks, pruned_states

CHILD_BITS = np.arange(8, dtype=np.uint16)  # bits of a mask, which children have a link
FULL_BITS = CHILD_BITS + np.uint16(8)  # and which are full
CORNERS = morton_decode(np.arange(8))  # (8, 3): the place of each child in its parent
NOWHERE = 1 << 30  # the low corner of the box of nothing; its high corner is -NOWHERE
MERGE_BYTES = 32  # a brick, at the peak of merging, beside the octree


@dataclass(frozen=True, eq=False, repr=False)
class MergedOctree(PointQueries, Data, OctreeContent):
    """An octree whose equal subtrees are stored once.

    Attributes `offsets`, `nodes` and `bricks`, counts and digests are those of the octree that it
    stands for.

    Parameters
    ----------
    grid, mode, fill, plan, source_sha256, units, transform
        As of an Octree.
    root : int
        State of the root: 0 empty, 1 full, 2 refined.
    starts : (depth,) uint32
        Index of the first distinct subtree of each level above the bricks, root first, and their
        number. The root of a subtree is a refined node.
    masks : (R,) uint16
        Flags of each subtree: bit c if child c is refined, or is a brick that is neither empty nor
        full; bit 8 + c if all voxels of child c are set.
    links : (K,) uint32
        The subtrees of the children with bits 0 to 7, one after the other: indices from the start
        of the level below, or of `leaves`.
    leaves : (M,) uint64
        The distinct bricks that are neither empty nor full, ascending.
    """

    grid: Grid
    mode: str
    fill: str
    root: int
    starts: np.ndarray
    masks: np.ndarray
    links: np.ndarray
    leaves: np.ndarray
    plan: dict[str, Any] = field(default_factory=dict, compare=False)
    source_sha256: str = field(default="", compare=False)
    units: str = field(default="", compare=False)
    transform: tuple[float, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_tables(self)

    @classmethod
    def of(cls, octree: OctreeContent) -> Self:
        """Return the merged octree of an octree.

        Raises
        ------
        MemoryLimitError
            If merging does not fit in memory.
        """
        check_memory(MERGE_BYTES * len(octree.bricks), "the sorted bricks of merging")
        subtrees = merge(level_states(octree.offsets, octree.nodes), octree.bricks[:])
        described = (octree.plan, octree.source_sha256, octree.units, octree.transform)
        return cls.of_subtrees(subtrees, octree.grid, octree.mode, octree.fill, *described)

    @classmethod
    def of_subtrees(
        cls, subtrees: Subtrees, grid: Grid, mode: str, fill: str, *described: Any
    ) -> Self:
        """Return a merged octree of its distinct subtrees; `described` are its plan, source_sha256,
        units and transform."""
        masks, links = zip(*map(packed_rows, subtrees.rows[::-1]), strict=True)
        return cls(
            grid,
            mode,
            fill,
            min(subtrees.root, REFINED),
            np.cumsum([0, *map(len, masks)]).astype(np.uint32),
            np.concatenate(masks),
            np.concatenate(links),
            subtrees.leaves,
            *described,
        )

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.grid.shape))
        size = f"{human(self.merged_bytes)} for {human(self.nbytes)}"
        return f"<MergedOctree {shape}, {self.mode}, {self.count:,} voxels, {size}>"

    # ---- the distinct subtrees

    @property
    def depth(self) -> int:
        """Number of levels, including the root and the bricks."""
        return len(self.starts)

    @property
    def sizes(self) -> list[int]:
        """The distinct subtrees of each level, root first, and the distinct bricks."""
        return [*np.diff(self.starts.astype(np.int64)).tolist(), len(self.leaves)]

    @cached_property
    def first_links(self) -> np.ndarray:
        """(R + 1,) int64: the index of the first link of each subtree, and the number of links."""
        counts = np.bitwise_count(self.masks & np.uint16(0xFF))
        return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])

    @property
    def packed_links(self) -> np.ndarray:
        """The links as they are stored, (L,) uint8: each in the fewest bytes that hold the indices
        of its level, little-endian."""
        parts = [
            self.level(d)[1][:, None].view(np.uint8)[:, : link_bytes(below)].ravel()
            for d, below in enumerate(self.sizes[1:])
        ]
        return np.concatenate(parts)

    @property
    def merged_bytes(self) -> int:
        """Bytes of the subtrees and bricks in a file."""
        links = sum(
            len(self.level(d)[1]) * link_bytes(below) for d, below in enumerate(self.sizes[1:])
        )
        return self.starts.nbytes + self.masks.nbytes + links + self.leaves.nbytes

    def level(self, d: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the masks and the links of the subtrees of a level, d levels below the root."""
        start, stop = self.starts[d : d + 2].tolist()
        first, last = self.first_links[start], self.first_links[stop]
        return self.masks[start:stop], self.links[first:last]

    def words(self, d: int) -> np.ndarray:
        """Return the words of the children of the subtrees of a level, as `merge` has them."""
        masks, links = self.level(d)
        words = states_in(masks).astype(np.uint32)
        words[words == REFINED] = SUBTREE + links
        return words

    @cached_property
    def occurrences(self) -> list[np.ndarray]:
        """The number of times that each subtree and each leaf occurs: (n,) int64 by level, root
        first."""
        found = [np.ones(int(self.starts[1]), np.int64)]
        for d, size in enumerate(self.sizes[1:]):
            masks, links = self.level(d)
            above = np.repeat(found[-1], np.bitwise_count(masks & np.uint16(0xFF)))
            # sums in float64 are exact: a level has at most 2**42 nodes
            found.append(np.bincount(links, above, minlength=size).astype(np.int64))
        return found

    # ---- the octree that it stands for

    @cached_property
    def _counts(self) -> list[tuple[int, int, int]]:
        """The refined nodes, the inside leaves and the set voxels of each level, from the bricks
        up."""
        refined = [int(times.sum()) for times in self.occurrences[:-1]]
        full = [int(self.root == FULL)]
        for d, times in enumerate(self.occurrences[:-1]):
            masks, _ = self.level(d)
            full.append(int((times * np.bitwise_count(masks >> np.uint16(8))).sum()))
        bits = np.bitwise_count(self.leaves).astype(np.int64)
        counts = [(0, 0, BRICK_SIDE**3 * full.pop() + int((bits * self.occurrences[-1]).sum()))]
        for number, (n, inside) in enumerate(zip(refined[::-1], full[::-1], strict=True), 1):
            counts.append((n, inside, inside * (BRICK_SIDE << number) ** 3))
        return counts

    @property
    def offsets(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(depth + 1,) int64 offsets of the levels among the nodes."""
        refined = [n for n, _, _ in self._counts[:0:-1]]
        return np.cumsum([0, 1, *(8 * n for n in refined)])

    @property
    def nodes(self) -> Blocks:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The nodes."""
        return Blocks(int(self.offsets[-1]), NODE, self.node_blocks())

    @property
    def bricks(self) -> Blocks:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The bricks."""
        size = 8 * self._counts[1][0]
        return Blocks(size, BRICK, self.brick_blocks())

    @property
    def nbytes(self) -> int:
        """Bytes of nodes and bricks."""
        nodes = int(self.offsets[-1])
        return NODE_BYTES * nodes + BRICK_BYTES * 8 * self._counts[1][0]

    def instances(self, levels: int | None = None) -> list[np.ndarray]:
        """Return the subtree of every refined node, (n,) uint32 by level, root first, in Morton
        order; of all levels above the bricks, or of the first ones."""
        found = [np.zeros(int(self.root == REFINED), np.uint32)]
        for d in range(min(levels or self.depth, self.depth - 1) - 1):
            found.append(self._children(d, found[-1]))
        return found

    def _children(self, d: int, subtrees: np.ndarray) -> np.ndarray:
        """Return the links of subtrees of a level, one after the other."""
        first, last = (self.first_links[int(self.starts[d]) + i :][subtrees] for i in range(2))
        counts = last - first
        ends = np.cumsum(counts)
        places = np.arange(ends[-1] if len(ends) else 0)
        return self.links[places + np.repeat(first - (ends - counts), counts)]

    def states(self, instances: list[np.ndarray]) -> list[np.ndarray]:
        """Return the states of the nodes of each level, from the root down to level 1."""
        levels = [np.full(1, self.root, np.uint8)]
        for d, subtrees in enumerate(instances[:-1]):
            levels.append(states_in(self.level(d)[0][subtrees]).ravel())
        return levels

    def node_blocks(self) -> Iterator[np.ndarray]:
        """Yield the nodes in blocks."""
        yield from nodes_of(self.states(self.instances()))

    def brick_blocks(self) -> Iterator[np.ndarray]:
        """Yield the bricks in blocks of whole groups of eight."""
        for subtrees in blocks_of(self.instances()[-1], BLOCK // 8):
            yield self.bricks_of(subtrees)

    def children_of(self, d: int, subtrees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states of the children of subtrees of a level, (8 n,) uint8, and the subtrees
        of those that are refined, (8 n,) uint32."""
        states = states_in(self.level(d)[0][subtrees]).ravel()
        links = np.zeros(len(states), np.uint32)
        links[states == REFINED] = self._children(d, subtrees)
        return states, links

    def bricks_of(self, subtrees: np.ndarray) -> np.ndarray:
        """Return the eight bricks of each of some subtrees of level 1, (8 n,) BRICK."""
        states, leaves = self.children_of(self.depth - 2, subtrees)
        bricks = np.where(states == FULL, ALL_VOXELS, BRICK.type(0))
        bricks[states == REFINED] = self.leaves[leaves[states == REFINED]]
        return bricks

    def bounds(self) -> np.ndarray | None:
        """Return the low and the high corner of the box around the set voxels, as Octree.bounds
        does."""
        if not self.count:
            return None
        ends = []
        for block in [self.leaves[:0], *blocks_of(self.leaves, BLOCK)]:
            layers = unpack_bricks(block)
            held = np.stack([layers.any(axis=axes) for axes in ((2, 3), (1, 3), (1, 2))], axis=1)
            first, last = held.argmax(axis=2), held[..., ::-1].argmax(axis=2)
            ends.append(np.stack([first, BRICK_SIDE - last]))
        lows, highs = np.concatenate(ends, axis=1)
        return np.stack(self.box_of(lows, highs))

    def box_of(self, lows: np.ndarray, highs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and the high corner, (3,) int64 in voxels, of the box around everything
        set, given the corners of the boxes of the leaves, (n, 3) each."""
        if self.root == FULL:
            return np.zeros(3, np.int64), np.full(3, self.grid.side)
        for d in reversed(range(self.depth - 1)):
            side = BRICK_SIDE << (self.depth - 2 - d)
            words = self.words(d)
            low, high = (np.full((len(words), 3), sign * NOWHERE) for sign in (1, -1))
            for corner, word in zip(side * CORNERS, words.T, strict=True):
                linked, full = word >= SUBTREE, word == FULL
                below = word[linked] - SUBTREE
                low[linked] = np.minimum(low[linked], corner + lows[below])
                high[linked] = np.maximum(high[linked], corner + highs[below])
                low[full] = np.minimum(low[full], corner)
                high[full] = np.maximum(high[full], corner + side)
            lows, highs = low, high
        return lows[0], highs[0]

    def expanded(self) -> Octree:
        """Return the octree, with nothing merged.

        Raises
        ------
        MemoryLimitError
            If it does not fit in memory, or its nodes exceed links of 30 bits.
        """
        size = int(self.offsets[-1])
        if size > MAX_LINK:
            raise MemoryLimitError(
                f"its octree has {size:,} nodes, which exceed links of 30 bits: voxtool svo-info "
                "reads it merged"
            )
        check_memory(self.nbytes, f"the {size:,} nodes of its octree", "choose a smaller dim")
        return Octree(
            self.grid,
            self.mode,
            self.fill,
            self.offsets.astype(np.uint32),
            filled(self.nodes),
            filled(self.bricks),
            self.plan,
            self.source_sha256,
            self.units,
            self.transform,
        )

    def digest(self) -> str:
        """Return the digest of the octree, as Octree.digest does."""
        head = {**self.grid.exact, "mode": self.mode, "fill": self.fill}
        offsets = self.offsets.astype(np.uint32)
        return digest_of_blocks(head, chain([offsets], self.nodes.blocks, self.brick_blocks()))

    def set_digest(self) -> str:
        """Return the set digest of the octree, as Octree.set_digest does."""
        instances = self.instances()
        kinds = self._brick_kinds()[instances[-1]]
        levels = pruned_states(self.states(instances)[::-1], kinds)[::-1]
        mixed = blocks_of(kinds == REFINED, BLOCK // 8)
        bricks = (
            block.reshape(-1, 8)[stays].ravel()
            for block, stays in zip(self.brick_blocks(), mixed, strict=True)
        )
        offsets = offsets_of(levels, 8 * int(np.count_nonzero(kinds == REFINED))).astype(np.uint32)
        return digest_of_blocks(self.grid.exact, chain([offsets], nodes_of(levels), bricks))

    def _brick_kinds(self) -> np.ndarray:
        """Return what the bricks make of the subtrees of level 1, (n,) uint8."""
        states = states_in(self.level(self.depth - 2)[0])
        return kinds_of_bricks(np.array([0, ALL_VOXELS, 1], np.uint64)[states])

    def summary(self) -> dict[str, Any]:
        """Return the summary of the octree, and what is stored: `subtrees`, also by level, and
        `merged_bytes`."""
        found, sizes = super().summary(), self.sizes
        levels = [{**row, "subtrees": n} for row, n in zip(found["levels"], sizes, strict=True)]
        return found | {
            "levels": levels,
            "subtrees": sum(sizes),
            "merged_bytes": self.merged_bytes,
        }

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError
            If an invariant does not hold; the message names the first one.
        """
        check_subtrees(self)


def link_bytes(below: int) -> int:
    """Return the bytes of a stored link to one of `below` subtrees."""
    return max(-(-(below - 1).bit_length() // 8), 1)


def unpack_links(stored: np.ndarray, tables: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the (K,) uint32 links of stored ones, given the other tables of a merged octree.

    Raises
    ------
    FileError
        If their number is not what the tables say.
    """
    starts, masks = tables["starts"].astype(np.int64), tables["masks"]
    sizes = [*np.diff(starts).tolist(), len(tables["leaves"])]
    parts, first = [np.empty(0, "<u4")], 0
    for d, below in enumerate(sizes[1:]):
        linked = masks[starts[d] : starts[d + 1]] & np.uint16(0xFF)
        count, width = int(np.bitwise_count(linked).sum(dtype=np.int64)), link_bytes(below)
        part = stored[first : first + count * width]
        if len(part) != count * width:
            break
        links = np.zeros((count, 4), np.uint8)
        links[:, :width] = part.reshape(count, width)
        parts.append(links.view("<u4").ravel())
        first += count * width
    else:
        if first == len(stored):
            return np.concatenate(parts)
    raise FileError(f"dataset links has {len(stored)} bytes, which are not those of its subtrees")


def states_in(masks: np.ndarray) -> np.ndarray:
    """Return the states of the children of subtrees with (n,) uint16 masks, (n, 8) uint8."""
    linked, full = (
        (masks[:, None] >> bits).astype(np.uint8) & np.uint8(1) for bits in (CHILD_BITS, FULL_BITS)
    )
    return linked * np.uint8(REFINED) + full * np.uint8(FULL)


def packed_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks and the links of (n, 8) uint32 rows of words."""
    linked, full = rows >= SUBTREE, rows == FULL
    both = np.packbits(np.stack([linked, full], axis=1), axis=2, bitorder="little")
    return both.reshape(-1, 2).view("<u2").ravel(), rows[linked] - SUBTREE


def filled(blocks: Blocks) -> np.ndarray:
    """Return the items of blocks as an array."""
    array, start = np.empty(blocks.size, blocks.dtype), 0
    for block in blocks.blocks:
        array[start : start + len(block)] = block
        start += len(block)
    return array
