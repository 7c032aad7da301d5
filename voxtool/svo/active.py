"""The active level-1 nodes ([voCCeL], section 3.2, listings A.4 and A.5).

A node of 8 x 8 x 8 voxels is active if a triangle touches it. The set is a bit array in Morton
order with the number of set bits before each word, which gives the rank of a node in constant time.
In large grids, the active blocks of 8 x 8 x 8 nodes are found first, and only they have bits.
Kernels: kernels/svo/active.cl.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxtool.opencl import Array
from voxtool.opencl.primitives import exclusive_scan
from voxtool.svo.plan import CELL, NODE_BLOCK
from voxtool.svo.scan import BLOCK_LEVEL, NODE_LEVEL, Scan

SOURCE = "svo/active.cl"
BLOCK_WORDS = (NODE_BLOCK // CELL) ** 3 // 32


@dataclass(frozen=True)
class BitSet:
    """A set of cells."""

    words: Array  # bits of the cells in Morton order, 32 a word
    ranks: Array  # set bits before each word
    codes: Array  # ascending Morton codes of the n cells in the set
    n: int


@dataclass(frozen=True)
class ActiveNodes:
    """The active level-1 nodes."""

    nodes: BitSet
    blocks: BitSet | None  # the blocks that have words, or None if all have
    touched: np.ndarray | None  # codes of the nodes that the mesh touches; None if it touches all

    @property
    def lookup(self) -> dict[str, Array]:
        """Arguments by which kernels find the rank of a node."""
        return _lookup(self.blocks, self.nodes.words, self.nodes.ranks)


def find_active_nodes(scan: Scan, near_holes: np.ndarray | None) -> ActiveNodes:
    """Return the level-1 nodes that triangles touch; if the mesh has caps, also those that caps
    touch, and those whose Morton codes are `near_holes`."""
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
    """Return the active boxes of 2**level voxels and, if the mesh has caps, the codes of those that
    the mesh itself touches."""
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
    """Return the set with the given bits."""
    n, above = words.size, blocks.codes if blocks else None
    ranks = scan.device.empty(n + 1, np.uint32)
    scan.kernel(SOURCE, "count_bits")(n, words, ranks)
    count = exclusive_scan(ranks, n)
    codes = scan.device.empty(count, scan.code)
    scan.kernel(SOURCE, "write_mortons")(n, words, ranks, above, codes)
    return BitSet(words, ranks, codes, count)
