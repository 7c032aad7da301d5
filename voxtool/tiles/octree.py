"""An octree that comes in blocks: what a file, a report and a digest need of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from voxtool.arrays import Blocks
from voxtool.errors import VoxtoolError
from voxtool.files.octrees.windows import Key, Store
from voxtool.grid import Grid
from voxtool.svo.octree.attributes import Attribute
from voxtool.svo.octree.exact_sums import exact_sum
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES, NODE, NODE_BYTES
from voxtool.svo.octree.links import nodes_of, offsets_of
from voxtool.tiles.subtree import Subtree


class BlockAttribute:
    """An attribute whose values wait on disk, window by window.

    It has what a file and a report need of an Attribute.

    Parameters
    ----------
    about : an Attribute of the same name, dtype, default and names, without values.
    leaves : its values of inside leaves.
    bricks : number of bricks of the octree.
    store, keys : the windows, in Morton order.
    """

    def __init__(
        self, about: Attribute, leaves: np.ndarray, bricks: int, store: Store, keys: Sequence[Key]
    ) -> None:
        self._store, self._keys, self._bricks = store, keys, bricks
        self.name, self.default, self.names = about.name, about.default, about.names
        self.leaves = leaves
        self.blank = about.blank
        found = [store.attribute(key, self.name) for key in keys]
        self.masked = about.masked or any(one["masked"] for one in found)
        self._size = sum(one["values"] for one in found)
        self._total: Fraction | None = None

    @property
    def masks(self) -> Blocks | None:
        """The masks of the voxels that have values, or None if all set ones have."""
        return Blocks(self._bricks, BRICK, self._arrays("masks")) if self.masked else None

    @property
    def values(self) -> Blocks:
        """The values, which come once."""
        return Blocks(self._size, self.leaves.dtype, self._taken(), self.leaves.shape[1:])

    @property
    def nbytes(self) -> int:
        """Bytes of values and masks."""
        of_one = self.leaves.itemsize * int(np.prod(self.leaves.shape[1:]))
        return of_one * (self._size + len(self.leaves)) + BRICK_BYTES * self._bricks * self.masked

    # those of an Attribute
    head = Attribute.head
    described = Attribute.described
    summary = Attribute.summary

    @property
    def total(self) -> Fraction:
        """The exact sum of the values, once the octree has been written."""
        assert self._total is not None
        return self._total

    def blocks(self) -> Iterator[np.ndarray]:
        """Yield the arrays of the attribute in blocks, in the order of digests."""
        if self.masked:
            yield from self._arrays("masks")
        self._total = Fraction(0)
        for block in self._arrays("values"):
            if self.name in ("area", "fraction"):
                self._total += exact_sum(block)
            yield block
        yield self.leaves

    def in_memory(self) -> Attribute:
        """Return the attribute in memory."""
        masks = self.masks
        arrays = _joined(self.values), self.leaves, None if masks is None else _joined(masks)
        return Attribute(self.name, *arrays, self.default, self.names)

    def _arrays(self, part: str) -> Iterator[np.ndarray]:
        for key in self._keys:
            yield from self._store.array(key, self.name, part)

    def _taken(self) -> Iterator[np.ndarray]:
        """Yield the values; those of each window are then removed from the disk."""
        for key in self._keys:
            yield from self._store.array(key, self.name, "values")
            self._store.drop(key, self.name, "values")


def _joined(array: Blocks) -> np.ndarray:
    """Return an array that comes in blocks."""
    return np.concatenate([np.empty((0, *array.row), array.dtype), *array.blocks])


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
    attributes: tuple[BlockAttribute, ...] = ()
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
        return Blocks(self.tree.bricks, BRICK, self._digested(self.take_bricks(), last=True))

    @property
    def nbytes(self) -> int:
        """Bytes of nodes and bricks."""
        return NODE_BYTES * int(self.offsets[-1]) + BRICK_BYTES * self.tree.bricks

    def attribute(self, name: str) -> BlockAttribute:
        """Return the attribute of a name; VoxtoolError if the octree has none."""
        for attribute in self.attributes:
            if attribute.name == name:
                return attribute
        raise VoxtoolError(f"the octree has no attribute {name!r}: voxelize with it")

    def digest(self) -> str:
        """Return the digest of the octree, as Octree.digest does."""
        return self._sha.hexdigest()

    def _digested(
        self, blocks: Iterator[np.ndarray], *, first: bool = False, last: bool = False
    ) -> Iterator[np.ndarray]:
        """Yield blocks, which a file stores in the order of the digest; each is hashed while it is
        written. After the last one, attributes are read once more for the digest, as a file has
        them in another order."""
        if first:
            head: dict[str, Any] = {**self.grid.exact, "mode": self.mode, "fill": self.fill}
            if self.attributes:
                head["attributes"] = {one.name: one.described for one in self.attributes}
            self._sha = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
            self._sha.update(self.offsets.data)
        with ThreadPoolExecutor(1) as pool:
            for block in blocks:
                hashed = pool.submit(self._sha.update, block.data)
                yield block
                hashed.result()
        for one in self.attributes if last else ():
            for block in one.blocks():
                self._sha.update(np.ascontiguousarray(block).data)
