"""Connected components of a set of voxels, and its cavities.

The pieces of a set are its FULL leaves and the connected parts of its bricks. Pieces that touch are
united; a component is known by its size, and by its first voxel in Morton order among those of one
size. A cavity is a component of the complement that is not the outside. On the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from voxtool.choices import NEIGHBOURS
from voxtool.errors import VoxtoolError, count_of
from voxtool.job import Cost, Job, Plan
from voxtool.mesh.topology import components
from voxtool.morton import morton_decode, morton_encode
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.attribute_transfer import lost, with_attributes
from voxtool.svo.sets.tiling import BRICK_CELLS, BRICKS, LEVEL, TILE, Tiling

# The voxels of coordinate 0 along an axis, as in kernels/svo/voxelization/fill/beside.h.
LOW = np.array([0x0055005500550055, 0x0000333300003333, 0x000000000F0F0F0F], np.uint64)
AXES = {6: 1, 18: 2, 26: 3}  # along which a neighbour may lie a step away
BRICK_HOST_BYTES = {6: 200, 18: 400, 26: 400}  # of a brick of a mixed tile, at peak, by neighbours
SHOWN = 10  # sizes in a note
KEEP, FILL, LABEL = "keep", "fill-cavities", "components"  # operations
STAGES = {KEEP: ["components", "build"], FILL: ["fill cavities", "build"], LABEL: ["components"]}
FEWER = "make it coarser by --resample, voxelize at a smaller dim, or allow more (see --max-memory)"


def spilled_along(axis: int, masks: np.ndarray, step: int) -> np.ndarray:
    """Return the voxels, in the bricks `step` (-1, 0 or 1) away along an axis, that touch voxels of
    masks with the same other coordinates."""
    low = LOW[axis]
    one, two, three = (np.uint64(n << axis) for n in (1, 8, 9))
    if step > 0:
        return (masks >> three) & low
    if step < 0:
        return (masks & low) << three
    outer = low | low << two
    up = (masks & outer) << one | (masks & low << one) << (two - one)
    return masks | up | (masks >> one & outer) | (masks >> (two - one) & low << one)


def spilled(masks: np.ndarray, step: tuple[int, ...], neighbours: int) -> np.ndarray:
    """Return the voxels, in the bricks a step away, that touch voxels of masks."""
    for axis in np.flatnonzero(step).tolist():
        masks = spilled_along(axis, masks, step[axis])
    within = [axis for axis in range(3) if not step[axis]]
    reached = np.zeros_like(masks)
    for axes in combinations(within, min(AXES[neighbours] + len(within) - 3, len(within))):
        found = masks
        for axis in axes:
            found = spilled_along(axis, found, 0)
        reached |= found
    return reached


def split(bricks: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the connected parts of bricks: the index of the brick of each, ascending, and its
    mask."""
    owners, parts = [], []
    owner = np.flatnonzero(bricks)
    left = bricks[owner]
    while len(owner):
        part = left & (~left + np.uint64(1))  # the lowest voxel
        grown = spilled(part, (0, 0, 0), neighbours) & left
        while not np.array_equal(grown, part):
            part, grown = grown, spilled(grown, (0, 0, 0), neighbours) & left
        owners.append(owner)
        parts.append(part)
        left = left & ~part
        owner, left = owner[left != 0], left[left != 0]
    found = np.concatenate([owner, *owners])
    order = np.argsort(found, kind="stable")
    return found[order], np.concatenate([left, *parts])[order]


class Pieces:
    """The pieces of a set, and which of them touch: leaves by level and Morton code, then parts."""

    def __init__(self, voxels: Tiling, neighbours: int) -> None:
        self.voxels, self.neighbours = voxels, neighbours
        self.starts = np.cumsum([0, *map(len, voxels.full)])  # the first leaf of each level
        self.owners, self.parts = split(voxels.bricks.ravel(), neighbours)
        counts = np.bincount(self.owners, minlength=voxels.bricks.size)
        self.first = np.concatenate([[0], np.cumsum(counts)])  # the first part of each brick

    @property
    def leaves(self) -> int:
        """The number of leaves."""
        return int(self.starts[-1])

    def leaf_of(self, cells: np.ndarray, level: int) -> np.ndarray:
        """Return the leaf that holds each cell, `level` levels above the tiles; -1 for none."""
        side = self.voxels.side >> level
        within = np.all((cells >= 0) & (cells < side), axis=1)
        codes = morton_encode(np.clip(cells, 0, side - 1))
        found = np.full(len(cells), -1)
        for above, leaves in enumerate(self.voxels.full[level:]):
            if len(leaves):
                own = codes >> np.uint64(3 * above)
                places = np.minimum(np.searchsorted(leaves, own), len(leaves) - 1)
                hit = within & (leaves[places] == own)
                found[hit] = self.starts[level + above] + places[hit]
        return found

    def links(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the pairs of pieces that touch."""
        for step in product((-1, 0, 1), repeat=3):
            if 0 < sum(map(abs, step)) <= AXES[self.neighbours]:
                yield from self._of_leaves(step)
                yield from self._of_parts(step)

    def _of_leaves(self, step: tuple[int, ...]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the leaves that touch a leaf of at least their size, a step away."""
        for level, codes in enumerate(self.voxels.full):
            other = self.leaf_of(morton_decode(codes) + step, level)
            touching = np.flatnonzero(other >= 0)
            yield self.starts[level] + touching, other[touching]

    def _of_parts(self, step: tuple[int, ...]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the parts that touch a leaf, or a part of another brick, a step away."""
        codes, places = self.voxels.codes, BRICK_CELLS + np.array(step, np.int64)
        away, within = places >> LEVEL, morton_encode(places & ((1 << LEVEL) - 1))
        cells = morton_decode(codes)
        for tile_step in np.unique(away, axis=0):
            chosen = np.flatnonzero((away == tile_step).all(axis=1))
            beside = cells + tile_step
            leaf = self.leaf_of(beside, 0)
            held = np.flatnonzero(leaf >= 0)
            own = (BRICKS * held[:, None] + chosen).ravel()
            yield from self._pairs(step, own, leaf=np.repeat(leaf[held], len(chosen)))
            if step < (0, 0, 0):
                continue  # bricks find each other from one side
            at = np.minimum(np.searchsorted(codes, morton_encode(beside)), len(codes) - 1)
            held = np.flatnonzero((morton_decode(codes[at]) == beside).all(axis=1))
            own = (BRICKS * held[:, None] + chosen).ravel()
            other = (BRICKS * at[held][:, None] + within[chosen].astype(np.int64)).ravel()
            yield from self._pairs(step, own, other=other)

    def _pairs(
        self,
        step: tuple[int, ...],
        own: np.ndarray,
        *,
        leaf: np.ndarray | None = None,
        other: np.ndarray | None = None,
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the parts of bricks that touch a leaf, or parts of the other bricks."""
        second = leaf if other is None else other
        assert second is not None
        i = 0
        while len(own := own[kept := self.first[own] + i < self.first[own + 1]]):
            second = second[kept]
            part = self.first[own] + i
            reach = spilled(self.parts[part], step, self.neighbours)
            part, reach, target = part[reach != 0], reach[reach != 0], second[reach != 0]
            if other is None:
                yield self.leaves + part, target
            j = 0
            while other is not None and len(
                target := target[more := self.first[target] + j < self.first[target + 1]]
            ):
                part, reach = part[more], reach[more]
                touched = self.first[target] + j
                touching = (reach & self.parts[touched]) != 0
                yield self.leaves + part[touching], self.leaves + touched[touching]
                j += 1
            i += 1

    def sizes(self) -> np.ndarray:
        """Return the voxels of each piece, int64."""
        of_leaves = [(TILE << level) ** 3 for level in range(len(self.voxels.full))]
        return np.concatenate(
            [
                np.repeat(np.array(of_leaves, np.int64), np.diff(self.starts)),
                np.bitwise_count(self.parts).astype(np.int64),
            ]
        )

    def first_voxels(self) -> np.ndarray:
        """Return the Morton code of the first voxel of each piece."""
        bits = TILE.bit_length() - 1
        leaves = [
            codes << np.uint64(3 * (bits + level)) for level, codes in enumerate(self.voxels.full)
        ]
        lowest = np.bitwise_count((self.parts & (~self.parts + np.uint64(1))) - np.uint64(1))
        return np.concatenate([*leaves, self.brick_codes() * np.uint64(BRICK_SIDE**3) + lowest])

    def brick_codes(self) -> np.ndarray:
        """Return the Morton code of the brick of each part."""
        tiles = self.voxels.codes[self.owners // BRICKS] * np.uint64(BRICKS)
        return tiles + (self.owners % BRICKS).astype(np.uint64)


@dataclass(frozen=True)
class Components:
    """The connected components of a set, the largest first.

    Attributes
    ----------
    sizes : (n,) int64
        The voxels of each.
    of_pieces : (m,) int64
        The component of each piece.
    """

    pieces: Pieces
    sizes: np.ndarray
    of_pieces: np.ndarray

    @classmethod
    def of(cls, voxels: Tiling, neighbours: int) -> Components:
        """Return the components across faces (6), also edges (18) or corners (26)."""
        pieces = Pieces(voxels, neighbours)
        sizes = pieces.sizes()
        links = [np.stack(pair) for pair in pieces.links()]
        u, v = np.concatenate([np.empty((2, 0), np.int64), *links], axis=1).astype(np.int64)
        roots, of_pieces = np.unique(components(u, v, len(sizes)), return_inverse=True)
        total = np.zeros(len(roots), np.int64)
        np.add.at(total, of_pieces, sizes)
        first = np.full(len(roots), ~np.uint64(0))
        np.minimum.at(first, of_pieces, pieces.first_voxels())
        order = np.lexsort([first, -total])
        ranks = np.empty_like(order)
        ranks[order] = np.arange(len(order))
        return cls(pieces, total[order], ranks[of_pieces])

    def chosen(self, keep: np.ndarray) -> Tiling:
        """Return the set of the components whose flag in the (n,) bool array is set."""
        voxels, kept = self.pieces.voxels, keep[self.of_pieces]
        of_leaves = np.split(kept[: self.pieces.leaves], self.pieces.starts[1:-1])
        full = [codes[flags] for codes, flags in zip(voxels.full, of_leaves, strict=True)]
        bricks, parts = np.zeros(voxels.bricks.size, np.uint64), kept[self.pieces.leaves :]
        np.bitwise_or.at(bricks, self.pieces.owners[parts], self.pieces.parts[parts])
        return Tiling(voxels.corner, voxels.codes, bricks.reshape(-1, BRICKS), full).normal()


def without_cavities(voxels: Tiling) -> Tiling:
    """Return a set with its cavities filled: what the outside cannot reach across faces."""
    outside = Components.of(voxels.complement(), 6)
    corner = outside.pieces.leaf_of(np.zeros((1, 3), np.int64), 0)[0]  # of the frame
    return outside.chosen(np.arange(len(outside.sizes)) == outside.of_pieces[corner]).complement()


def check_neighbours(neighbours: int) -> None:
    """Raise VoxtoolError if voxels are not connected in this way."""
    if neighbours not in NEIGHBOURS:
        raise VoxtoolError(
            f"neighbours {neighbours}: choose one of {', '.join(map(str, NEIGHBOURS))}"
        )


@dataclass(frozen=True)
class ComponentsPlan(Plan):
    """The decisions of work on components."""

    facts = ("operation", "largest", "min_size", "neighbours")
    predicted, costs = ("tiles",), ("host",)
    refusal = f"components {{shortage}}: {FEWER}"

    operation: str  # KEEP, FILL or LABEL
    neighbours: int
    tiles: int
    largest: int | None = None  # components that stay at most; None: all
    min_size: int = 1  # voxels of a component that stays

    @property
    def stages(self) -> list[str]:
        return STAGES[self.operation]

    @property
    def reasons(self) -> dict[str, str]:
        return {"voxels of leaves": "a leaf is one piece"}

    @property
    def cost(self) -> Cost:
        return Cost(device=0, host=BRICK_HOST_BYTES[self.neighbours] * BRICKS * self.tiles)

    def rows(self) -> list[tuple[str, str]]:
        return [("tiles", f"{self.tiles:,} of {TILE} x {TILE} x {TILE} voxels are mixed")]


class ComponentsJob(Job[Octree]):
    """A planned choice of components.

    Attributes
    ----------
    octree : Octree
        The voxels.
    plan : ComponentsPlan
        The decisions.
    sizes : (n,) int64
        The voxels of each component of the octree, the largest first, once the job has run; empty
        where cavities are filled.
    """

    plan: ComponentsPlan
    device = None

    def __init__(
        self, octree: Octree, voxels: Tiling, plan: ComponentsPlan, max_memory: int | None
    ) -> None:
        self.octree, self._voxels = octree, voxels
        self.plan, self.max_memory = plan, max_memory
        self.sizes = np.empty(0, np.int64)

    def _run(self) -> Octree:
        plan, octree = self.plan, self.octree
        with self.stage(plan.stages[0]):
            if plan.operation == FILL:
                voxels = without_cavities(self._voxels)
            else:
                found = Components.of(self._voxels, plan.neighbours)
                self.sizes = found.sizes
                keep = self.sizes >= plan.min_size
                if plan.largest is not None:
                    keep[plan.largest :] = False
                voxels = found.chosen(keep)
        with self.stage("build"):
            corner = np.zeros(3, np.int64)
            result = voxels.octree(octree.grid, corner, octree.units, octree.transform)
        return with_attributes(result, octree, corner)

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield why the result is empty."""
        if not self.octree.count:
            yield "no voxel is set, so there is no component: see `voxtool svo-info`"
        elif not result.count:
            yield (
                f"no component is left: the largest has {int(self.sizes[0]):,} voxels: choose a "
                "smaller least size"
            )

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield which attributes are not kept."""
        return lost([self.octree], result.attributes)

    def details(self, result: Octree) -> Iterator[str]:
        """Yield the sizes of the components."""
        if len(self.sizes):
            sizes = ", ".join(f"{size:,}" for size in self.sizes[:SHOWN].tolist())
            more = ", ..." if len(self.sizes) > SHOWN else ""
            yield f"{count_of(len(self.sizes), 'component')}, of {sizes}{more} voxels"


def plan_keep_components(
    octree: Octree,
    largest: int | None = None,
    *,
    min_size: int = 1,
    neighbours: int = NEIGHBOURS[0],
    max_memory: int | None = None,
) -> ComponentsJob:
    """Return the planned job of `keep_components`; see `voxtool.keep_components`."""
    check_neighbours(neighbours)
    if largest is not None and largest < 1:
        raise VoxtoolError(f"{largest} components: keep 1 or more")
    if min_size < 1:
        raise VoxtoolError(f"least size {min_size}: give 1 or more voxels")
    voxels = Tiling.of(octree, 0)
    plan = ComponentsPlan(KEEP, neighbours, len(voxels.codes), largest, min_size)
    return ComponentsJob(octree, voxels, plan, max_memory)


def plan_fill_cavities(octree: Octree, *, max_memory: int | None = None) -> ComponentsJob:
    """Return the planned job of `fill_cavities`; see `voxtool.fill_cavities`."""
    voxels = Tiling.of(octree, 0)
    plan = ComponentsPlan(FILL, 6, len(voxels.codes))
    return ComponentsJob(octree, voxels, plan, max_memory)
