"""Morphology: dilation, erosion, opening, closing and shells of sets of voxels ([Serra 1982]).

A set is dilated by a structuring element: a ball, a cube or a cross around each of its voxels. The
element is a table of widths: of its rows along x, the steps that they reach to either side. They
follow from the squares of the radius and the pitch as rational numbers, so an element is exact.
Each plane of a tile is dilated by every section of the element along z: its rows, 16 voxels in a
word, are grown along x a step at a time, and united where the element has that width. Then the
sections of the planes around each plane are united. Only tiles that the boundary can reach are
examined; FULL and empty nodes stay leaves.

An erosion is the dilation of the complement, to which all that lies beyond the grid belongs.
Kernels: kernels/svo/sets/morphology.cl.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from voxtool.choices import ELEMENTS, MORPHOLOGY
from voxtool.errors import VoxtoolError, at_least
from voxtool.grid import Grid
from voxtool.job import Cost, Job, Plan
from voxtool.morton import among, spread_bits
from voxtool.opencl import Array, Device, default_device, program
from voxtool.svo.octree.content import OctreeContent
from voxtool.svo.octree.layout import BRICK, BRICK_BYTES
from voxtool.svo.octree.octree import Octree
from voxtool.svo.sets.attribute_transfer import lost, with_attributes
from voxtool.svo.sets.tiling import BRICKS, TILE, Box, Tiling

SOURCE = "svo/sets/morphology.cl"
NONE = 0xFFFFFFFF  # instead of the index of a tile
MAX_REACH = 128  # voxels
SCRATCH = 1 << 26  # bytes of dilated planes at once
Z_BITS = spread_bits(np.array((1 << 21) - 1)) << np.uint64(2)  # bits of a Morton code
TILE_BYTES = 2 * BRICK_BYTES * BRICKS  # bricks and rows
COPIES = 2  # times TILE_BYTES that the host takes for a tile of the boundary
MAX_HALO = -(-MAX_REACH // TILE)  # tiles
HEADERS = {"svo/sets/morphology.h": program.c_constants(MAX_HALO=MAX_HALO, NONE=NONE)}


@dataclass(frozen=True)
class Element:
    """A structuring element.

    Attributes
    ----------
    reach : (3,) int
        The farthest voxel along each axis.
    widths : (reach[2] + 1, reach[1] + 1) int32
        By steps along z and y: the steps that a row reaches along x, -1 where there is none.
    """

    reach: tuple[int, int, int]
    widths: np.ndarray

    @classmethod
    def of(cls, shape: str, radius: float, pitch: tuple[float, ...]) -> Element:
        """Return the element of a shape and a radius; a voxel belongs to it if its centre is within
        the radius, which is in the unit of the pitch.

        "ball": by Euclidean distance. "cube": by the largest distance along an axis. "cross": the
        voxels along the axes.

        Raises
        ------
        VoxtoolError
            If the shape is unknown, or the radius is negative, not finite, or beyond MAX_REACH.
        """
        if shape not in ELEMENTS:
            raise VoxtoolError(f"shape {shape!r} is unknown: choose one of {', '.join(ELEMENTS)}")
        if not (math.isfinite(radius) and radius >= 0):
            raise VoxtoolError(f"radius {radius:g} is no length: give 0 or more")
        r, (px, py, pz) = Fraction(radius), map(Fraction, pitch)
        nx, ny, nz = reach = tuple(math.floor(r / p) for p in (px, py, pz))
        if max(reach) > MAX_REACH:
            raise VoxtoolError(
                f"radius {radius:g} reaches more than the {MAX_REACH} voxels that are allowed: "
                "choose a smaller radius, or voxelize with a smaller dim"
            )
        widths = np.full((nz + 1, ny + 1), -1, np.int32)
        if shape == "cube":
            widths[:] = nx
        elif shape == "cross":
            widths[0], widths[:, 0], widths[0, 0] = 0, 0, nx
        else:
            for k in range(nz + 1):
                for j in range(ny + 1):
                    left = r * r - (py * j) ** 2 - (pz * k) ** 2
                    if left >= 0:
                        widths[k, j] = math.isqrt(math.floor(left / (px * px)))
        return cls((nx, ny, nz), widths)

    @property
    def halo(self) -> tuple[int, int, int]:
        """The farthest tile along each axis."""
        x, y, z = (-(-n // TILE) for n in self.reach)
        return x, y, z

    @property
    def steps(self) -> tuple[np.ndarray, np.ndarray]:
        """The steps along y and z to the rows of the element, (n, 2) uint16 by ascending width, and
        the first row of each width, (reach[0] + 2,) uint32."""
        z, y = np.nonzero(self.widths >= 0)
        widths = self.widths[z, y]
        order = np.argsort(widths, kind="stable")
        firsts = np.searchsorted(widths[order], np.arange(self.reach[0] + 2))
        return np.stack([y, z], axis=1)[order].astype(np.uint16), firsts.astype(np.uint32)

    @property
    def scratch(self) -> int:
        """Bytes that the dilation of a tile takes for a while."""
        across, along = (2 * self.halo[0] + 1) * (2 * self.halo[1] + 1), 2 * self.halo[2] + 1
        planes = 2 * TILE**2 * (self.reach[2] + 1) + 4 * across  # of a tile above or below
        return (planes + 4) * along + TILE_BYTES


def dilate(device: Device, voxels: Tiling, element: Element, batch: int, box: Box) -> Tiling:
    """Return a set of voxels dilated by an element, `batch` tiles at a time; only what lies in the
    box is right."""
    codes = voxels.boundary(box.grown(element.reach))
    hx, hy, hz = element.halo
    wanted, planes = voxels.around(codes, element.halo), voxels.around(codes, (hx, hy, 0))
    wanted = wanted[~voxels.is_full(wanted) & voxels.within(wanted, box)]
    planes = planes[~voxels.is_full(planes) | among(codes, planes)]
    columns = np.lexsort([wanted & Z_BITS, wanted & ~Z_BITS])  # so that a batch shares planes
    bricks = np.empty((len(wanted), BRICKS), BRICK)
    rows = device.empty(TILE**2 * len(codes), np.uint16)
    kernel = device.kernel
    kernel(SOURCE, "rows_of_bricks", CODE="ulong")(
        rows.size, device.put(voxels.bricks_of(codes)), rows
    )
    steps, starts = map(device.put, element.steps)
    for first in range(0, len(wanted), batch):
        places = columns[first : first + batch]
        chosen = wanted[places]
        near = voxels.around(chosen, (0, 0, hz))
        near = near[among(planes, near)]
        n, depth = len(chosen), element.reach[2] + 1
        beside = _find(device, codes, near, (hx, hy, 0))
        sections = device.empty(TILE**2 * depth * len(near), np.uint16)
        kernel(SOURCE, "dilate_planes", CODE="ulong")(
            TILE * len(near), rows, beside, element.halo, starts, steps, element.reach, sections
        )
        above = _find(device, near, chosen, (0, 0, hz))
        found = device.empty(BRICKS * n, BRICK)
        kernel(SOURCE, "unite_planes", CODE="ulong")(
            4 * n, sections, above, hz, element.reach[2], bricks=found
        )
        bricks[places] = found.take().reshape(n, BRICKS)
    return Tiling(voxels.corner, wanted, bricks, voxels.full).normal()


def _find(device: Device, codes: np.ndarray, around: np.ndarray, halo: tuple[int, ...]) -> Array:
    """Return the index among ascending codes of each tile up to `halo` tiles from others."""
    found = device.empty(len(around) * math.prod(2 * n + 1 for n in halo), np.uint32)
    device.kernel(SOURCE, "find_beside", CODE="ulong")(
        found.size, device.put(codes), len(codes), device.put(around), halo, found
    )
    return found


def erode(device: Device, voxels: Tiling, element: Element, batch: int, box: Box) -> Tiling:
    """Return a set of voxels eroded by an element, as `dilate` dilates it."""
    return dilate(device, voxels.complement(), element, batch, box).complement()


@dataclass(frozen=True)
class MorphPlan(Plan):
    """The decisions of a morphological operation."""

    facts = (
        "operation",
        "radius",
        "world",
        "shape",
        "reach: element.reach",
        "grid: grid.shape",
        "low",
    )
    predicted = ("tiles",)
    refusal = (
        "to {plan.operation} by {plan.radius:g} {shortage}: choose a smaller radius, make it "
        "coarser by --resample, or allow more (see --max-memory)"
    )

    operation: str
    radius: float
    world: bool  # whether the radius is in world units
    shape: str
    element: Element
    grid: Grid  # of the result
    low: tuple[int, int, int]  # where it begins, counted from the octree's grid
    tiles: int  # that hold the boundary
    batch: int  # tiles that are dilated at once

    @property
    def stages(self) -> list[str]:
        first = {"dilate": "dilate", "close": "dilate"}.get(self.operation, "erode")
        second = "erode" if first == "dilate" else "dilate"
        return [*(first, second)[: self.passes], "build"]

    @property
    def passes(self) -> int:
        """Dilations and erosions, one after the other."""
        return 2 if self.operation in ("open", "close") else 1

    @property
    def box(self) -> Box:
        """The cube around the grid of the result, of whole tiles."""
        low = np.array(self.low)
        return Box(low, low + max(self.grid.side, TILE))

    @property
    def reasons(self) -> dict[str, str]:
        before = "the result does not reach them" if self.low == (0, 0, 0) else ""
        return {
            "nodes away from the boundary": "they stay leaves",
            "voxels before the grid": before,
        }

    @property
    def cost(self) -> Cost:
        """The predicted bytes: the host holds the boundary's tiles a few times, and the bricks of
        the tiles that they reach."""
        reached = self.tiles * (1 + 2 * max(self.element.halo))
        batch = min(self.batch, max(reached, 1)) * self.element.scratch
        held = self.tiles * TILE_BYTES
        host = COPIES * held + reached * BRICK_BYTES * BRICKS
        return Cost(device=held + batch, host=host, largest=max(held // 2, batch))

    def rows(self) -> list[tuple[str, str]]:
        unit = "in world units" if self.world else "voxels"
        shape = " x ".join(map(str, self.grid.shape))
        return [
            ("operation", f"{self.operation} by a {self.shape} of radius {self.radius:g} {unit}"),
            ("tiles", f"{self.tiles:,} of {TILE} x {TILE} x {TILE} voxels hold the boundary"),
            ("grid", f"{shape} voxels, from voxel {', '.join(map(str, self.low))} on"),
        ]


def plan_morph(
    octree: Octree,
    operation: str,
    radius: float,
    *,
    world: bool = False,
    shape: str = ELEMENTS[0],
    device: Device | None = None,
    max_memory: int | None = None,
) -> MorphJob:
    """Return the planned job of `morph`; see `voxtool.morph`."""
    if operation not in MORPHOLOGY:
        raise VoxtoolError(
            f"operation {operation!r} is unknown: choose one of {', '.join(MORPHOLOGY)}"
        )
    element = element_of(octree, radius, world, shape)
    voxels = Tiling.of(octree, max(element.reach))
    plan = plan_of(octree, operation, radius, world, shape, len(voxels.boundary()), max_memory)
    return MorphJob(octree, voxels, plan, device or default_device(), max_memory)


def element_of(octree: OctreeContent, radius: float, world: bool, shape: str) -> Element:
    """Return the structuring element of a request; VoxtoolError if it reaches no other voxel."""
    pitch = octree.grid.pitch
    element = Element.of(shape, float(radius), pitch if world else (1.0, 1.0, 1.0))
    if not any(element.reach):
        sizes = " x ".join(dict.fromkeys(f"{size:.4g}" for size in pitch))
        least = f"{at_least(min(pitch))} or more" if world else "1 or more, in voxels"
        raise VoxtoolError(
            f"radius {radius:g} is less than one voxel, of {sizes}{octree.units and ' '}"
            f"{octree.units}: give {least}, or voxelize with a larger dim"
        )
    return element


def plan_of(
    octree: OctreeContent,
    operation: str,
    radius: float,
    world: bool,
    shape: str,
    tiles: int,
    max_memory: int | None,
) -> MorphPlan:
    """Return the plan of an operation on an octree, given the number of tiles of its boundary."""
    element = element_of(octree, radius, world, shape)
    low = high = np.zeros(3, np.int64)
    bounds = octree.bounds() if operation == "dilate" else None
    if bounds is not None:
        low = np.minimum(bounds[0] - element.reach, 0) // TILE * TILE
        high = np.maximum(bounds[1] + element.reach - octree.grid.shape, 0)
    grid = octree.grid.window(low.tolist(), (octree.grid.shape + high - low).tolist())
    x, y, z = low.tolist()
    batch = batch_of(element, tiles, max_memory)
    return MorphPlan(operation, float(radius), world, shape, element, grid, (x, y, z), tiles, batch)


def batch_of(element: Element, tiles: int, max_memory: int | None) -> int:
    """Return the number of an octree's tiles that are dilated at once."""
    room = SCRATCH if max_memory is None else min(SCRATCH, max_memory - tiles * TILE_BYTES)
    return max(room // element.scratch, 1)


class MorphJob(Job[Octree]):
    """A planned morphological operation.

    Attributes
    ----------
    octree : Octree
        The voxels that are changed.
    plan : MorphPlan
        The decisions; what lies beyond its grid is not made.
    """

    plan: MorphPlan
    device: Device

    def __init__(
        self,
        octree: Octree,
        voxels: Tiling,
        plan: MorphPlan,
        device: Device,
        max_memory: int | None,
    ) -> None:
        self.octree, self._voxels = octree, voxels
        self.plan, self.device, self.max_memory = plan, device, max_memory

    def _run(self) -> Octree:
        plan, voxels = self.plan, self._voxels
        for number, stage in enumerate(plan.stages[:-1], 1):
            with self.device.stage(stage):
                change = dilate if stage == "dilate" else erode
                box = plan.box.grown(plan.element.reach, plan.passes - number)
                voxels = change(self.device, voxels, plan.element, plan.batch, box)
        with self.device.stage("build"):
            if plan.operation == "shell":
                voxels = self._voxels.intersection(voxels.complement())
            octree, low = self.octree, np.array(plan.low)
            result = voxels.octree(plan.grid, low, octree.units, octree.transform)
        return with_attributes(result, octree, -low, self.device)

    def findings(self, result: Octree) -> Iterator[str]:
        """Yield why the result is empty."""
        return why_empty(self.plan, self.octree.count, result.count)

    def notes(self, result: Octree) -> Iterator[str]:
        """Yield which attributes are not kept."""
        return lost([self.octree], result.attributes)


def why_empty(plan: MorphPlan, before: int, after: int) -> Iterator[str]:
    """Yield why a result is empty, given the numbers of set voxels."""
    if not before:
        yield "no voxel is set, so none is changed: see `voxtool svo-info`"
    elif not after:
        yield (
            f"no voxel is left: every one lies within {plan.radius:g} of the outside: "
            "choose a smaller radius"
        )
