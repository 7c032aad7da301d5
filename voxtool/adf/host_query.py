"""The values of a distance field at points, computed on the host [ADF, section 3.5].

A point is three 32-bit numbers in units of 2**-32 sides: its bits are the cell of every level and
the fraction within, exactly. The kernels in kernels/adf/query.cl return the same values.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.adf.bounds import bound_values, half_diagonals
from voxtool.arrays import Data
from voxtool.errors import VoxtoolError
from voxtool.morton import morton_encode
from voxtool.opencl import program

if TYPE_CHECKING:
    from voxtool.adf.field import DistanceField

POINT_BITS = 32  # of a coordinate in the cube
WEIGHT_BITS = 24  # of the fraction within a cell that a weight in float32 takes
CORNERS = np.array([0, 1, 3, 4, 9, 10, 12, 13])  # of a block's first child, among its vertices
AT_ONCE = 1 << 14  # points that are searched for at once, in memory that fits caches

HEADERS = {"adf/points.h": program.c_constants(POINT_BITS=POINT_BITS, WEIGHT_BITS=WEIGHT_BITS)}


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
        arrays = (getattr(self, f.name) for f in fields(self))
        return QueryResult(*(None if array is None else array[points] for array in arrays))  # type: ignore[arg-type]


def query_on_host(
    field: DistanceField, points: Any, *, gradient: bool, bounds: bool, cell: bool
) -> QueryResult:
    """Return the values of a field at points; see DistanceField.query."""
    points, single = checked_points(points)
    if bounds and field.bounds is None:
        raise no_bounds()
    fixed, outside = to_fixed(field, points)
    beyond = bool(outside.any())
    level, block = search(field, fixed)
    child = fixed.astype(np.int64) >> (POINT_BITS - 1 - level)[:, None]
    octant = child & 1
    values = _corners(field, block, octant)
    t = weights(fixed, level)
    distance = trilinear(values, t)
    slope = bound = None
    if gradient or beyond:
        slope = trilinear_gradient(values, t) * np.ldexp(np.float32(1), level + 1)[:, None]
    if field.bounds is not None and (bounds or beyond):
        bound = bound_values()[field.bounds[block, octant[:, 2], octant[:, 1], octant[:, 0]]]
    elif beyond:
        bound = half_diagonals(level + 1)
    world = distance.astype(np.float64) * field.side
    if beyond:
        assert slope is not None
        assert bound is not None
        extend(field, points, outside, distance, world, slope, bound)
        lost = np.isnan(points).any(axis=1)
        world[lost], slope[lost] = np.nan, np.nan
        outside_bound, outside = outside, outside & ~lost
        bound = np.where(outside_bound, np.inf, bound)
    result = QueryResult(
        world,
        slope if gradient else None,
        bound * field.side if bounds and bound is not None else None,
        (level + 1).astype(np.uint8) if cell else None,
        child.astype(np.uint32) if cell else None,
        outside,
    )
    return result[0] if single else result


def to_fixed(field: DistanceField, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 3) world points as (N, 3) uint32 in units of 2**-32 sides, moved into the cube, 0
    for NaN; and whether each point is outside, (N,) bool."""
    with np.errstate(over="ignore", invalid="ignore"):
        u = (points - field.origin) / field.side
        outside = np.logical_not(((u >= 0) & (u <= 1)).all(axis=1))
        u = np.where(u > 0, u, 0.0) * 2.0**POINT_BITS
    return np.minimum(u, 2.0**POINT_BITS - 1).astype(np.uint32), outside


def search(field: DistanceField, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level and the block of the deepest cell with a block at each point, (N,) int64.

    The cells of all levels are looked up. Every cell has a parent, so the number found minus one is
    the level.
    """
    if len(fixed) > AT_ONCE:
        parts = [search(field, fixed[i : i + AT_ONCE]) for i in range(0, len(fixed), AT_ONCE)]
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))  # type: ignore[return-value]
    levels = np.arange(field.depth)
    cells = fixed[:, None].astype(np.int64) >> (POINT_BITS - levels)[:, None]
    slots = field.hash.slots((cells + (1 << levels)[:, None]).reshape(-1, 3))
    deepest = morton_encode(cells[:, -1]) | np.uint64(1 << 3 * (field.depth - 1))
    identifiers = deepest[:, None] >> (3 * levels[::-1]).astype(np.uint64)
    slots = slots.reshape(identifiers.shape)
    level = np.count_nonzero(field.identifiers.ravel()[slots] == identifiers, axis=1) - 1
    block = field.cells.reshape(-1, field.cells.shape[-1])[
        np.take_along_axis(slots, level[:, None], 1)[:, 0], -1
    ]
    return level, block.astype(np.int64)


def _corners(field: DistanceField, block: np.ndarray, octant: np.ndarray) -> np.ndarray:
    """Return the distances at the corners of children of blocks, (N, 2, 2, 2) float32."""
    first = octant[:, 0] + 3 * octant[:, 1] + 9 * octant[:, 2] + 27 * block
    return field.voxels.reshape(-1)[first[:, None] + CORNERS].reshape(-1, 2, 2, 2)


def extend(
    field: DistanceField,
    points: np.ndarray,
    outside: np.ndarray,
    distance: np.ndarray,
    world: np.ndarray,
    slope: np.ndarray,
    bound: np.ndarray,
) -> None:
    """Write the lower bounds at points outside the cube to `world`, and gradients to `slope`."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        u = (points[outside] - field.origin) / field.side
        beyond = np.where(u < 0, u, np.where(u > 1, u - 1, 0.0))
        near = np.abs(distance[outside].astype(np.float64)) - bound[outside]
        near = np.where(near > 0, near, 0.0)
        exponent = np.frexp(np.abs(beyond).max(axis=1))[1]  # squares of large ones overflow
        x, y, z = np.ldexp(beyond.T, -exponent)
        part = np.ldexp(near, -exponent)
        total = np.ldexp(np.sqrt(x * x + y * y + z * z + part * part), exponent)
        inward = np.where(distance[outside] < 0, -near, near)[:, None]
        steep = np.where(beyond != 0, beyond, inward * slope[outside]) / total[:, None]
    world[outside] = total * field.side
    slope[outside] = steep.astype(np.float32)


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
