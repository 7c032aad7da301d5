"""Queries of a distance field at points, on the device [ADF, section 3.5].

Each of four searches finds the deepest cell that has a block, by looking up cells of one level
after another in the hash. All return the values of DistanceField.query, bit for bit. Levels whose
cells all have blocks are skipped.

With the sampler "hardware", the device's filter interpolates in a 3-D image of the blocks, and
distances are as exact as it. All else is the same.

The device reads the points where they are, if it shares the memory, and rounds them to the lattice
of 2**-32 sides. Many points are processed in blocks. A few points are looked up on the host, which
is faster than a launch.

Kernels: kernels/adf/queries/query.cl.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from voxtool.adf.field.cells import bound_values, half_diagonals
from voxtool.adf.field.field import DistanceField
from voxtool.adf.field.host_query import (
    QueryResult,
    checked_points,
    extend,
    no_bounds,
    query_on_host,
)
from voxtool.adf.queries.textures import (
    CPU,
    GPU,
    GPU_COHERENT,
    SOURCE,
    Shape,
    bounds_of,
    check_search,
    constant_of,
    filtered_of,
    textures_of,
)
from voxtool.choices import EXACT, SAMPLERS, SEARCHES
from voxtool.errors import VoxtoolError
from voxtool.opencl import Array, Device, default_device, program

HOST_POINTS = 128  # up to this number the host is faster than a launch
BLOCK = 1 << 22  # points that are on the device at once

OUTPUTS: dict[str, dict[str, tuple[type, int]]] = {  # of the kernel, if requested
    "gradient": {"gradients": (np.float32, 3)},
    "bounds": {"codes": (np.uint8, 1)},
    "cell": {"leaf_levels": (np.uint8, 1), "leaves": (np.uint32, 3)},
}


HEADERS = {
    "adf/queries/query.h": program.c_constants(
        **{constant_of(search): number for number, search in enumerate(SEARCHES)}
    )
}


def query_adf(
    field: DistanceField,
    points: Any,
    *,
    search: str = "binary",
    sampler: str = EXACT,
    gradient: bool = False,
    bounds: bool = False,
    cell: bool = False,
    device: Device | None = None,
) -> QueryResult:
    """Return the values of a field at points; see voxtool.query_adf."""
    request = _Request(search, gradient, bounds, cell)
    few = HOST_POINTS if sampler == EXACT else 0
    return request.run(field, points, few, lambda: FieldQuery(field, device, sampler=sampler))


class FieldQuery:
    """A field on a device, for many queries.

    Its bounds are uploaded when they are first requested. It pickles as its field, and uses the
    default device where it is unpickled.

    Parameters
    ----------
    field : DistanceField
        The field, whose textures are uploaded.
    device : Device, optional
        Where to search; the default device if None.
    sampler : str
        "exact", or "hardware": the device's filter interpolates distances, so they differ from
        device to device, and are as exact as it.
    shape : Shape, optional
        The assignment of points to work-items; by default the one for the kind of device.
    block : int
        Points that are on the device at once.
    host_points : int
        Number of points up to which the host computes the values, unless hardware does.

    Raises
    ------
    DeviceError
        If there is no device, or it has no double precision, or no filter for the images that the
        sampler needs.
    VoxtoolError
        If the sampler is unknown.
    MemoryLimitError
        If the field does not fit on it.

    Examples
    --------
    >>> query = voxtool.FieldQuery(field)
    >>> query([0.1, 0.2, 0.3]).distance
    >>> query(points, gradient=True).gradient
    """

    def __init__(
        self,
        field: DistanceField,
        device: Device | None = None,
        *,
        sampler: str = EXACT,
        shape: Shape | None = None,
        block: int = BLOCK,
        host_points: int = HOST_POINTS,
    ) -> None:
        self.field = field
        self.device = device or default_device()
        self.device.require_float64("distance fields")
        self.textures = textures_of(field, self.device)
        self.sampler, self.shape, self.block = sampler, shape, block
        if sampler not in SAMPLERS:
            raise VoxtoolError(f"sampler {sampler!r} is unknown: choose {', '.join(SAMPLERS)}")
        self.host_points = host_points if sampler == EXACT else 0
        self.filtered = {} if sampler == EXACT else filtered_of(field, self.device)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), sampler=self.sampler), (self.field,)

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
        """Return the values of the field at points, as voxtool.query_adf; outside the cube see
        DistanceField.query.

        Parameters
        ----------
        points : (N, 3) or (3,) array_like
            World units; (3,) is one point, for which the arrays of the result have no leading axis.
        search : str
            Below the levels of which a table has the cells: "linear", from the coarsest down;
            "binary", between that and the deepest; "coherent", from the level of the previous
            point, for points that are near the previous one, as along rays; or "bottom-up", from
            the deepest, for points that are near the surface.
        gradient, bounds, cell : bool
            Whether these are returned as well.

        Returns
        -------
        QueryResult

        Raises
        ------
        VoxtoolError
            If points have a wrong shape, the search is unknown, or there are no bounds.
        MemoryLimitError
            If a block of points does not fit on the device.
        """
        request = _Request(search, gradient, bounds, cell)
        return request.run(self.field, points, self.host_points, lambda: self)

    def on_device(self, points: np.ndarray, request: _Request) -> QueryResult:
        """Return the values at (N, 3) float64 points, computed on the device."""
        with self.device.stage("query"):
            parts = list(self._blocks(points, request))
        if len(parts) == 1:
            return parts[0]
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        joined: list[Any] = [None if c[0] is None else np.concatenate(c) for c in columns]
        return QueryResult(*joined)

    def _blocks(self, points: np.ndarray, request: _Request) -> Iterator[QueryResult]:
        """Yield the values of each block of points.

        The device searches one while the host completes the values of another.
        """
        running: tuple[np.ndarray, dict[str, Array]] | None = None
        for start in range(0, max(len(points), 1), self.block):
            block = points[start : start + self.block]
            shared = self.device.view_from(block)
            done = running and (running[0], _taken(running[1], len(running[0])))
            running = block, self._start(shared, len(block), request, self.field.side)
            del shared  # the wait for this block lets go of its points
            if done:
                yield self._result(*done)
        if running:
            yield self._result(running[0], _taken(running[1], len(running[0])))

    def _start(
        self, points: tuple[Array, int], n: int, request: _Request, unit: float
    ) -> dict[str, Array]:
        """Start the search for n points, which begin at a place in an array, and return the
        kernel's outputs; `unit` : the length of the cube's side in distances."""
        device, shape = self.device, self._shape(request.search)
        padded, kinds = shape.padded(n), request.outputs()
        outputs = {name: device.empty(wide * padded, kind) for name, (kind, wide) in kinds.items()}
        options = {**shape.options(), **self.textures.options, **request.options()}
        if self.filtered:
            options["HARDWARE"] = 1
        kernel = device.kernel(SOURCE, "query", **options)
        kernel(
            padded // (shape.batch * shape.run),
            points=points[0],
            start=points[1],
            count=n,
            origin=self.field.origin,
            side=self.field.side,
            unit=unit,
            **self.textures.arguments,
            **self.filtered,
            bounds=bounds_of(self.field, device) if request.bounds else None,
            **outputs,
            local=shape.group,
        )
        device.queue.flush()  # otherwise a driver may wait for the host
        return outputs

    def _result(self, points: np.ndarray, found: dict[str, np.ndarray]) -> QueryResult:
        """Return the values of points from the kernel's outputs."""
        result = QueryResult(
            found["distances"],
            found.get("gradients"),
            bound_values()[found["codes"]] * self.field.side if "codes" in found else None,
            found.get("leaf_levels"),
            found.get("leaves"),
            found["outside"],
        )
        if result.outside.any():
            self._extend(points, result)
        return result

    def _extend(self, points: np.ndarray, result: QueryResult) -> None:
        """Overwrite the values of the points of a block that are outside the cube."""
        which, has_bounds = np.flatnonzero(result.outside), self.field.bounds is not None
        request = _Request("binary", gradient=True, bounds=has_bounds, cell=not has_bounds)
        n = len(which)
        found = _taken(self._start((self.device.put(points[which]), 0), n, request, 1.0), n)
        bound = (
            bound_values()[found["codes"]]
            if has_bounds
            else half_diagonals(found["leaf_levels"].astype(np.int64))
        )
        extend(self.field, points, which, found["distances"], found["gradients"], bound, result)

    def _shape(self, search: str) -> Shape:
        if self.shape:
            return self.shape
        if self.device.lanes > 1:
            return CPU
        return GPU_COHERENT if search == "coherent" else GPU


@dataclass(frozen=True)
class _Request:
    """The search, and the values that are returned besides the distance."""

    search: str
    gradient: bool
    bounds: bool
    cell: bool

    def run(
        self,
        field: DistanceField,
        points: Any,
        host_points: int,
        query: Callable[[], FieldQuery],
    ) -> QueryResult:
        """Return the values at points: up to `host_points` by the host, others by a query."""
        check_search(self.search)
        if self.bounds and field.bounds is None:
            raise no_bounds()
        points, single = checked_points(points)
        if len(points) <= host_points:
            result = query_on_host(
                field, points, gradient=self.gradient, bounds=self.bounds, cell=self.cell
            )
        else:
            result = query().on_device(points, self)
        return result[0] if single else result

    def options(self) -> dict[str, int | str]:
        wanted = {name.upper(): 1 for name in OUTPUTS if getattr(self, name)}
        return {"SEARCH": constant_of(self.search), **wanted}

    def outputs(self) -> dict[str, tuple[type, int]]:
        """Return the kernel's output arguments: type, and numbers a point."""
        outputs = {"distances": (np.float64, 1), "outside": (np.bool_, 1)}
        for name, more in OUTPUTS.items():
            outputs |= more if getattr(self, name) else {}
        return outputs


def _taken(outputs: dict[str, Array], n: int) -> dict[str, np.ndarray]:
    """Wait for the device and return the kernel's outputs for n points, (n,) or (n, 3)."""
    found = {name: array.take() for name, array in outputs.items()}
    for name in found.keys() & {"gradients", "leaves"}:
        found[name] = found[name].reshape(-1, 3)
    return {name: values[:n] for name, values in found.items()}
