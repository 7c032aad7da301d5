"""The active level-1 nodes ([voCCeL], section 3.2, listings A.4 and A.5).

A node of 8 x 8 x 8 voxels is active if a triangle touches it. The set is a bit array in Morton
order with the number of set bits before each word, so that the rank of a node is found at once. In
large grids the bits exist for blocks of 8 x 8 x 8 nodes that are found first. Kernels:
kernels/svo/active.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.plan import CELL, NODE_BLOCK
from voxtool.svo.scan import BLOCK_LEVEL, NODE_LEVEL

if TYPE_CHECKING:
    from voxtool.opencl import Array
    from voxtool.svo.scan import Scan

SOURCE = "svo/active.cl"
BLOCK_WORDS = (NODE_BLOCK // CELL) ** 3 // 32


@dataclass(frozen=True)
class BitSet:
    """A set of cells in Morton order: words of 32 bits, the set bits before each word, the Morton
    codes of the n cells in the set."""

    words: Array
    ranks: Array
    codes: Array
    n: int


@dataclass(frozen=True)
class ActiveNodes:
    """The active level-1 nodes.

    Attributes
    ----------
    nodes : the set; blocks : the blocks that hold its words, or None if it is dense.
    touched : rising Morton codes of the nodes that the mesh touches, where caps or holes activate
        others, or None.
    """

    nodes: BitSet
    blocks: BitSet | None
    touched: np.ndarray | None

    @property
    def codes(self) -> Array:
        """(n,) rising Morton codes."""
        return self.nodes.codes

    @property
    def n(self) -> int:
        """The number of active nodes."""
        return self.nodes.n

    @property
    def lookup(self) -> dict[str, Array]:
        """The arguments by which kernels find a node's rank."""
        return _lookup(self.blocks, self.nodes.words, self.nodes.ranks)


def find_active_nodes(scan: Scan, near_holes: np.ndarray | None) -> ActiveNodes:
    """The level-1 nodes that triangles touch.

    Parameters
    ----------
    near_holes : (n,) uint64 Morton codes of nodes that are active, too, as are those that caps
        touch; None if the mesh has no caps.
    """
    blocks = None
    if scan.plan.blocked:
        words = scan.device.zeros(max((scan.plan.side // NODE_BLOCK) ** 3 // 32, 1), np.uint32)
        lookup = {"block_words": words, "block_ranks": words, "words": words, "ranks": words}
        blocks, _ = _activate(scan, BLOCK_LEVEL, lookup, words, None, near_holes)
        words = scan.device.zeros(BLOCK_WORDS * blocks.n, np.uint32)
    else:
        words = scan.device.zeros(max((scan.plan.side // CELL) ** 3 // 32, 1), np.uint32)
    lookup = _lookup(blocks, words, words)
    nodes, touched = _activate(scan, NODE_LEVEL, lookup, words, blocks, near_holes)
    return ActiveNodes(nodes, blocks, touched)


def _lookup(blocks: BitSet | None, words: Array, ranks: Array) -> dict[str, Array]:
    found = {"words": words, "ranks": ranks}
    if blocks:
        found |= {"block_words": blocks.words, "block_ranks": blocks.ranks}
    return found


def _activate(
    scan: Scan,
    level: int,
    lookup: dict[str, Array],
    words: Array,
    blocks: BitSet | None,
    near_holes: np.ndarray | None,
) -> tuple[BitSet, np.ndarray | None]:
    """The boxes of 2**level voxels that are active; and the codes of those that the mesh itself
    touches, where it has caps."""
    scan.activate(level, lookup, words, with_caps=False)
    found = _collect(scan, words, blocks)
    if near_holes is None:
        return found, None
    touched = found.codes.get(0, found.n)
    scan.activate(level, lookup, words, with_caps=True)
    codes = scan.device.put(near_holes.astype(scan.code))
    scan.kernel(SOURCE, "activate_nodes")(codes.size, codes, level, **lookup, target=words)
    return _collect(scan, words, blocks), touched


def _collect(scan: Scan, words: Array, blocks: BitSet | None) -> BitSet:
    """The set whose bits are given."""
    n = words.size
    ranks = scan.device.empty(n + 1, np.uint32)
    scan.kernel(SOURCE, "count_bits")(n, words, ranks)
    count = exclusive_scan(ranks, n)
    codes = scan.device.empty(count, scan.code)
    write_mortons = scan.kernel(SOURCE, "write_mortons")
    write_mortons(n, words, ranks, blocks.codes if blocks else None, codes)
    return BitSet(words, ranks, codes, count)
