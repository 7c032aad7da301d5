"""Queries of a distance field at points, on the device [ADF, section 3.5].

Each of three searches finds the deepest cell that has a block, by looking up cells of one level
after another in the hash; all return the same values, which are those of DistanceField.query, bit
for bit. Levels whose cells all have blocks are skipped.

Points are processed in blocks: while the device searches one, the host rounds the next to the
lattice of 2**-32 sides. A few points are looked up on the host, which takes less time than a
launch.

Kernels: kernels/adf/query.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.bounds import bound_values, half_diagonals
from voxtool.adf.host_query import POINT_BITS, QueryResult, checked_points, extend, no_bounds
from voxtool.adf.textures import bounds_of, textures_of
from voxtool.choices import SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device, default_device, program

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.adf.field import DistanceField

SOURCE = "adf/query.cl"
HOST_POINTS = 128  # up to which the host is faster than a launch
BLOCK = 1 << 18  # points that are on the device at once
CHUNK = 1 << 12  # points that are rounded at once: what fits the host's cache
ALIGNMENT = 128  # bytes, of memory that a CPU's driver shares

HEADERS = {
    "adf/query.h": program.c_constants(
        **{search.upper(): number for number, search in enumerate(SEARCHES)}
    )
}


@dataclass(frozen=True)
class Shape:
    """How points are assigned to work-items: options of query.cl, and the size of a work-group."""

    lanes: int
    batch: int
    run: int
    group: int

    def padded(self, n: int) -> int:
        """The points of as many whole work-groups as n points take."""
        whole = self.batch * self.run * self.group
        return -(-n // whole) * whole

    def options(self) -> dict[str, int]:
        return {"LANES": self.lanes, "BATCH": self.batch, "RUN": self.run}


CPU = Shape(lanes=16, batch=64, run=16, group=4)
GPU = Shape(lanes=1, batch=1, run=1, group=64)
GPU_COHERENT = Shape(lanes=1, batch=1, run=16, group=64)


def query_adf(
    field: DistanceField,
    points: Any,
    *,
    search: str = "binary",
    gradient: bool = False,
    bounds: bool = False,
    cell: bool = False,
    device: Device | None = None,
) -> QueryResult:
    """The values of a field at points.

    The field stays on the device for the next call. For many calls with the same field, FieldQuery
    saves a little more.

    Parameters
    ----------
    field : the field.
    points, search, gradient, bounds, cell : as FieldQuery.__call__.
    device : by default that of default_device().

    Raises
    ------
    As FieldQuery.
    """
    wanted = _Wanted(search, gradient, bounds, cell)
    points, single = checked_points(points)
    wanted.check(field)
    if len(points) <= HOST_POINTS:
        result = field.query(points, gradient=gradient, bounds=bounds, cell=cell)
    else:
        result = FieldQuery(field, device).on_device(points, wanted)
    return result[0] if single else result


class FieldQuery:
    """A field on a device, for many queries.

    >>> query = voxtool.FieldQuery(field)
    >>> query([0.1, 0.2, 0.3]).distance
    >>> query(points, gradient=True).gradient

    It pickles as its field, and uses the default device where it is unpickled.
    """

    def __init__(
        self,
        field: DistanceField,
        device: Device | None = None,
        *,
        shape: Shape | None = None,
        block: int = BLOCK,
        host_points: int = HOST_POINTS,
    ) -> None:
        """Upload the field's textures; its bounds are uploaded when they are first asked for.

        Parameters
        ----------
        field : the field.
        device : by default that of default_device().
        shape : how points are assigned to work-items; by default as suits the device.
        block : points that are on the device at once.
        host_points : number of points up to which the host computes the values.

        Raises
        ------
        DeviceError : there is no device.
        MemoryLimitError : the field does not fit on it.
        """
        self.field = field
        self.device = device or default_device()
        self.textures = textures_of(field, self.device)
        self.shape, self.block, self.host_points = shape, block, host_points

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.field,)

    def __repr__(self) -> str:
        return f"FieldQuery({self.field!r}, {self.device!r})"

    def __call__(
        self,
        points: Any,
        *,
        search: str = "binary",
        gradient: bool = False,
        bounds: bool = False,
        cell: bool = False,
    ) -> QueryResult:
        """The values of the field at points; outside the cube see DistanceField.query.

        Parameters
        ----------
        points : (N, 3) numbers, world units, in any order; or a single point [x, y, z], for which
            the arrays of the result have no leading axis.
        search : "linear", from the coarsest level with leaves down; "binary", between that level
            and the deepest; or "coherent", from the level of the previous point, for points whose
            neighbours in the order are near, as along rays.
        gradient, bounds, cell : whether to return them beside the distance.

        Raises
        ------
        VoxtoolError : a wrong shape, an unknown search, or bounds of a field without them.
        MemoryLimitError : the device has no memory for a block of points.
        """
        wanted = _Wanted(search, gradient, bounds, cell)
        points, single = checked_points(points)
        wanted.check(self.field)
        if len(points) <= self.host_points:
            result = self.field.query(points, gradient=gradient, bounds=bounds, cell=cell)
        else:
            result = self.on_device(points, wanted)
        return result[0] if single else result

    def on_device(self, points: np.ndarray, wanted: _Wanted) -> QueryResult:
        """The values at (N, 3) float64 points, whatever their number."""
        n, side = len(points), self.field.side
        result = QueryResult(
            np.empty(n),
            np.empty((n, 3), np.float32) if wanted.gradient else None,
            np.empty(n) if wanted.bounds else None,
            np.empty(n, np.uint8) if wanted.cell else None,
            np.empty((n, 3), np.uint32) if wanted.cell else None,
            np.zeros(n, bool),
        )
        world_bounds = bound_values() * side
        with self.device.stage("query"):
            for block, fixed, found in self._blocks(points, result.outside, wanted):
                part = result[block]
                np.multiply(found["distances"], side, out=part.distance, dtype=np.float64)
                if part.gradient is not None:
                    part.gradient[:] = found["gradients"]
                if part.bound is not None:
                    np.take(world_bounds, found["codes"], out=part.bound, mode="clip")
                if part.level is not None and part.cell is not None:
                    part.level[:], part.cell[:] = found["leaf_levels"], found["leaves"]
                if part.outside.any():
                    self._extend(points[block], fixed, part)
        return result

    def _blocks(
        self, points: np.ndarray, outside: np.ndarray, wanted: _Wanted
    ) -> Iterator[tuple[slice, np.ndarray, dict[str, np.ndarray]]]:
        """Each block of points, rounded, and the kernel's outputs there. Fills `outside`.

        While the host rounds one block and takes in the values of another, the device searches.
        """
        lattice, shape = Lattice(self.field), self._shape(wanted.search)
        memory = [_point_memory(shape.padded(min(self.block, len(points)))) for _ in range(2)]
        running: tuple[slice, np.ndarray, _Running] | None = None
        for start in range(0, len(points), self.block):
            block = slice(start, min(start + self.block, len(points)))
            n, fixed = block.stop - start, memory[start // self.block % 2]
            lattice.round(points[block], fixed[:n], outside[block])
            done = running and (*running[:2], running[2].finish())
            running = block, fixed[:n], self._start(fixed, n, wanted)
            if done:
                yield done
        if running:
            yield *running[:2], running[2].finish()

    def _start(self, fixed: np.ndarray, n: int, wanted: _Wanted) -> _Running:
        """Begin the search for the first n of these points, which are padded."""
        device, shape = self.device, self._shape(wanted.search)
        padded = shape.padded(n)
        fixed[n:padded] = 0
        points = device.view(fixed[:padded])
        outputs = {
            name: device.empty(width * padded, dtype)
            for name, (dtype, width) in wanted.outputs().items()
        }
        options = {**shape.options(), **self.textures.options, **wanted.options()}
        device.kernel(SOURCE, "query", **options)(
            padded // (shape.batch * shape.run),
            points=points,
            **self.textures.arguments,
            bounds=bounds_of(self.field, device) if wanted.bounds else None,
            **outputs,
            local=shape.group,
        )
        device.queue.flush()  # or a driver may wait until the host does
        return _Running(n, points, outputs)

    def _extend(self, points: np.ndarray, fixed: np.ndarray, result: QueryResult) -> None:
        """Overwrite the values of those points of a block that are outside the cube."""
        field, which = self.field, np.flatnonzero(result.outside)
        has_bounds = field.bounds is not None
        wanted = _Wanted("binary", gradient=True, bounds=has_bounds, cell=not has_bounds)
        points, n = points[which], len(which)
        memory = _point_memory(self._shape("binary").padded(n))
        memory[:n] = fixed[which]
        found = self._start(memory, n, wanted).finish()
        bound = (
            bound_values()[found["codes"]]
            if has_bounds
            else half_diagonals(found["leaf_levels"].astype(np.int64))
        )
        world, slope = np.empty(n), found["gradients"]
        extend(field, points, np.ones(n, bool), found["distances"], world, slope, bound)
        lost = np.isnan(points).any(axis=1)
        world[lost], slope[lost] = np.nan, np.nan
        result.distance[which] = world
        if result.gradient is not None:
            result.gradient[which] = slope
        if result.bound is not None:
            result.bound[which] = np.inf
        result.outside[which[lost]] = False

    def _shape(self, search: str) -> Shape:
        if self.shape:
            return self.shape
        if self.device.info.kind == "CPU":
            return CPU
        return GPU_COHERENT if search == "coherent" else GPU


# --- blocks of points ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Wanted:
    """How to search, and what to return beside the distance."""

    search: str
    gradient: bool
    bounds: bool
    cell: bool

    def check(self, field: DistanceField) -> None:
        if self.search not in SEARCHES:
            raise VoxtoolError(f"search {self.search!r} is unknown: choose {', '.join(SEARCHES)}")
        if self.bounds and field.bounds is None:
            raise no_bounds()

    def options(self) -> dict[str, int | str]:
        wanted = {"GRADIENT": self.gradient, "BOUNDS": self.bounds, "CELL": self.cell}
        return {"SEARCH": self.search.upper(), **{name: 1 for name, on in wanted.items() if on}}

    def outputs(self) -> dict[str, tuple[type, int]]:
        """The kernel's output arguments: type, and numbers a point."""
        outputs: dict[str, tuple[type, int]] = {"distances": (np.float32, 1)}
        if self.gradient:
            outputs["gradients"] = np.float32, 3
        if self.bounds:
            outputs["codes"] = np.uint8, 1
        if self.cell:
            outputs |= {"leaf_levels": (np.uint8, 1), "leaves": (np.uint32, 3)}
        return outputs


@dataclass(frozen=True)
class _Running:
    """A search for n points that has begun; the points must stay in memory until it ends."""

    n: int
    points: Array
    outputs: dict[str, Array]

    def finish(self) -> dict[str, np.ndarray]:
        """Wait for the device: the outputs, (n,) or (n, 3)."""
        found = {}
        for name, array in self.outputs.items():
            values = array.take()
            wide = name in ("gradients", "leaves")
            found[name] = (values.reshape(-1, 3) if wide else values)[: self.n]
        return found


class Lattice:
    """Rounds points to 32-bit fixed point, as host_query.to_fixed."""

    def __init__(self, field: DistanceField) -> None:
        self.side = field.side
        self.origins = np.tile(np.array(field.origin), CHUNK)
        self.scratch = np.empty(3 * CHUNK)

    def round(self, points: np.ndarray, fixed: np.ndarray, outside: np.ndarray) -> None:
        """Round (n, 3) float64 world points to (n, 3) uint32, in `fixed`; set `outside` where one
        is not in the cube, and leave it elsewhere."""
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
