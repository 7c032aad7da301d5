"""What a field says at points, on the device: section 3.5 of the text.

To find the deepest cell that has a block, each of the three searches of the text asks the hash for
cells of one level after another; all find the same. Levels whose cells all have blocks are passed
over. Answers are those of DistanceField.query, bit for bit.

Points are taken block by block: while the device searches for one, the host rounds the next to the
lattice of 2**-32 sides.

Kernels: kernels/adf/query.cl.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.field import (
    POINT_BITS,
    Answer,
    DistanceField,
    bound_values,
    checked_points,
    half_diagonals,
    no_bounds,
)
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device, default_device, program

if TYPE_CHECKING:
    from collections.abc import Iterator

SOURCE = "adf/query.cl"
BLOCK = 1 << 18  # points that are on the device at once
CHUNK = 1 << 12  # points that are rounded at once: what fits the host's cache
ALIGNMENT = 128  # bytes, of memory that a CPU's driver shares


@dataclass(frozen=True)
class Shape:
    """How points are dealt out: as the options of query.cl, and the work-items of a work-group."""

    lanes: int
    batch: int
    run: int
    group: int

    def padded(self, n: int) -> int:
        """The points of as many whole work-groups as n points take."""
        whole = self.batch * self.run * self.group
        return -(-n // whole) * whole


CPU = Shape(lanes=16, batch=64, run=16, group=4)
GPU = Shape(lanes=1, batch=1, run=1, group=64)
GPU_COHERENT = Shape(lanes=1, batch=1, run=16, group=64)

HEADERS = {
    "adf/query.h": program.c_constants(
        **{search.upper(): number for number, search in enumerate(SEARCHES)}
    )
}


def query_adf(
    field: DistanceField,
    points: Any,
    *,
    search: str = "binary",
    gradient: bool = False,
    bounds: bool = False,
    cell: bool = False,
    device: Device | None = None,
) -> Answer:
    """What a field says at points; as FieldQuery, for a single use."""
    query = FieldQuery(field, device)
    return query(points, search=search, gradient=gradient, bounds=bounds, cell=cell)


class FieldQuery:
    """A field on a device, uploaded once and asked many times.

    textures, options : what kernels that look for cells take: arguments, and -D options; see
        kernels/adf/search.h.
    """

    def __init__(self, field: DistanceField, device: Device | None = None) -> None:
        """Upload the field's textures; its bounds when they are first asked for.

        Raises
        ------
        DeviceError : there is no device.
        MemoryLimitError : the field does not fit on it.
        """
        self.field = field
        self.device = device or default_device()
        table, (full, deepest) = field.hash, levels_to_search(field)
        self.textures = (
            self._upload(field.voxels),
            self._upload(field.cells),
            self._upload(table.offsets),
            self.device.put(inverses(max(table.m, table.r))),
            np.uint32(table.m),
            np.uint32(table.r),
            np.int32(full),
            np.int32(deepest),
        )
        self.options: dict[str, int | str] = {
            "OFFSET": {1: "uchar", 2: "ushort"}[table.offsets.dtype.itemsize],
            **({"W": 1} if table.has_w else {}),
            **({"WIDE": 1} if field.cells.shape[-1] == 3 else {}),
        }

    def __call__(
        self,
        points: Any,
        *,
        search: str = "binary",
        gradient: bool = False,
        bounds: bool = False,
        cell: bool = False,
    ) -> Answer:
        """What the field says at points; outside of the cube as DistanceField.query says.

        Parameters
        ----------
        points : (N, 3) numbers, world units, in any order.
        search : "linear", from the coarsest level that has leaves down; "binary", between that and
            the deepest; or "coherent", from the level of the point before, for points in an order
            in which neighbours are near, as along rays.
        gradient, bounds, cell : what is asked for beside the distance.

        Raises
        ------
        VoxtoolError : a wrong shape, an unknown search, or bounds of a field without them.
        MemoryLimitError : the device has no memory for a block of points.
        """
        points = checked_points(points)
        if search not in SEARCHES:
            raise VoxtoolError(f"search {search!r} is unknown: choose {', '.join(SEARCHES)}")
        if bounds and self.field.bounds is None:
            raise no_bounds()
        n, side = len(points), self.field.side
        answer = Answer(
            np.empty(n),
            np.empty((n, 3), np.float32) if gradient else None,
            np.empty(n) if bounds else None,
            np.empty(n, np.uint8) if cell else None,
            np.empty((n, 3), np.uint32) if cell else None,
            np.zeros(n, bool),
        )
        world_bounds = bound_values() * side
        asked = _Asked(search, gradient, bounds, cell)
        with self.device.stage("query"):
            for block, fixed, found in self._blocks(points, answer.outside, asked):
                part = _part(answer, block)
                np.multiply(found.distance, side, out=part.distance, dtype=np.float64)
                if part.gradient is not None:
                    part.gradient[:] = found.gradient
                if part.bound is not None:
                    np.take(world_bounds, found.code, out=part.bound, mode="clip")
                if part.level is not None and part.cell is not None:
                    part.level[:], part.cell[:] = found.level, found.cell
                if part.outside.any():
                    self._extend(points[block], fixed, part)
        return answer

    def _blocks(
        self, points: np.ndarray, outside: np.ndarray, asked: _Asked
    ) -> Iterator[tuple[slice, np.ndarray, _Found]]:
        """Each block of points, rounded, and what was found there. Fills `outside`.

        While the host rounds a block and takes in the answers of another, the device is searching.
        """
        lattice = _Lattice(self.field)
        shape = self._shape(asked.search)
        memory = [_point_memory(shape.padded(min(BLOCK, len(points)))) for _ in range(2)]
        running: tuple[slice, np.ndarray, _Running] | None = None
        for start in range(0, len(points), BLOCK):
            block = slice(start, min(start + BLOCK, len(points)))
            n, fixed = block.stop - start, memory[start // BLOCK % 2]
            lattice.round(points[block], fixed[:n], outside[block])
            done = running and (*running[:2], running[2].finish())
            running = block, fixed[:n], self._start(fixed, n, asked)
            if done:
                yield done
        if running:
            yield *running[:2], running[2].finish()

    def _start(self, fixed: np.ndarray, n: int, asked: _Asked) -> _Running:
        """Let the device search for the first n of these points, which pads them."""
        device, shape = self.device, self._shape(asked.search)
        padded = shape.padded(n)
        fixed[n:padded] = 0
        points = device.view(fixed[:padded])
        found = {"distance": device.empty(padded, np.float32)}
        args = [found["distance"]]
        if asked.gradient:
            found["gradient"] = device.empty(3 * padded, np.float32)
            args.append(found["gradient"])
        if asked.bounds:
            found["code"] = device.empty(padded, np.uint8)
            args += [self._bounds, found["code"]]
        if asked.cell:
            found["level"] = device.empty(padded, np.uint8)
            found["cell"] = device.empty(3 * padded, np.uint32)
            args += [found["level"], found["cell"]]
        kernel = device.kernel(
            SOURCE,
            "query",
            SEARCH=asked.search.upper(),
            LANES=shape.lanes,
            BATCH=shape.batch,
            RUN=shape.run,
            **self.options,
            **asked.options(),
        )
        items = padded // (shape.batch * shape.run)
        kernel(items, points, *self.textures, *args, local=shape.group)
        device.queue.flush()  # or a driver may wait until the host does
        return _Running(n, points, found)

    def _extend(self, points: np.ndarray, fixed: np.ndarray, answer: Answer) -> None:
        """Give those points of a block that are outside of the cube their answers."""
        field, which = self.field, np.flatnonzero(answer.outside)
        has_bounds = field.bounds is not None
        asked = _Asked("binary", gradient=True, bounds=has_bounds, cell=not has_bounds)
        points, n = points[which], len(which)
        memory = _point_memory(self._shape("binary").padded(n))
        memory[:n] = fixed[which]
        found = self._start(memory, n, asked).finish()
        bound = (
            bound_values()[found.code]
            if has_bounds
            else half_diagonals(found.level.astype(np.int64))
        )
        world, slope = np.empty(n), found.gradient
        field.extend(points, np.ones(n, bool), found.distance, world, slope, bound)
        lost = np.isnan(points).any(axis=1)
        world[lost], slope[lost] = np.nan, np.nan
        answer.distance[which] = world
        if answer.gradient is not None:
            answer.gradient[which] = slope
        if answer.bound is not None:
            answer.bound[which] = np.inf
        answer.outside[which[lost]] = False

    def _upload(self, texture: np.ndarray) -> Array:
        """A texture on the device; of a CPU in memory of large pages, where the system has them:
        random reads miss the page table less."""
        with self.device.stage("upload"):
            array = self.device.empty(texture.size, texture.dtype)
            self.device.write(array, texture)
        return array

    def _shape(self, search: str) -> Shape:
        if self.device.info.kind == "CPU":
            return CPU
        return GPU_COHERENT if search == "coherent" else GPU

    @cached_property
    def _bounds(self) -> Array:
        assert self.field.bounds is not None
        return self._upload(self.field.bounds)


def levels_to_search(field: DistanceField) -> tuple[int, int]:
    """The level down to which all cells have blocks, and the deepest of a block."""
    deepest, full = field.depth - 1, 0
    identifiers = field.identifiers
    while full < deepest:
        level = 3 * (full + 1)  # bits of its Morton codes
        there = (identifiers >= 1 << level) & (identifiers < 2 << level)
        if np.count_nonzero(there) < 1 << level:
            break
        full += 1
    return full, deepest


def inverses(most: int) -> np.ndarray:
    """(most + 1,) float32: the inverse of each number, rounded to nearest; 0 for 0."""
    numbers = np.arange(1, most + 1, dtype=np.float32)
    return np.concatenate([np.zeros(1, np.float32), 1 / numbers])


# --- blocks of points ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Asked:
    """How to search, and for what."""

    search: str
    gradient: bool
    bounds: bool
    cell: bool

    def options(self) -> dict[str, int]:
        asked = {"GRADIENT": self.gradient, "BOUNDS": self.bounds, "CELL": self.cell}
        return {name: 1 for name, wanted in asked.items() if wanted}


@dataclass(frozen=True)
class _Found:
    """What the kernel found at n points; only distances unless more was asked for.

    distance, gradient : (n,) and (n, 3) float32, sides; code : (n,) uint8, of the leaf's bound;
    level, cell : (n,) uint8 and (n, 3) uint32, the leaf.
    """

    distance: np.ndarray
    gradient: np.ndarray
    code: np.ndarray
    level: np.ndarray
    cell: np.ndarray


@dataclass(frozen=True)
class _Running:
    """A search for n points that was begun, and where it writes."""

    n: int
    points: Array
    found: dict[str, Array]

    def finish(self) -> _Found:
        """Wait for the device."""
        taken = {name: array.take() for name, array in self.found.items()}
        self.points.release()
        none = np.empty(0)
        return _Found(
            taken["distance"][: self.n],
            taken.get("gradient", none).reshape(-1, 3)[: self.n],
            taken.get("code", none)[: self.n],
            taken.get("level", none)[: self.n],
            taken.get("cell", none).reshape(-1, 3)[: self.n],
        )


class _Lattice:
    """Rounds points to 32-bit fixed point, as DistanceField.fixed."""

    def __init__(self, field: DistanceField) -> None:
        self.side = field.side
        self.origins = np.tile(np.array(field.origin), CHUNK)
        self.scratch = np.empty(3 * CHUNK)

    def round(self, points: np.ndarray, fixed: np.ndarray, outside: np.ndarray) -> None:
        """(n, 3) float64 world points to (n, 3) uint32, in `fixed`; sets `outside` where one is
        not in the cube, and leaves it elsewhere."""
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(0, len(points), CHUNK):
                chunk = slice(start, start + CHUNK)
                self._round(points[chunk].reshape(-1), fixed[chunk].reshape(-1), outside[chunk])

    def _round(self, points: np.ndarray, fixed: np.ndarray, outside: np.ndarray) -> None:
        u = self.scratch[: len(points)]
        np.subtract(points, self.origins[: len(points)], out=u)
        np.divide(u, self.side, out=u)
        if not (u.min() >= 0 and u.max() < 1):  # or NaN
            inside = (u >= 0) & (u <= 1)
            np.logical_not(inside[::3] & inside[1::3] & inside[2::3], out=outside)
            np.fmax(u, 0, out=u)  # 0 for NaN
            np.fmin(u, 1 - 2.0**-POINT_BITS, out=u)
        np.multiply(u, 2.0**POINT_BITS, out=u)
        np.copyto(fixed, u, casting="unsafe")


def _point_memory(n: int) -> np.ndarray:
    """(n, 3) uint32, undefined, and where a CPU's driver can share it."""
    memory = np.empty(12 * n + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + 12 * n].view(np.uint32).reshape(n, 3)


def _part(answer: Answer, block: slice) -> Answer:
    """The answers of a block of the points: views."""

    def part(array: np.ndarray | None) -> Any:
        return None if array is None else array[block]

    return Answer(*(part(getattr(answer, field.name)) for field in fields(answer)))
