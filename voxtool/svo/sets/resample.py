"""An octree resampled to another grid, by the share of each new voxel that is set.

The planes between the new voxels are fractions of the octree's voxels. Pitches and origins are
floating-point numbers, so a ratio is taken to be the simplest fraction that their rounding allows:
0.15 is 3/2 of 0.1. With a common denominator, the volume that set voxels cover of a new voxel is a
sum of products of integers, and whether it reaches the threshold is decided exactly.

The nodes of the new octree are visited from the root down; one that covers only set or only unset
voxels is a leaf. Kernels: kernels/svo/sets/resample.cl.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from voxtool.choices import MAX_DIM
from voxtool.errors import GridError, MemoryLimitError, VoxtoolError
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.memory import check_memory
from voxtool.morton import morton_decode
from voxtool.opencl import Device, default_device, program
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES, BRICK_SIDE, descend, voxels_within
from voxtool.svo.octree.links import EMPTY, FULL, REFINED
from voxtool.svo.octree.octree import Octree
from voxtool.svo.octree.prune import octree_of_bricks
from voxtool.svo.sets.attribute_transfer import lost
from voxtool.svo.sets.beyond import share_beyond
from voxtool.svo.sets.placing import ROUNDINGS

SOURCE = "svo/sets/resample.cl"
DEFAULT_THRESHOLD = 0.5
FINEST = 1 << 20  # units along a new voxel, at most: the volume of one fits 64 bits
FARTHEST = 4 * MAX_DIM  # voxels from the octree, beyond which planes are not told apart
CODE_BYTES, HOST_BYTES = 64, 160  # a node that is examined; a brick while the octree is made
STACK = 7 * (MAX_DIM // BRICK_SIDE).bit_length() + 1  # nodes that wait in a walk
HEADERS = {
    "svo/sets/resample.h": program.c_constants(EMPTY=EMPTY, FULL=FULL, REFINED=REFINED, STACK=STACK)
}
LESS = "choose a larger pitch, or allow more (see --max-memory)"


def simplest(low: Fraction, high: Fraction) -> Fraction:
    """Return the fraction of the smallest denominator from low to high, by continued fractions."""
    if low <= 0 <= high:
        return Fraction(0)
    if high < 0:
        return -simplest(-high, -low)
    whole = math.ceil(low)
    if whole <= high:
        return Fraction(whole)
    return whole - 1 + 1 / simplest(1 / (high - whole + 1), 1 / (low - whole + 1))


@dataclass(frozen=True)
class Steps:
    """The planes across an axis, of the voxels of a grid.

    Attributes
    ----------
    unit : int
        Parts of a voxel of the octree, in which planes are counted.
    planes : (n + 1,) int64
        Where each voxel begins, counted from the octree's grid.
    least : int
        The length of a voxel; some are longer by one where planes had to be rounded.
    exact : bool
        Whether no plane was rounded.
    """

    unit: int
    planes: np.ndarray
    least: int
    exact: bool

    @classmethod
    def of(cls, axis: int, old: Grid, new: Grid, count: int) -> Steps:
        """Return the planes of `count` voxels of a grid, in those of another one."""
        pitch, step = Fraction(old.pitch[axis]), Fraction(new.pitch[axis])
        shift = Fraction(new.origin[axis]) - Fraction(old.origin[axis])
        largest = abs(old.origin[axis]) + abs(new.origin[axis])
        slack = Fraction(ROUNDINGS * float(np.spacing(largest))) / pitch if shift else Fraction(0)
        ratio, relative = step / pitch, Fraction(ROUNDINGS * float(np.spacing(1.0)))
        if not 1 / Fraction(MAX_DIM) <= ratio <= MAX_DIM:
            raise GridError(
                f"voxels of {new.pitch[axis]:g} and of {old.pitch[axis]:g}: one would be more than "
                f"{MAX_DIM} times as large as the other: choose another pitch"
            )
        ratio = simplest(ratio * (1 - relative), ratio * (1 + relative))
        start = simplest(shift / pitch - slack, shift / pitch + slack)
        unit = math.lcm(ratio.denominator, start.denominator)
        exact = unit * ratio <= FINEST
        if not exact:
            unit = math.floor(FINEST / ratio)
        first, step = start * unit, ratio * unit
        parts = 2 * math.lcm(first.denominator, step.denominator)
        first, step = int(first * parts) + parts // 2, int(step * parts)  # rounded to the nearest
        most = FARTHEST * unit
        places = [min(max((first + step * n) // parts, -most), most) for n in range(count + 1)]
        return cls(unit, np.array(places, np.int64), step // parts, exact)


@dataclass(frozen=True)
class Placing:
    """The voxels of a new grid among those of an octree, and the volume that each needs."""

    steps: tuple[Steps, Steps, Steps]
    side: int  # voxels along a side of the new octree's cube
    needed: np.ndarray  # (8,) int64: by the axes along which a voxel is longer, x the lowest bit

    @classmethod
    def of(cls, old: Grid, new: Grid, threshold: Fraction) -> Placing:
        """Return the place of a grid; a voxel of it is set if this share of it is."""
        x, y, z = (Steps.of(axis, old, new, new.side) for axis in range(3))
        needed = [
            math.ceil(
                threshold * (x.least + (n & 1)) * (y.least + (n >> 1 & 1)) * (z.least + (n >> 2))
            )
            for n in range(8)
        ]
        return cls((x, y, z), new.side, np.array(needed, np.int64))

    @property
    def exact(self) -> bool:
        """True if no plane was rounded."""
        return all(steps.exact for steps in self.steps)


class Source:
    """An octree on the device, and the arguments that say where the new voxels lie in it."""

    def __init__(self, device: Device, octree: Octree, placing: Placing) -> None:
        top = octree.depth - 1
        planes = np.stack([steps.planes for steps in placing.steps])
        units = np.array([[steps.unit] for steps in placing.steps])
        self.device = device
        self.arguments: dict[str, Any] = {
            "planes": device.put(planes.ravel()),
            "firsts": device.put((planes // units).astype(np.int32).ravel()),
            "ends": device.put((-(-planes // units)).astype(np.int32).ravel()),
            "stride": placing.side + 1,
            "unit": tuple(steps.unit for steps in placing.steps),
            "least": tuple(steps.least for steps in placing.steps),
            "needed": device.put(placing.needed),
            "words": device.put(octree.nodes["child"][: octree.offsets[-2]]),
            "starts": device.put(octree.offsets[top::-1]),  # by level, from 0 up
            "bricks": device.put(octree.bricks),
            "top": top,
        }

    def states(self, codes: np.ndarray, width: int, shape: tuple[int, ...]) -> np.ndarray:
        """Return the (n,) uint8 states of nodes of the new octree, of a width in voxels."""
        states = self.device.empty(len(codes), np.uint8)
        cover_nodes = self.device.kernel(SOURCE, "cover_nodes", CODE="ulong")
        cover_nodes(len(codes), self.device.put(codes), width, shape, states, **self.arguments)
        return states.take()

    def masks(self, codes: np.ndarray) -> np.ndarray:
        """Return the (n,) uint64 voxels of bricks of the new octree that are set."""
        covered = self.device.empty(len(codes), BRICK)
        self.device.kernel(SOURCE, "cover_bricks", CODE="ulong")(
            len(codes), self.device.put(codes), covered, **self.arguments
        )
        return covered.take()


@dataclass(frozen=True)
class ResamplePlan(Plan):
    """The decisions of a resampling."""

    operation, stages = "resample", ("coverage", "build")
    facts = (
        "operation", "shape: grid.shape", "origin: grid.origin", "pitch: grid.pitch", "threshold",
        "exact", "beyond", "nodes",
    )  # fmt: skip
    predicted, costs = ("bricks",), ("device", "host")

    grid: Grid
    threshold: float
    exact: bool  # whether no plane between voxels had to be rounded
    nodes: tuple[int, ...]  # refined ones, by level from the root down to level 1
    given: int  # bytes of the octree
    beyond: float = 0.0  # the share of the set voxels, by volume, that lies beyond the grid

    @property
    def reasons(self) -> dict[str, str]:
        exact = "they are fractions with a small denominator" if self.exact else ""
        return {
            "nodes that cover only set or only unset voxels": "they are leaves",
            "rounding of planes": exact,
        }

    @property
    def bricks(self) -> int:
        """Bricks whose coverage is computed."""
        return 8 * self.nodes[-1]

    @property
    def cost(self) -> Cost:
        return _cost(self.given, self.grid.side, self.bricks)

    def refuse_beyond(self, max_memory: int, max_allocation: int) -> None:
        _refuse(self.cost, max_memory, max_allocation)

    def rows(self) -> list[tuple[str, str]]:
        sizes = " x ".join(f"{size:.6g}" for size in self.grid.pitch)
        planes = "exact" if self.exact else f"rounded to 1/{FINEST} of a voxel"
        return [
            ("grid", f"{' x '.join(map(str, self.grid.shape))} voxels of {sizes}"),
            ("set", f"where {self.threshold:g} of a voxel or more is covered; planes are {planes}"),
            ("bricks", f"at most {self.bricks:,}"),
        ]


def _cost(given: int, side: int, bricks: int) -> Cost:
    planes = 3 * (side + 1) * 16
    return Cost(given + planes + 2 * BRICK_BYTES * bricks, HOST_BYTES * bricks, given)


def _refuse(cost: Cost, max_memory: int, max_allocation: int) -> None:
    if shortage := cost.shortage(max_memory, max_allocation):
        raise MemoryLimitError(f"to resample {shortage}: {LESS}")


def grid_for(
    grid: Grid,
    dim: int | None,
    pitch: float | None,
    bbox: Sequence[float] | None,
    lattice: Grid | None = None,
) -> Grid:
    """Return the grid over a box, by default that of another grid, of `dim` voxels along its
    longest side or of a pitch, by default that of the other grid, or on a lattice.

    Raises
    ------
    GridError
        If nothing is given, or dim and pitch are; or if the grid is out of range.
    """
    if dim is pitch is bbox is lattice is None:
        raise GridError("to what? Give a dim, a pitch, a box, a lattice or another grid")
    if dim is pitch is lattice is None:
        if len(set(grid.pitch)) > 1:
            raise GridError("voxels that are no cubes have no one pitch to keep: give a pitch, too")
        pitch = grid.pitch[0]
    ends = [(0, 0, 0), grid.shape]
    box = grid.to_world(np.array(ends)).ravel().tolist() if bbox is None else bbox
    found = Grid.fit(None, dim, pitch=pitch, bbox=box, lattice=lattice)
    if dim is None or bbox is not None:
        return found
    # the ratio of whole numbers, rounded once: a pitch that stays the same is the same number
    longest = max(range(3), key=lambda axis: grid.shape[axis] * Fraction(grid.pitch[axis]))
    size = float(Fraction(grid.pitch[longest]) * grid.shape[longest] / dim)
    return replace(found, pitch=(size, size, size))


def plan_resample(
    octree: Octree,
    grid: Grid | None = None,
    *,
    lattice: Grid | None = None,
    dim: int | None = None,
    pitch: float | None = None,
    bbox: Sequence[float] | None = None,
    threshold: float = DEFAULT_THRESHOLD,
    device: Device | None = None,
    max_memory: int | None = None,
) -> ResampleJob:
    """Return the planned job of `resample`; see `voxtool.resample`."""
    if not 0 < threshold <= 1:
        raise VoxtoolError(f"threshold {threshold:g} is no share: choose one above 0, up to 1")
    given = grid or bbox
    if grid is None:
        grid = grid_for(octree.grid, dim, pitch, bbox, lattice)
    elif not (dim is pitch is bbox is lattice is None):
        raise GridError("a grid has its own dim, pitch, box and lattice: leave them out")
    device = device or default_device()
    placing = Placing.of(octree.grid, grid, Fraction(repr(float(threshold))))
    most = device.max_memory if max_memory is None else max_memory
    _refuse(_cost(octree.nbytes, grid.side, 0), most, device.info.max_allocation)
    source = Source(device, octree, placing)
    nodes, codes, full, width = [], np.zeros(1, np.uint64), [], grid.side
    while width > BRICK_SIDE:
        check_memory(CODE_BYTES * len(codes), f"{len(codes):,} nodes of the result", LESS, most)
        states = source.states(codes, width, grid.shape)
        full.append(codes[states == FULL])
        codes = codes[states == REFINED]
        nodes.append(len(codes))
        codes, width = descend(codes), width // 2
    beyond = share_beyond(octree, grid) if given else 0.0
    plan = ResamplePlan(grid, float(threshold), placing.exact, tuple(nodes), octree.nbytes, beyond)
    return ResampleJob(octree, source, codes, full[::-1], plan, device, max_memory)


@dataclass
class ResampleJob(Job[Octree]):
    """A planned resampling.

    Attributes
    ----------
    octree : Octree
        The voxels that are resampled.
    plan : ResamplePlan
        The decisions.
    """

    octree: Octree
    source: Source
    codes: np.ndarray  # (n,) uint64 of the bricks whose coverage is to be computed
    full: list[np.ndarray]  # codes of FULL leaves, by level from 1 up
    plan: ResamplePlan
    device: Device
    max_memory: int | None = None

    def _run(self) -> Octree:
        grid, octree = self.plan.grid, self.octree
        with self.stage("coverage"):
            masks = self.source.masks(self.codes)
        with self.stage("build"):
            masks &= voxels_within(morton_decode(self.codes), grid.shape)
            held = np.flatnonzero(masks)
            arrays = octree_of_bricks(
                grid.side, self.codes[held], masks[held], self.full, collapse=True
            )
            return Octree(
                grid, "solid", "none", *arrays, units=octree.units, transform=octree.transform
            )

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield why the result is empty."""
        if not self.octree.count:
            yield "no voxel is set, so none is resampled: see `voxtool svo-info`"
        elif not result.count:
            yield (
                f"no voxel is set: none has a share of {self.plan.threshold:g} that is: choose a "
                "smaller pitch or threshold, or a grid that holds the voxels"
            )
        elif self.plan.beyond:
            yield (
                f"{100 * self.plan.beyond:.3g} % of the set voxels lie beyond the grid: choose a "
                "larger one, or take its lattice (--lattice)"
            )

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield which attributes are not kept."""
        return lost([self.octree], result.attributes)
