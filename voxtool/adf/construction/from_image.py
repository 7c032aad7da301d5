"""The field of an image of distances: its trilinear interpolation, sampled adaptively.

The cube's lattice is that of the samples. At the level `natural` a cell is as large as the least
spacing; if the others are multiples of it, samples are vertices of cells and the field of that
level is the image's own interpolation. Beyond its first and last samples along an axis, the image
is continued by the nearest ones.

The error of a cell: the image's interpolation is trilinear between the planes of its samples, and
so is the cell's. Their difference is trilinear in each of the boxes into which those planes divide
the cell, and its largest magnitude is at a corner of one: these are examined. A bound adds what
rounding does to an answer in single precision.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from voxtool.adf.construction.plan import BLOCK_BYTES
from voxtool.adf.field.cells import JUMP, NO_LEAF, bound_values, cell_of, identifier_type, key_of
from voxtool.adf.field.field import FAR, DistanceField, assemble
from voxtool.adf.field.hashing import build_hash
from voxtool.adf.field.host_query import POINT_BITS, WEIGHT_BITS
from voxtool.adf.field.packing import most_blocks
from voxtool.choices import DEFAULT_TEXTURE_3D, DEFAULT_TOLERANCE, GIVEN, MAX_LEVEL
from voxtool.errors import MemoryLimitError, VoxtoolError, count_of, human
from voxtool.grid import Grid
from voxtool.memory import available_memory
from voxtool.morton import morton_encode
from voxtool.opencl import Device, default_device

VERTICES = np.arange(3)  # of a block along an axis
OCTANTS = np.indices((2, 2, 2)).reshape(3, 8).T[:, ::-1]  # x, y, z of the children, x fastest
BEYOND = 2  # levels below the natural one, where samples are no vertices
AT_ONCE = 1 << 21  # values that are compared at once
WORK_BYTES = 64 * AT_ONCE
CELLS_AT_ONCE = 1 << 15
FEW = 5  # points along an axis that are examined first
LEAST = 2.0**-50  # sides: nearer values are 0, or its negative, so that no product is denormal
# Error of an answer in single precision, relative to the largest corner: three interpolations round
# five times each, by 2**-24.
ROUNDING = 2.0**-20
ROUNDED = 2.0**-22  # relative: errors up to this are those of rounding distances
NUDGE = 2.0**-44  # of the cube's corner, relative to it or to the side
MISPLACED = 2.0**-43  # of a point, in sides: by that and by rounding


class Cells(NamedTuple):
    """Cells of a level."""

    level: int
    ijk: np.ndarray  # (n, 3) int64
    corners: np.ndarray  # (n, 2, 2, 2) float64: the distances there, [x, y, z], in sides

    def chosen(self, which: Any) -> Cells:
        return Cells(self.level, self.ijk[which], self.corners[which])


@dataclass(frozen=True)
class ImageCube:
    """The cube of an image's field.

    Attributes
    ----------
    grid : Grid
        The image's grid; its samples are at the centres of the voxels.
    """

    grid: Grid

    @cached_property
    def spacing(self) -> float:
        """The least spacing along an axis with two samples or more, world units."""
        return min(p for p, n in zip(self.grid.pitch, self.grid.shape, strict=True) if n > 1)

    @cached_property
    def natural(self) -> int:
        """The level of cells as large as the least spacing."""
        extent = max((n - 1) * p for p, n in zip(self.grid.pitch, self.grid.shape, strict=True))
        least = extent * (1 + 2.0**-20)  # so that no sample is on the far side
        level = 1
        while math.ldexp(self.spacing, level) < least:
            level += 1
        return level

    @property
    def side(self) -> float:
        """The side of the cube, world units."""
        return math.ldexp(self.spacing, self.natural)

    @cached_property
    def scale(self) -> np.ndarray:
        """Samples along each axis for a cell of the natural level, (3,): at most 1."""
        return self.spacing / np.array(self.grid.pitch)

    @cached_property
    def shift(self) -> np.ndarray:
        """Samples of each axis between the cube's low corner and the first one, (3,) whole."""
        room = np.ldexp(self.scale, self.natural) - (np.array(self.grid.shape) - 1)
        return np.maximum(np.floor(room / 2), 0)

    @property
    def origin(self) -> tuple[float, float, float]:
        """The low corner of the cube, world units."""
        corner = np.array(self.grid.origin) + np.array(self.grid.pitch) * (0.5 - self.shift)
        # so far below the first sample that rounding leaves it within
        x, y, z = (corner - NUDGE * np.maximum(np.abs(corner), self.side)).tolist()
        return x, y, z

    @property
    def default_level(self) -> int:
        """The natural level where samples are vertices of its cells; otherwise some below it."""
        whole = (1 / self.scale == np.round(1 / self.scale)).all()
        return min(self.natural + (0 if whole else BEYOND), MAX_LEVEL)

    def edge(self, level: int) -> np.ndarray:
        """Return the edges of a cell of a level, (3,), in samples."""
        return np.ldexp(self.scale, self.natural - level)

    def places(self, level: int, vertices: np.ndarray) -> np.ndarray:
        """Return the places of (n, 3) vertices of the cells of a level, in samples."""
        return vertices * self.edge(level) - self.shift


def field_of_image(
    values: np.ndarray,
    grid: Grid,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    max_level: int | None = None,
    max_texture: int = DEFAULT_TEXTURE_3D,
    units: str = "",
    source_sha256: str = "",
    device: Device | None = None,
    max_memory: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> DistanceField:
    """Return the field of an image of distances.

    Parameters
    ----------
    values : (nx, ny, nz) float
        The distances at the centres of the voxels, world units, negative inside.
    grid : Grid
        The grid of the voxels.
    tolerance : float
        Difference of a cell from the image's trilinear interpolation, in sides of the cube, at
        which it is no longer refined.
    max_level : int, optional
        Level at which leaves are no longer refined; by default that of the samples, and two more
        where these are no vertices of cells.
    max_texture, units, source_sha256
        As in DistanceField and voxtool.build_adf.
    device, max_memory
        As in voxtool.build_adf.
    progress : callable
        Called with the share of the levels that are done.

    Returns
    -------
    DistanceField
        Its sign is "given", or "none" if no value is negative. It is not continuous: neighbours of
        different levels may differ by the tolerance.

    Raises
    ------
    VoxtoolError
        If a value is no distance in a cube, or a number is out of range.
    MemoryLimitError
        If the field does not fit.
    """
    cube = ImageCube(grid)
    check_request(tolerance, max_level)
    build = _Build(values, cube, tolerance, max_level or cube.default_level)
    build.run(max_memory, most_blocks(max_texture), progress)
    return build.field(device or default_device(), units=units, source_sha256=source_sha256)


def check_request(tolerance: float, max_level: int | None) -> None:
    """Raise VoxtoolError if a number is out of range."""
    if not 0 <= tolerance <= FAR:
        raise VoxtoolError(f"tolerance {tolerance:g}: give 0 to {FAR:g} sides of the cube")
    if max_level is not None and not 1 <= max_level <= MAX_LEVEL:
        raise VoxtoolError(f"max level {max_level}: choose 1 to {MAX_LEVEL}")


class _Build:
    """A field under construction: the blocks of the levels built so far."""

    def __init__(
        self, values: np.ndarray, cube: ImageCube, tolerance: float, max_level: int
    ) -> None:
        self.values, self.cube = values, cube
        self.tolerance, self.max_level = tolerance, max_level
        low, high = float(values.min()), float(values.max())
        if not max(-low, high) <= FAR * cube.side:  # or NaN
            raise VoxtoolError(
                f"values from {low:g} to {high:g}: distances are finite, and here at most "
                f"{FAR * cube.side:g}"
            )
        self.signed = low < 0
        far = max(map(abs, cube.origin)) / cube.side
        self.misplaced = MISPLACED * (1 + far) * _slope_of(values, cube.grid)
        self.identifiers: list[np.ndarray] = []
        self.voxels: list[np.ndarray] = []
        self.codes: list[np.ndarray] = []
        self.steepest, self.missed = 0.0, 0
        self.worst = (0.0, 0, np.zeros(3, np.int64))  # error, level, cell

    def run(self, max_memory: int | None, room: int, progress: Callable[[float], None]) -> None:
        """Build the levels, from the root on, as long as cells are refined."""
        cells, level = np.zeros((1, 3), np.int64), 0
        while len(cells):
            self._refuse(len(cells), level, max_memory, room)
            self.identifiers.append(morton_encode(cells) | np.uint64(1 << 3 * level))
            refined = []
            for first in range(0, len(cells), CELLS_AT_ONCE):
                some = cells[first : first + CELLS_AT_ONCE]
                voxels = self._sampled(level, some)
                children = _children(level, some, voxels)
                own, codes = self._examined(children)
                self.voxels.append(voxels.transpose(0, 3, 2, 1).astype(np.float32))
                self.codes.append(codes)
                refined.append(children.ijk[own])
            cells, level = np.concatenate(refined), level + 1
            progress(level / self.max_level)

    def _refuse(self, count: int, level: int, max_memory: int | None, room: int) -> None:
        """Raise MemoryLimitError if the blocks of a level do not fit beside the others."""
        blocks = count + sum(map(len, self.identifiers))
        needed = 3 * BLOCK_BYTES * blocks + WORK_BYTES
        most = available_memory() if max_memory is None else max_memory
        fits = f"--max-level {level} fits, or " if level else ""
        if blocks > room or needed > most:
            held = f"textures of {room:,}" if blocks > room else f"{human(most)} of memory"
            raise MemoryLimitError(
                f"{count_of(blocks, 'block')} down to level {level} would need {human(needed)}, "
                f"beyond {held}: {fits}choose a larger --tolerance"
            )

    def _sampled(self, level: int, cells: np.ndarray) -> np.ndarray:
        """Return the distances at the vertices of the children of cells, (n, 3, 3, 3) float64
        rounded to float32, [x, y, z], in sides."""
        first = self.cube.places(level + 1, 2 * cells)
        steps = VERTICES * self.cube.edge(level + 1)[:, None]
        found = interpolated(self.values, [first[:, [a]] + steps[a] for a in range(3)])
        found = (found / self.cube.side).astype(np.float32).astype(np.float64)
        return np.where(abs(found) < LEAST, np.where(found < 0, -LEAST, 0.0), found)

    def _examined(self, cells: Cells) -> tuple[np.ndarray, np.ndarray]:
        """Return which cells are refined, (n,) bool, and the codes of the bounds of the others,
        (n,) uint8, 0 for those; counts the leaves that miss the tolerance."""
        largest = abs(cells.corners).max(axis=(1, 2, 3))
        limit, refines = self.tolerance + ROUNDED * largest, cells.level < self.max_level
        refined = np.zeros(len(largest), bool)
        if refines and self.cube.edge(cells.level).max() > FEW:  # few points tell most of them
            refined = self._errors(cells, FEW) > limit
        errors = np.zeros(len(largest))
        errors[~refined] = self._errors(cells.chosen(~refined))
        over = errors > limit
        if refines:
            refined |= over
        elif over.any():
            worst = int(np.argmax(np.where(over, errors, 0)))
            self.missed += int(np.count_nonzero(over))
            self.worst = max(
                self.worst, (float(errors[worst]), cells.level, cells.ijk[worst]),
                key=lambda found: found[0],
            )  # fmt: skip
        steps = [abs(np.diff(cells.corners, axis=axis)).max(axis=(1, 2, 3)) for axis in (1, 2, 3)]
        slopes = np.ldexp(np.sqrt(sum(step * step for step in steps)), cells.level)
        self.steepest = max(self.steepest, float(slopes[~refined].max(initial=0)))
        shares = 2.0**-WEIGHT_BITS + 2.0 ** (cells.level - POINT_BITS)  # a point's own rounding
        rounding = ROUNDING * largest + shares * sum(steps) + self.misplaced + 2 * LEAST
        codes = np.searchsorted(bound_values()[:JUMP], errors + rounding)
        return refined, np.where(refined, NO_LEAF, np.maximum(codes, 1)).astype(np.uint8)

    def _errors(self, cells: Cells, few: int | None = None) -> np.ndarray:
        """Return the largest difference of cells from the image's interpolation, (n,), in sides;
        `few` limits the points that are examined along each axis to about that number."""
        edge = self.cube.edge(cells.level)
        low = self.cube.places(cells.level, cells.ijk)
        at = [_planes(low[:, a], edge[a], self.values.shape[a]) for a in range(3)]
        if few:
            at = [p[:, :: max(p.shape[1] // few, 1)] for p in at]
        x, y, z = (places.shape[1] for places in at)
        count, layers = max(AT_ONCE // (x * y * z), 1), max(AT_ONCE // (y * z), 1)
        errors = np.zeros(len(low))
        for first in range(0, len(low), count):
            some = slice(first, first + count)
            for layer in range(0, x, layers):
                places = [at[0][some, layer : layer + layers], at[1][some], at[2][some]]
                weights = [(places[a] - low[some, a, None]) / edge[a] for a in range(3)]
                image = interpolated(self.values, places) / self.cube.side
                apart = abs(_trilinear(cells.corners[some], weights) - image)
                errors[some] = np.maximum(errors[some], apart.max(axis=(1, 2, 3)))
        return errors

    def field(self, device: Device, **head: Any) -> DistanceField:
        """Return the field that consists of the blocks."""
        cube, every = self.cube, np.concatenate(self.identifiers)
        levels, ijk = cell_of(every)
        keys = key_of(levels, ijk)
        table = build_hash(keys, device)
        reached: dict[str, Any] = {
            "leaves": 7 * len(every) + 1, "missed": self.missed, "jumps": 0,
        }  # fmt: skip
        if self.missed:
            error, level, cell = self.worst
            where = np.array(cube.origin) + cube.side * np.ldexp(cell + 0.5, -level)
            reached["worst"] = {"error": error, "level": level, "where": where.tolist()}
        return assemble(
            every.astype(identifier_type(int(levels[-1]))), keys, np.concatenate(self.voxels),
            np.concatenate(self.codes).reshape(-1, 2, 2, 2), table,
            origin=cube.origin, side=cube.side, sign=GIVEN if self.signed else "none",
            tolerance=float(self.tolerance), max_level=self.max_level, band=math.inf,
            continuous=False, lipschitz=self.steepest, reached=reached,
            plan={"samples": list(cube.grid.shape), "spacing": list(cube.grid.pitch)}, **head,
        )  # fmt: skip


def interpolated(values: np.ndarray, places: Sequence[np.ndarray]) -> np.ndarray:
    """Return the trilinear interpolation of an image; beyond its samples the nearest ones.

    Parameters
    ----------
    values : (nx, ny, nz) array
        The samples.
    places : three (n, m) arrays of float
        Of n boxes, the places along x, y and z, in samples.

    Returns
    -------
    (n, mx, my, mz) float64
    """
    inside = [p.clip(0, n - 1) for p, n in zip(places, values.shape, strict=True)]
    first = [p.astype(np.intp) for p in inside]

    def along(axis: int, chosen: list[np.ndarray]) -> np.ndarray:
        if axis == 3:
            x, y, z = chosen
            found = values[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
            return found.astype(np.float64)
        one = along(axis + 1, [*chosen, first[axis]])
        weight = inside[axis] - first[axis]
        if not weight.any():
            return one
        last = np.minimum(first[axis] + 1, values.shape[axis] - 1)
        shape = [len(weight), *(-1 if other == axis else 1 for other in range(3))]
        return one + weight.reshape(shape) * (along(axis + 1, [*chosen, last]) - one)

    return along(0, [])


def _trilinear(corners: np.ndarray, weights: Sequence[np.ndarray]) -> np.ndarray:
    """Return (n, mx, my, mz) values of cells: (n, 2, 2, 2) corners, and the (n, m) weights along
    each axis."""
    found = corners
    for axis, weight in enumerate(weights):
        low, high = (found.take([n], axis + 1) for n in (0, 1))
        shape = [len(weight), *(-1 if other == axis else 1 for other in range(3))]
        found = low + weight.reshape(shape) * (high - low)
    return found


def _planes(low: np.ndarray, edge: float, count: int) -> np.ndarray:
    """Return the places along an axis, in samples, between which the image and a cell are both
    linear, (n, m): the (n,) low ends of the cells, the planes of samples within, the high ends."""
    if edge == int(edge) and edge <= count:  # all ends are planes
        return low[:, None] + np.arange(int(edge) + 1)
    steps = np.arange(min(math.ceil(edge) + 1, count))
    within = np.maximum(np.ceil(low), 0)[:, None] + steps
    ends = low[:, None], low[:, None] + edge
    return np.concatenate([ends[0], np.clip(within, *ends), ends[1]], axis=1)


def _children(level: int, cells: np.ndarray, voxels: np.ndarray) -> Cells:
    """Return the children of cells, of each in the order of the Morton curve; `voxels` are the
    distances at their vertices."""
    corners = [voxels[:, x : x + 2, y : y + 2, z : z + 2] for x, y, z in OCTANTS.tolist()]
    ijk = (2 * cells[:, None] + OCTANTS).reshape(-1, 3)
    return Cells(level + 1, ijk, np.stack(corners, axis=1).reshape(-1, 2, 2, 2))


def _slope_of(values: np.ndarray, grid: Grid) -> float:
    """Return a bound of the slope of an image's interpolation."""
    found = 0.0
    for axis, pitch in enumerate(grid.pitch):
        planes = np.moveaxis(values, axis, 0)
        steps = (
            float(abs(np.subtract(b, a, dtype=np.float64)).max())
            for a, b in itertools.pairwise(planes)
        )
        found += max(steps, default=0.0) / pitch
    return found
