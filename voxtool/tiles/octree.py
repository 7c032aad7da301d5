"""An octree that comes in blocks: what a file, a report and a digest need of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from voxtool.arrays import Blocks
from voxtool.grid import Grid
from voxtool.svo.layout import BRICK, BRICK_BYTES, NODE, NODE_BYTES
from voxtool.svo.links import nodes_of, offsets_of
from voxtool.tiles.subtree import Subtree


@dataclass
class BlockOctree:
    """An octree whose nodes follow from the states of a tree, and whose bricks come once.

    It has the attributes of an Octree that a file and a report need. Its digest is that of the
    octree, and is known once it has been written.
    """

    grid: Grid
    mode: str
    fill: str
    tree: Subtree
    count: int
    take_bricks: Callable[[], Iterator[np.ndarray]]
    plan: dict[str, Any]
    source_sha256: str
    units: str
    transform: tuple[float, ...]
    _sha: Any = field(default=None, repr=False)

    @property
    def depth(self) -> int:
        """Number of levels, including the root and the bricks."""
        return len(self.tree.levels) + 1

    @property
    def offsets(self) -> np.ndarray:
        """(depth + 1,) uint32: the index of the first node of each level, and their number."""
        return offsets_of(self.tree.levels, self.tree.bricks).astype(np.uint32)

    @property
    def nodes(self) -> Blocks:
        """The nodes."""
        size = int(self.offsets[-1])
        return Blocks(size, NODE, self._digested(nodes_of(self.tree.levels), first=True))

    @property
    def bricks(self) -> Blocks:
        """The bricks, which come once."""
        return Blocks(self.tree.bricks, BRICK, self._digested(self.take_bricks()))

    @property
    def nbytes(self) -> int:
        """Bytes of nodes and bricks."""
        return NODE_BYTES * int(self.offsets[-1]) + BRICK_BYTES * self.tree.bricks

    def digest(self) -> str:
        """Return the digest of the octree, as Octree.digest does."""
        return self._sha.hexdigest()

    def _digested(self, blocks: Iterator[np.ndarray], first: bool = False) -> Iterator[np.ndarray]:
        """Yield blocks, which a file stores in the order of the digest; each is hashed while it is
        written."""
        if first:
            head = {**self.grid.exact, "mode": self.mode, "fill": self.fill}
            self._sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
            self._sha.update(self.offsets.data)
        with ThreadPoolExecutor(1) as pool:
            for block in blocks:
                hashed = pool.submit(self._sha.update, block.data)
                yield block
                hashed.result()
