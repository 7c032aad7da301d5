"""Surfaces without the voxels that they do not need: N-minimal sets ([Cohen 1995]).

A set of voxels N-separates two voxels if every N-path between them meets it: no N-component of its
complement holds both. A voxel is N-simple if the set N-separates the same without it, and a set
without N-simple voxels is N-minimal.

Each unset voxel is labelled with its component of the complement. A voxel goes if its unset
N-neighbours have one label, which it takes over; so no two N-neighbours ever have different labels,
and no component is joined with another. If they have two labels, it joins two components, now and
whatever goes later, and stays. So each voxel is decided once. Voxels of one parity are no
neighbours, and are decided together; docs/voxels.md has the proof. On the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.job import Cost, Job, Plan
from voxtool.morton import distinct, morton_decode, morton_encode, morton_step
from voxtool.svo.octree.layout import BRICK_SIDE
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.attribute_transfer import lost
from voxtool.svo.sets.components import BRICK_HOST_BYTES, FEWER, Components
from voxtool.svo.sets.tiling import BRICKS, TILE, Tiling

NEIGHBOURS_OF = {"surface26": 26, "surface6": 6}  # by the mode of an octree
PARITIES = np.uint64(7)  # of a Morton code: whether each coordinate is odd
HOST_BYTES = 400  # bytes of a set voxel, at peak
OPEN = (
    "of {count:,} voxels {gone:,} separated nothing, as those of a surface with holes: close its "
    "mesh first (voxtool repair), or choose a smaller dim, where holes are smaller than a voxel"
)


def steps_of(neighbours: int) -> list[tuple[int, ...]]:
    """Return the steps to the 6 or 26 neighbours of a voxel."""
    steps = product((-1, 0, 1), repeat=3)
    return [s for s in steps if any(s) and (neighbours == 26 or sum(map(abs, s)) == 1)]


def with_neighbours(codes: np.ndarray, neighbours: int, side: int) -> np.ndarray:
    """Return the ascending Morton codes of voxels and their neighbours in a cube of `side`."""
    found = [codes]
    for axis in range(3):
        base = found if neighbours == 6 else [codes]
        near = [morton_step(base[0], axis, step, side)[0] for step in (-1, 1)]
        if neighbours == 6:
            found += near
        else:
            codes = distinct(np.concatenate([codes, *near]))
    return distinct(np.concatenate(found)) if neighbours == 6 else codes


def labels_at(found: Components, codes: np.ndarray) -> np.ndarray:
    """Return the component, from 1 on, of each voxel of the components' set, given by its Morton
    code in the frame; 0 of other voxels."""
    pieces = found.pieces
    bits = (TILE**3).bit_length() - 1
    tiles = codes >> np.uint64(bits)
    piece = pieces.leaf_of(morton_decode(tiles), 0)
    places = np.searchsorted(pieces.voxels.codes, tiles)
    mixed = np.append(pieces.voxels.codes, ~np.uint64(0))[places] == tiles
    left = np.flatnonzero(mixed)
    inner = codes[left] & np.uint64(TILE**3 - 1)
    brick = BRICKS * places[left] + (inner // np.uint64(BRICK_SIDE**3)).astype(np.int64)
    bit = np.uint64(1) << (inner % np.uint64(BRICK_SIDE**3))
    part, end = pieces.first[brick], pieces.first[brick + 1]
    while len(left := left[more := part < end]):
        part, end, bit = part[more], end[more], bit[more]
        hit = (pieces.parts[part] & bit) != 0
        piece[left[hit]] = pieces.leaves + part[hit]
        part = part + 1
    return np.where(piece >= 0, found.of_pieces[piece] + 1, 0).astype(np.int32)


class Peeling:
    """The set voxels of a surface and the labels around them, while voxels go.

    Attributes
    ----------
    codes : (n,) uint64
        Ascending Morton codes of the set voxels, in the frame.
    places : (n,) int64
        Where each is among the labels.
    labels : (m,) int32
        The labels of the set voxels and their neighbours, in Morton order; 0 of a set voxel.
    beside : (6 or 26, n) int32
        Where the neighbours of each set voxel are among the labels.
    """

    def __init__(self, voxels: Tiling, codes: np.ndarray, neighbours: int) -> None:
        around = with_neighbours(codes, neighbours, TILE * voxels.side)
        self.codes = codes
        self.places = np.searchsorted(around, codes)
        self.labels = labels_at(Components.of(voxels.complement(), neighbours), around)
        self.beside = np.empty((len(steps_of(neighbours)), len(codes)), np.int32)
        cells = morton_decode(codes)
        for row, step in enumerate(steps_of(neighbours)):
            self.beside[row] = np.searchsorted(around, morton_encode(cells + step))

    def run(self) -> np.ndarray:
        """Return the voxels that stay, (n,) bool."""
        index = np.full(len(self.labels), -1, np.int32)  # of the set voxel at a place
        index[self.places] = np.arange(len(self.codes))
        seen = np.zeros(len(self.codes), bool)
        stays = np.zeros(len(self.codes), bool)  # those that no label reaches go, too
        layer = np.flatnonzero((self.labels[self.beside] > 0).any(axis=0))
        while len(layer):
            seen[layer] = True
            gone = self.peel(layer, stays)
            near = index[self.beside[:, gone].ravel()]
            near = near[near >= 0]
            layer = distinct(near[~seen[near]])
        return stays

    def peel(self, layer: np.ndarray, stays: np.ndarray) -> np.ndarray:
        """Decide the voxels of a layer, which all have a labelled neighbour: mark those that stay,
        and return the others, which take over the label of their neighbours."""
        parity, gone = self.codes[layer] & PARITIES, []
        for own in range(8):
            chosen = layer[parity == own]
            near = self.labels[self.beside[:, chosen]]
            most = near.max(axis=0, initial=0)
            least = np.where(near > 0, near, np.iinfo(np.int32).max).min(axis=0, initial=1 << 30)
            single = least == most
            stays[chosen[~single]] = True
            self.labels[self.places[chosen[single]]] = most[single]
            gone.append(chosen[single])
        return np.concatenate(gone)


@dataclass(frozen=True)
class ThinPlan(Plan):
    """The decisions of thinning."""

    operation, stages = "thin", ("components", "thin", "build")
    facts = ("operation", "neighbours", "voxels")
    predicted, costs = ("tiles",), ("host",)
    refusal = f"thinning {{shortage}}: {FEWER}"

    neighbours: int
    voxels: int
    tiles: int

    @property
    def reasons(self) -> dict[str, str]:
        return {
            "voxels away from the surface": "only neighbours of set voxels have labels",
            "neighbours across edges and corners": (
                "paths go across faces" if self.neighbours == 6 else ""
            ),
        }

    @property
    def cost(self) -> Cost:
        parts = BRICK_HOST_BYTES[self.neighbours] * BRICKS * self.tiles
        return Cost(device=0, host=parts + HOST_BYTES * self.voxels)

    def rows(self) -> list[tuple[str, str]]:
        return [("voxels", f"{self.voxels:,} set ones, thinned for {self.neighbours}-separation")]


class ThinJob(Job[Octree]):
    """A planned thinning of a surface.

    Attributes
    ----------
    octree : Octree
        The surface.
    plan : ThinPlan
        The decisions.
    """

    plan: ThinPlan
    device = None

    def __init__(
        self, octree: Octree, voxels: Tiling, plan: ThinPlan, max_memory: int | None
    ) -> None:
        self.octree, self._voxels = octree, voxels
        self.plan, self.max_memory = plan, max_memory

    def _run(self) -> Octree:
        octree, voxels = self.octree, self._voxels
        with self.stage(self.plan.stages[0]):
            codes = np.sort(morton_encode(octree.occupied() + voxels.corner))
            peeling = Peeling(voxels, codes, self.plan.neighbours)
        with self.stage(self.plan.stages[1]):
            stays = peeling.run()
        with self.stage(self.plan.stages[2]):
            kept = morton_decode(codes[stays]) - voxels.corner
            thin = Octree.from_voxels(kept, octree.grid, mode=octree.mode, units=octree.units)
            same = {name: getattr(octree, name) for name in ("plan", "source_sha256", "transform")}
            return replace(thin, fill=octree.fill, **same)

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield why most voxels went."""
        count = self.octree.count
        if 2 * result.count < count:
            yield OPEN.format(count=count, gone=count - result.count)

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield which attributes are not kept."""
        return lost([self.octree], result.attributes)

    def details(self, result: Octree) -> Iterator[str]:
        """Yield how many voxels went."""
        if count := self.octree.count:
            gone = count - result.count
            yield f"{gone:,} of {count:,} voxels ({100 * gone / count:.1f} %) separated nothing"


def plan_thin(octree: Octree, *, max_memory: int | None = None) -> ThinJob:
    """Return the planned job of `thin`; see `voxtool.thin`."""
    if octree.mode not in NEIGHBOURS_OF:
        raise VoxtoolError(
            f"an octree of mode {octree.mode} is no surface: voxelize with mode surface26 or "
            "surface6"
        )
    voxels = Tiling.of(octree, 0)
    plan = ThinPlan(NEIGHBOURS_OF[octree.mode], octree.count, len(voxels.codes))
    return ThinJob(octree, voxels, plan, max_memory)
