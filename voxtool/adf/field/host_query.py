"""The values of a distance field at points, computed on the host [ADF, section 3.5].

A point is three 32-bit numbers in units of 2**-32 sides: its bits are the cell of every level and
the fraction within, exactly. The kernels in kernels/adf/queries/query.cl return the same values.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.field.cells import bound_values, half_diagonals
from voxtool.arrays import Data
from voxtool.errors import VoxtoolError
from voxtool.morton import morton_encode
from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField
    from voxtool.adf.field.stored_field import StoredField

POINT_BITS = 32  # bits of a coordinate in the cube
WEIGHT_BITS = 24  # bits of the fraction within a cell that a weight in float32 takes
CORNERS = np.array([0, 1, 3, 4, 9, 10, 12, 13])  # of a block's first child, among its vertices
AT_ONCE = 1 << 14  # points that are searched for at once, in memory that fits caches
CHUNK = 1 << 12  # points that are rounded at once, in memory that fits caches

HEADERS = {
    "adf/field/points.h": program.c_constants(POINT_BITS=POINT_BITS, WEIGHT_BITS=WEIGHT_BITS)
}


@dataclass(frozen=True, eq=False)
class QueryResult(Data):
    """The values of a field at N points; for one point [x, y, z] without the leading axis.

    Attributes
    ----------
    distance : (N,) float64
        World units; NaN where a coordinate is NaN. Outside the cube it is a lower bound of the
        distance, see DistanceField.query.
    gradient : (N, 3) float32, or None
        The gradient of the distance.
    bound : (N,) float64, or None
        The largest possible error of the distance, world units; infinity outside the cube and in
        leaves with a sign discontinuity.
    level, cell : (N,) uint8 and (N, 3) uint32, or None
        The leaf: cell (i, j, k) of its level. The root has level 0.
    outside : (N,) bool
        Whether the point is outside the cube.
    """

    distance: np.ndarray
    gradient: np.ndarray | None
    bound: np.ndarray | None
    level: np.ndarray | None
    cell: np.ndarray | None
    outside: np.ndarray

    def __post_init__(self) -> None:
        """Leave the arrays writable: they are the caller's own."""

    def __getitem__(self, points: Any) -> QueryResult:
        """Return the values at some of the points: views, where numpy gives views."""
        arrays = ((f.name, getattr(self, f.name)) for f in fields(self))
        return replace(self, **{name: a[points] for name, a in arrays if a is not None})


def query_on_host(
    field: DistanceField | StoredField, points: Any, *, gradient: bool, bounds: bool, cell: bool
) -> QueryResult:
    """Return the values of a field at points; see DistanceField.query."""
    points, single = checked_points(points)
    if bounds and field.bounds is None:
        raise no_bounds()
    fixed, outside = np.empty(points.shape, np.uint32), np.zeros(len(points), bool)
    to_fixed(field, points, fixed, outside)
    level, block = search(field, fixed)
    child = fixed.astype(np.int64) >> (POINT_BITS - 1 - level)[:, None]
    octant = child & 1
    corners = field.corners(block, octant)
    t = weights(fixed, level)
    distance = trilinear(corners, t)

    def gradients(some: np.ndarray | slice) -> np.ndarray:
        per_side = np.ldexp(np.float32(1), level[some] + 1)[:, None]
        return trilinear_gradient(corners[some], t[some]) * per_side

    def bounds_of(some: np.ndarray | slice) -> np.ndarray:
        if field.bounds is None:
            return half_diagonals(level[some] + 1)
        return bound_values()[field.bound_codes(block[some], octant[some])]

    every = slice(None)
    result = QueryResult(
        distance.astype(np.float64) * field.side,
        gradients(every) if gradient else None,
        bounds_of(every) * field.side if bounds else None,
        (level + 1).astype(np.uint8) if cell else None,
        child.astype(np.uint32) if cell else None,
        outside,
    )
    which = np.flatnonzero(outside)
    if len(which):
        extend(field, points, which, distance[which], gradients(which), bounds_of(which), result)
    return result[0] if single else result


def to_fixed(
    field: DistanceField | StoredField, points: np.ndarray, fixed: np.ndarray, outside: np.ndarray
) -> None:
    """Write (N, 3) world points to `fixed`, (N, 3) uint32 in units of 2**-32 sides, moved into the
    cube, 0 for NaN; set `outside`, (N,) bool, where a point is not in the cube."""
    few = min(len(points), CHUNK)
    origins, scratch = np.tile(np.array(field.origin), few), np.empty(3 * few)
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(points), CHUNK):
            chunk = slice(start, start + CHUNK)
            flat = points[chunk].reshape(-1)
            u = np.subtract(flat, origins[: len(flat)], out=scratch[: len(flat)])
            np.divide(u, field.side, out=u)
            if not (u.min() >= 0 and u.max() < 1):  # or NaN
                inside = (u >= 0) & (u <= 1)
                outside[chunk] = ~(inside[::3] & inside[1::3] & inside[2::3])
                np.fmax(u, 0, out=u)  # 0 for NaN
                np.fmin(u, 1 - 2.0**-POINT_BITS, out=u)
            np.multiply(u, 2.0**POINT_BITS, out=u)
            np.copyto(fixed[chunk].reshape(-1), u, casting="unsafe")


def search(field: DistanceField | StoredField, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level and the block of the deepest cell with a block at each point, (N,) int64.

    The cells of all levels are looked up. Every cell has a parent, so the number found minus one is
    the level.
    """
    level, block = np.empty(len(fixed), np.int64), np.empty(len(fixed), np.int64)
    levels = np.arange(field.depth)
    identifiers, blocks = field.identifiers.ravel(), field.cells[..., -1].ravel()
    for start in range(0, len(fixed), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        cells = fixed[some, None].astype(np.int64) >> (POINT_BITS - levels)[:, None]
        slots = field.hash.slots((cells + (1 << levels)[:, None]).reshape(-1, 3))
        deepest = morton_encode(cells[:, -1]) | np.uint64(1 << 3 * (field.depth - 1))
        expected = deepest[:, None] >> (3 * levels[::-1]).astype(np.uint64)
        slots = slots.reshape(expected.shape)
        level[some] = np.count_nonzero(identifiers[slots] == expected, axis=1) - 1
        block[some] = blocks[np.take_along_axis(slots, level[some, None], 1)[:, 0]]
    return level, block


def extend(
    field: DistanceField | StoredField,
    points: np.ndarray,
    which: np.ndarray,
    distance: np.ndarray,
    slope: np.ndarray,
    bound: np.ndarray,
    result: QueryResult,
) -> None:
    """Overwrite the values of the (k,) points `which`, which are outside the cube or NaN.

    distance, slope, bound : (k,), (k, 3), (k,), in sides, of the nearest points of the cube.
    """
    outer = points[which]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        u = (outer - field.origin) / field.side
        beyond = np.where(u < 0, u, np.where(u > 1, u - 1, 0.0))
        near = np.abs(distance.astype(np.float64)) - bound
        near = np.where(near > 0, near, 0.0)
        infinite = np.isinf(beyond)
        endless = infinite.any(axis=1)  # the limit along a ray: only infinite coordinates count
        beyond[endless], near[endless] = np.copysign(infinite, beyond)[endless], 0.0
        exponent = np.frexp(np.abs(beyond).max(axis=1))[1]  # squares of large ones overflow
        x, y, z = np.ldexp(beyond.T, -exponent)
        part = np.ldexp(near, -exponent)
        total = np.ldexp(np.sqrt(x * x + y * y + z * z + part * part), exponent)
        inward = np.where(distance < 0, -near, near)[:, None]
        steep = np.where(beyond != 0, beyond, inward * slope) / total[:, None]
    lost = np.flatnonzero(np.isnan(outer).any(axis=1))
    total[endless], total[lost], steep[lost] = np.inf, np.nan, np.nan
    result.distance[which] = total * field.side
    if result.gradient is not None:
        result.gradient[which] = steep
    if result.bound is not None:
        result.bound[which] = np.inf
    result.outside[which[lost]] = False


def weights(fixed: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the position of (N, 3) points, in units of 2**-32 sides, in the child that contains
    each, (N, 3) float32 in [0, 1); `level` is that of the child's parent."""
    fraction = (
        fixed << (level + 1)[:, None].astype(np.uint32) >> np.uint32(POINT_BITS - WEIGHT_BITS)
    )
    return fraction.astype(np.float32) * np.float32(2.0**-WEIGHT_BITS)


def trilinear(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return (N, 2, 2, 2) values, [z, y, x], interpolated at (N, 3) float32 in [0, 1]: along x,
    then y, then z, each a + t (b - a); (N,) float32."""
    for axis in range(3):
        a, b = values[..., 0], values[..., 1]
        weight = t[:, axis].reshape(-1, *[1] * (a.ndim - 1))
        values = a + weight * (b - a)
    return values


def trilinear_gradient(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the gradient of trilinear times the edge, (N, 3) float32: the differences along each
    axis, interpolated along the other two in the order x, y, z."""
    slopes = []
    for axis in range(3):
        last = 3 - axis  # of the axes [point, z, y, x]
        v = np.diff(values, axis=last).squeeze(last)
        for other in (a for a in range(3) if a != axis):
            weight = t[:, other].reshape(-1, *[1] * (v.ndim - 2))
            v = v[..., 0] + weight * (v[..., 1] - v[..., 0])
        slopes.append(v)
    return np.stack(slopes, axis=1)


def checked_points(points: Any) -> tuple[np.ndarray, bool]:
    """Return points as (N, 3) float64, and whether they were one point; raises VoxtoolError."""
    try:
        world = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise VoxtoolError("points are not an array of numbers: give (N, 3) or [x, y, z]") from None
    if world.ndim not in (1, 2) or world.shape[-1] != 3:
        raise VoxtoolError(f"points of shape {world.shape}: give (N, 3) or [x, y, z]")
    return world.reshape(-1, 3), world.ndim == 1


def no_bounds() -> VoxtoolError:
    """Return the error for bounds of a field without them."""
    return VoxtoolError("the field has no bounds: build it without --no-bounds")
