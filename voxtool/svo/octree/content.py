"""An octree that is read in blocks, from memory or from a file that is larger than memory.

The nodes below a range of a level are a range of the next level, so a walk over ranges reaches
every node once, subtree by subtree in Morton order.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any, Self

import numpy as np

from voxtool.arrays import Slices, blocks_of, digest_of_blocks
from voxtool.errors import VoxtoolError
from voxtool.grid import Grid
from voxtool.morton import morton_decode
from voxtool.svo.octree.attributes import Attribute, Values, check_attributes
from voxtool.svo.octree.layout import (
    BRICK_BYTES,
    BRICK_SIDE,
    INSIDE,
    NODE_BYTES,
    VALID,
    descend,
    unpack_bricks,
)
from voxtool.svo.octree.links import REFINED, level_states, nodes_of, offsets_of
from voxtool.svo.octree.validate import check_sizes, check_structure

BLOCK = 1 << 16  # nodes that are read at once


@dataclass(frozen=True)
class Span:
    """Nodes of one level that follow one another."""

    number: int  # of the level, 0 for the bricks
    start: int  # index of the first one in its level
    nodes: np.ndarray  # (n,) NODE
    codes: np.ndarray  # (n,) uint64 Morton codes of their cells
    parents: np.ndarray  # (n / 8,) uint32 indices of their parents in the level above; root: none
    first_child: int  # index in the level below of the first node below them


class OctreeContent:
    """The content of an octree: the base of `Octree` and `StoredOctree`, which have these
    attributes.

    Slices of `nodes` and `bricks` are arrays; the two need not be arrays themselves.
    """

    grid: Grid
    mode: str
    fill: str
    offsets: np.ndarray
    nodes: Any
    bricks: Any
    plan: dict[str, Any]
    source_sha256: str
    units: str
    transform: tuple[float, ...]
    attributes: tuple[Attribute, ...] = ()

    def only(self, names: Collection[str]) -> Self:
        """Return the octree with those of its attributes whose names are given."""
        return self

    @property
    def depth(self) -> int:
        """Number of levels, including the root and the bricks."""
        return len(self.offsets) - 1

    @property
    def nbytes(self) -> int:
        """Bytes of nodes and bricks, without x-neighbour pointers."""
        return NODE_BYTES * len(self.nodes) + BRICK_BYTES * len(self.bricks)

    def blocks(self, d: int) -> Iterator[np.ndarray]:
        """Yield the nodes of a level, d levels below the root, in blocks."""
        return blocks_of(self.nodes, BLOCK, int(self.offsets[d]), int(self.offsets[d + 1]))

    def walk(self) -> Iterator[Span]:
        """Yield all nodes: each span, then those below it, in Morton order. Every refined node has
        eight nodes on the level below."""
        none = np.empty(0, np.uint32)
        root = Span(self.depth - 1, 0, self.nodes[0:1], np.zeros(1, np.uint64), none, 0)
        return self._walk(root, [0] * self.depth)

    def _walk(self, span: Span, reached: list[int]) -> Iterator[Span]:
        """Yield a span and those below it; `reached` counts the nodes that were read by level."""
        yield span
        if not (number := span.number):
            return
        refined = np.flatnonzero(span.nodes["child"] & VALID).astype(np.uint32)
        first = int(self.offsets[self.depth - number])
        for parents in blocks_of(refined, BLOCK // 8):
            start = reached[number - 1]
            reached[number - 1] = stop = start + 8 * len(parents)
            nodes, codes = self.nodes[first + start : first + stop], descend(span.codes[parents])
            above = parents + np.uint32(span.start)
            below = reached[number - 2] if number > 1 else 0
            yield from self._walk(Span(number - 1, start, nodes, codes, above, below), reached)

    @cached_property
    def _counts(self) -> list[tuple[int, int, int]]:
        """The refined nodes, the inside leaves and the set voxels of each level, from the bricks
        up."""
        bits = (np.bitwise_count(part).sum(dtype=np.int64) for part in self.brick_blocks())
        counts = [(0, 0, int(sum(bits)))]
        for number in range(1, self.depth):
            refined = inside = 0
            for block in self.blocks(self.depth - 1 - number):
                refined += int(np.count_nonzero(block["child"] & VALID))
                inside += int(np.count_nonzero(block["child"] & INSIDE))
            counts.append((refined, inside, inside * (BRICK_SIDE << number) ** 3))
        return counts

    def brick_blocks(self) -> Iterator[np.ndarray]:
        """Yield the bricks in blocks of whole groups of eight."""
        return blocks_of(self.bricks, BLOCK)

    @property
    def count(self) -> int:
        """Number of set voxels."""
        return sum(self.count_by_level().values())

    def count_by_level(self) -> dict[int, int]:
        """Return the set voxels by level: in bricks at level 0, in inside leaves above."""
        return {number: voxels for number, (_, _, voxels) in enumerate(self._counts)}

    def bounds(self) -> np.ndarray | None:
        """Return the low and the high corner of the box around the set voxels, (2, 3) int64 voxels;
        None if there are none."""
        boxes = []
        for span in self.walk():
            side = BRICK_SIDE << span.number
            if span.number:
                held, masks = (span.nodes["child"] & INSIDE) != 0, None
            else:
                masks = self.bricks[span.start : span.start + len(span.nodes)]
                held = masks != 0
            if held.any():
                cells = side * morton_decode(span.codes[held])
                box = np.stack([cells.min(axis=0), cells.max(axis=0) + side])
                boxes.append(box if masks is None else _tightened(box, cells, masks[held]))
        if not boxes:
            return None
        low, high = np.transpose(boxes, (1, 0, 2))
        return np.stack([low.min(axis=0), high.max(axis=0)])

    def summary(self) -> dict[str, Any]:
        """Return counts and sizes in JSON types, in world units.

        The `voxels` of a level are those in its inside leaves or bricks; its `coverage` is the
        fraction of the volume of its nodes that is set.
        """
        levels, below = [], 0
        sizes = np.diff(self.offsets.astype(np.int64))[::-1].tolist()
        for number, (refined, inside, voxels) in enumerate(self._counts):
            below += voxels
            side = BRICK_SIDE << number
            levels.append(
                {
                    "level": number,
                    "side": side,
                    "nodes": sizes[number],
                    "refined": refined,
                    "inside": inside,
                    "voxels": voxels,
                    "coverage": below / max(sizes[number] * side**3, 1),
                }
            )
        size = math.prod(self.grid.shape)
        return {
            "dim": self.grid.dim,
            **{name: getattr(self, name) for name in ("depth", "mode", "fill")},
            **{name: list(getattr(self.grid, name)) for name in ("shape", "origin", "pitch")},
            **{name: getattr(self, name) for name in ("units", "source_sha256")},
            "transform": list(self.transform),
            "voxels": below,
            "occupancy": below / size,
            "volume": self.volume,
            "nodes": len(self.nodes),
            "bricks": len(self.bricks),
            "memory_bytes": self.nbytes,
            "memory_bytes_with_x_pointers": self.nbytes + NODE_BYTES * len(self.nodes),
            "compression": size / 8 / self.nbytes,
            "levels": levels[::-1],
            "attributes": {one.name: one.summary() for one in self.attributes},
            "plan": self.plan,
        }

    @property
    def volume(self) -> float:
        """The volume of the set voxels, or the sum of their fractions, in cubic world units."""
        return self.count * self.grid.voxel_volume

    @property
    def leaf_sizes(self) -> list[tuple[int, int]]:
        """The number of inside leaves of each level, from the root down to level 1, and the voxels
        of one."""
        levels = list(enumerate(self._counts))[:0:-1]
        return [(inside, (BRICK_SIDE << number) ** 3) for number, (_, inside, _) in levels]

    def digest(self) -> str:
        """Return the SHA-256 of shape, mode, fill, origin, pitch, offsets, nodes and bricks, and of
        attributes if there are any, in little-endian order. Equal content has an equal digest on
        every device and platform."""
        head: dict[str, Any] = {**self.grid.exact, "mode": self.mode, "fill": self.fill}
        if self.attributes:
            head["attributes"] = {one.name: one.described for one in self.attributes}
        nodes = blocks_of(self.nodes, BLOCK)
        arrays = chain.from_iterable(one.arrays for one in self.attributes)
        values = chain.from_iterable(blocks_of(array, BLOCK) for array in arrays)
        return digest_of_blocks(head, chain([self.offsets], nodes, self.brick_blocks(), values))

    def set_digest(self) -> str:
        """Return the SHA-256 of shape, origin, pitch, and of the offsets, nodes and bricks of the
        pruned octree. Equal sets of voxels have equal set digests, however they were made."""
        from voxtool.svo.octree.prune import kinds_of_bricks, pruned_states

        kinds = [kinds_of_bricks(block) for block in self.brick_blocks()]
        states = level_states(self.offsets, self.nodes)
        levels = pruned_states(states, np.concatenate([np.empty(0, np.uint8), *kinds]))[::-1]
        mixed = [kind == REFINED for kind in kinds]
        bricks = (
            block.reshape(-1, 8)[stays].ravel()
            for block, stays in zip(self.brick_blocks(), mixed, strict=True)
        )
        offsets = offsets_of(levels, 8 * sum(map(np.count_nonzero, mixed))).astype(np.uint32)
        return digest_of_blocks(self.grid.exact, chain([offsets], nodes_of(levels), bricks))

    def validate(self) -> None:
        """Check every invariant of the structure.

        Raises
        ------
        FileError
            If an invariant does not hold; the message names it, its level and node.
        """
        check_structure(self)
        if self.attributes:
            leaves = sum(inside for _, inside, _ in self._counts)
            check_attributes(self.attributes, self.bricks, leaves)


class AttributedContent(OctreeContent):
    """The content of an octree whose set voxels may have attributes."""

    @property
    def volume(self) -> float:
        """The volume of the set voxels, or the sum of their fractions, in cubic world units."""
        if all(one.name != "fraction" for one in self.attributes):
            return super().volume
        from voxtool.svo.octree.stored_volume import stored_volume  # which imports this module

        return stored_volume(self) * self.grid.voxel_volume

    def summary(self) -> dict[str, Any]:
        """Return counts and sizes in JSON types, in world units, with the voxels and the volume of
        each label. The volume is the sum of fractions, if there are any. See OctreeContent."""
        info, cell = super().summary(), self.grid.voxel_volume
        if "label" in info["attributes"]:
            from voxtool.svo.octree.label_counts import label_counts  # which imports this module

            counts, volumes = (numbers.tolist() for numbers in label_counts(self))
            rows = zip(self.attribute("label").names, counts, volumes, strict=True)
            info["attributes"]["label"]["labels"] = [
                {"label": label, "name": name, "voxels": count, "volume": volume * cell}
                for label, (name, count, volume) in enumerate(rows)
            ]
        return info

    def only(self, names: Collection[str]) -> Self:
        kept = tuple(one for one in self.attributes if one.name in names)
        return replace(self, attributes=kept)  # pyright: ignore[reportArgumentType, reportReturnType]

    def attribute(self, name: str) -> Attribute:
        """Return the attribute of a name; VoxtoolError if the octree has none."""
        for attribute in self.attributes:
            if attribute.name == name:
                return attribute
        known = ", ".join(attribute.name for attribute in self.attributes) or "none"
        raise VoxtoolError(
            f"the octree has no attribute {name!r}, it has {known}: voxelize with it"
        )

    def values(self, name: str) -> Values:
        """Return the values of an attribute, brick by brick; VoxtoolError if it has none."""
        return Values(self.attribute(name), self.bricks)


def _tightened(box: np.ndarray, cells: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Return the box around the set voxels of bricks, of that around the bricks."""
    ends = []
    for axis, (low, high) in enumerate(box.T):
        first, last = low, high - BRICK_SIDE
        union = [np.bitwise_or.reduce(masks[cells[:, axis] == at]) for at in (first, last)]
        begin, end = (np.nonzero(one)[axis] for one in unpack_bricks(np.array(union)))
        ends.append((first + begin.min(), last + end.max() + 1))
    return np.transpose(ends)


@dataclass(frozen=True, eq=False)
class StoredOctree(OctreeContent):
    """An octree whose nodes and bricks stay in a file; it has what OctreeContent needs of them."""

    grid: Grid
    mode: str
    fill: str
    offsets: np.ndarray
    nodes: Slices
    bricks: Slices
    plan: dict[str, Any]
    source_sha256: str
    units: str
    transform: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "offsets", self.offsets[:])
        check_sizes(self)


@dataclass(frozen=True, eq=False)
class StoredAttributedOctree(AttributedContent, StoredOctree):
    """An octree whose nodes and bricks stay in a file, and whose attributes' values do."""

    attributes: tuple[Attribute, ...] = ()
