"""Attributes of octrees that are made of others: each voxel has the values that it had there.

A voxel of the result takes its values from the first source that sets it; one that no source sets,
as after a dilation, from the source's set voxel whose centre is nearest. Leaves of the result that
would have several values are refined. Labels are united by their names. Fractions are not carried:
a voxel that is cut twice is not the sum of its cuts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from voxtool.memory import check_memory
from voxtool.morton import morton_decode, morton_encode
from voxtool.opencl import Device, default_device
from voxtool.svo.attributes.of_cells import CellValues
from voxtool.svo.attributes.of_points import values_of_voxels
from voxtool.svo.octree.attributes import BITS, Attribute
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.octree import ALLOW, Level, Octree
from voxtool.svo.queries.query import OctreeQuery
from voxtool.svo.sets.priority_union import NONE, Nodes, Union, unite

CARRIED = ("label", "colour", "normal")
KEPT = 'docs/attributes.md, "Changed octrees"'  # says which are
BRICKS = 1 << 14  # bricks whose voxels are looked up at once
CHILDREN = np.arange(8, dtype=np.uint64)
EMPTY, MIXED = -1, -2  # in place of a leaf's place


@dataclass(frozen=True, eq=False)
class Source:
    """An octree with attributes, placed in the grid of a result.

    octree : Octree
    low : (3,) int64, its low corner, in voxels of the result
    """

    octree: Octree
    low: np.ndarray
    levels: list[Level]

    @classmethod
    def of(cls, octree: Octree, low: np.ndarray) -> Source:
        """Return the octree, placed."""
        return cls(octree, np.asarray(low, np.int64), octree.levels())

    def leaves(self, corners: np.ndarray, side: int) -> np.ndarray:
        """Return of cubes with these low corners, (n, 3) voxels of the result, EMPTY, MIXED, or 0
        if the cube is within an inside leaf, (n,) int64."""
        own, whole = corners - self.low, self.octree.grid.side
        found = np.full(len(own), MIXED)
        found[((own + side <= 0) | (own >= whole)).any(axis=1)] = EMPTY
        within = ((own >= 0) & (own + side <= whole)).all(axis=1)
        left = np.flatnonzero(within)
        for level in self.levels[:-1]:
            if level.side < side:
                break
            cells = own[left] // level.side
            held = ((own[left] + side - 1) // level.side == cells).all(axis=1)
            codes = morton_encode(cells)
            at = np.minimum(np.searchsorted(level.codes, codes), len(level.codes) - 1)
            leaf = held & (level.codes[at] == codes) & ~level.refined[at]
            found[left[leaf]] = np.where(level.inside[at[leaf]], 0, EMPTY)
            left = left[~leaf]
        return found

    def holds(self, voxels: np.ndarray) -> np.ndarray:
        """Return whether the octree sets voxels of the result, (n,) bool."""
        own = voxels - self.low
        low, high = own.min(axis=1), (own - self.octree.grid.shape).max(axis=1)
        within = (low >= 0) & (high < 0)
        bricks, codes = self.levels[-1].codes, morton_encode(np.where(within[:, None], own, 0))
        found = within & (self.leaves(voxels, 1) == 0)
        if len(bricks):
            at = np.minimum(np.searchsorted(bricks, codes >> np.uint64(6)), len(bricks) - 1)
            bits = BITS[(codes & np.uint64(63)).astype(int)]
            held = (bricks[at] == codes >> np.uint64(6)) & ((self.octree.bricks[at] & bits) != 0)
            found |= within & held
        return found

    def values(self, name: str, voxels: np.ndarray) -> np.ndarray:
        """Return the values of set voxels of the result."""
        codes = morton_encode(voxels - self.low)
        return values_of_voxels(CellValues(self.octree, name, 0), codes)

    def nearest(self, voxels: np.ndarray, device: Device) -> np.ndarray:
        """Return the set voxels whose centres are nearest to those of voxels of the result."""
        grid = self.octree.grid
        points = np.array(grid.origin) + (voxels - self.low + 0.5) * grid.pitch
        nearest = OctreeQuery(self.octree, device=device, nearest=True)(points).nearest
        assert nearest is not None
        return nearest + self.low


def kept_of(octrees: Sequence[OctreeContent]) -> list[str]:
    """Return the attributes that a result keeps whose voxels are from some octrees."""
    return [name for name in CARRIED if all(_has(octree, name) for octree in octrees)]


def kept_bytes(octrees: Sequence[OctreeContent]) -> int:
    """Return the predicted bytes of the attributes that are kept, in the octrees and the result."""
    names = kept_of(octrees)
    found = (one for octree in octrees for one in octree.attributes if one.name in names)
    return 2 * sum(one.nbytes for one in found)


def check_kept(octrees: Sequence[OctreeContent], max_memory: int | None) -> None:
    """Raise MemoryLimitError if these attributes take more memory than they may."""
    if size := kept_bytes(octrees):
        what = f"the attributes that are kept, {', '.join(kept_of(octrees))},"
        check_memory(size, what, ALLOW, max_memory)


def carried(
    result: Octree, octrees: Sequence[Octree], lows: Sequence[np.ndarray], device: Device
) -> Octree:
    """Return the result with the attributes that all of some octrees have, whose low corners are at
    these voxels of its grid; the result itself if there are none."""
    names = kept_of(octrees)
    if not names or not result.count:
        return result
    sources = [Source.of(octree, low) for octree, low in zip(octrees, lows, strict=True)]
    nodes, corners = _refined(result, sources)
    union = unite(device, nodes)
    bricks = union.bricks.get()
    attributes = tuple(
        _attribute(name, octrees, sources, union, bricks, corners, device) for name in names
    )
    made = Octree.of_states(result.grid, result.mode, result.fill, union.levels, bricks)
    described = {"plan": result.plan, "units": result.units, "transform": result.transform}
    return replace(made, attributes=attributes, source_sha256=result.source_sha256, **described)


def with_attributes(
    result: Octree, octree: Octree, low: np.ndarray, device: Device | None = None
) -> Octree:
    """Return the result with the attributes of the octree that it was made of, whose low corner is
    at this voxel of its grid."""
    if not octree.attributes:
        return result
    device = device or default_device()
    with device.stage("attributes"):
        return carried(result, [octree], [low], device)


def lost(octrees: Sequence[OctreeContent], kept: Sequence[Attribute] = ()) -> Iterator[str]:
    """Yield a note that names the attributes of octrees that what is made of them does not keep, if
    there are any."""
    names = dict.fromkeys(one.name for octree in octrees for one in octree.attributes)
    for one in kept:
        names.pop(one.name, None)
    if names:
        yield f"not kept: the attribute{'s' * (len(names) > 1)} {', '.join(names)} ({KEPT})"


def _has(octree: OctreeContent, name: str) -> bool:
    return name in (attribute.name for attribute in octree.attributes)


def _refined(result: Octree, sources: Sequence[Source]) -> tuple[Nodes, np.ndarray]:
    """Return the nodes of the result, with leaves refined until each lies in a leaf of the first
    source that sets it, and the low corner of each inside leaf by its rank, (L, 3)."""
    nodes, corners, count = Nodes.of_depth(result.depth), [np.empty((0, 3), np.int64)], 0
    split = np.empty(0, np.uint64)  # full nodes of a level that have to be refined
    for level in result.levels():
        whole = (split[:, None] << np.uint64(3) | CHILDREN).ravel()
        if not level.number:
            codes = np.concatenate([level.codes, whole])
            masks = np.concatenate([result.bricks, np.full(len(whole), ~np.uint64(0))])
            order = np.argsort(codes, kind="stable")
            nodes.add_bricks(codes[order], np.zeros(len(codes), np.uint32), masks[order])
            break
        full = np.concatenate([level.codes[level.inside], whole])
        at = morton_decode(full) * level.side
        constant = _constant(sources, at, level.side)
        split = np.sort(full[~constant])
        own, at = full[constant], at[constant]
        codes = np.concatenate([level.codes[level.refined], split, own])
        refined = np.arange(len(codes)) < len(codes) - len(own)
        ranks = np.full(len(codes), NONE, np.uint32)
        ranks[~refined] = count + np.arange(len(own))
        order = np.argsort(codes, kind="stable")
        nodes.add(level.number, codes[order], ranks[order], refined[order], ~refined[order])
        corners.append(at)
        count += len(own)
    return nodes, np.concatenate(corners)


def _constant(sources: Sequence[Source], corners: np.ndarray, side: int) -> np.ndarray:
    """Return which cubes lie in an inside leaf of the first source that sets any of it."""
    constant, open_ = np.zeros(len(corners), bool), np.arange(len(corners))
    for source in sources:
        found = source.leaves(corners[open_], side)
        constant[open_[found == 0]] = True
        open_ = open_[found == EMPTY]
    return constant


def _attribute(
    name: str,
    octrees: Sequence[Octree],
    sources: Sequence[Source],
    union: Union,
    bricks: np.ndarray,
    corners: np.ndarray,
    device: Device,
) -> Attribute:
    """Return an attribute of the union."""
    given = [octree.attribute(name) for octree in octrees]
    names = tuple(dict.fromkeys(label for one in given for label in one.names))
    numbers = {label: number for number, label in enumerate(names)}
    maps = [np.array([numbers[label] for label in one.names], np.int64) for one in given]
    dtype = given[0].values.dtype
    if name == "label":
        dtype = np.dtype("u1" if len(names) <= 1 << 8 else "u2" if len(names) <= 1 << 16 else "u4")

    def of(voxels: np.ndarray) -> np.ndarray:
        found = np.zeros((len(voxels), *given[0].values.shape[1:]), dtype)
        left = np.arange(len(voxels))
        for source, labels in zip(sources, maps, strict=True):
            held = source.holds(voxels[left])
            own = source.values(name, voxels[left[held]])
            found[left[held]] = labels[own] if names else own
            left = left[~held]
        if len(left):  # set by no source: there is one
            own = sources[0].values(name, sources[0].nearest(voxels[left], device))
            found[left] = maps[0][own] if names else own
        return found

    level_0 = (union.codes[:, None] << np.uint64(3) | CHILDREN).ravel()
    parts = [np.empty((0, *given[0].values.shape[1:]), dtype)]
    some = np.flatnonzero(bricks)
    for first in range(0, len(some), BRICKS):
        part = some[first : first + BRICKS]
        row, bit = np.nonzero(bricks[part][:, None] & BITS)
        codes = level_0[part[row]] << np.uint64(6) | bit.astype(np.uint64)
        parts.append(of(morton_decode(codes).astype(np.int64)))
    leaves = of(corners[union.leaves])
    default = given[0].default
    return Attribute(name, np.concatenate(parts), leaves, default=default, names=names)
