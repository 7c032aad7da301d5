"""The picture of a tetrahedral volume in float64, by a plain algorithm.

Each ray is clipped to each cell whose projection may cover its pixel. The intervals are sorted by
depth, cut at the control points of the transfer function, integrated and composited. Neighbours
and gradients of cells are not used. A ray in a face of two cells belongs to one of them: pixel
centres are moved by an infinitesimal (εx ≫ εy). Emission and extinction are linear between control
points, and the emission per unit of length is c τ [Williams 1998].
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from voxtool.camera import Rays
    from voxtool.tets.pictures.transfer import TransferFunction

PAIRS = 1 << 19  # pairs of a cell and a pixel in a band of the picture
ROUNDING = 1e-14  # of a volume, relative to its terms; cells below it count as flat
POINTS = 12  # of each panel of a quadrature
SLACK = 1e-9  # pixels by which boxes are wider than their cells: more than rounding


@dataclass(frozen=True)
class Segments:
    """The intervals of rays inside cells, by pixel and then by depth.

    pixel : (n,) int, index among the requested ones; cell : (n,) int; near, far : (n,) float64, t
    of the rays; length : (n,) float64, world units; scalars : (n, 2) float64, at near and far.
    """

    pixel: np.ndarray
    cell: np.ndarray
    near: np.ndarray
    far: np.ndarray
    length: np.ndarray
    scalars: np.ndarray


def reference(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    transfer: TransferFunction,
    rays: Rays,
    pixels: np.ndarray | None = None,
    *,
    constant: bool = False,
    most: int = PAIRS,
) -> np.ndarray:
    """Return (N, 4) float64: the premultiplied RGBA of pixels.

    Orthographic rays are whole lines; those in perspective begin at the eye.

    Parameters
    ----------
    vertices : (V, 3) float64, world units; cells : (T, 4) int, of either orientation; those of
        zero volume are left out.
    scalars : (V,) float64, or (T,) if they are constant in each cell.
    pixels : (N, 2) int, column and row, none twice; all by default, row by row.
    most : pairs of a cell and a pixel that are clipped together, unless a row has more.
    """
    if pixels is None:
        width, height = rays.size
        row, column = np.divmod(np.arange(width * height), width)
        pixels = np.stack([column, row], axis=1)
    picture = np.zeros((len(pixels), 4))
    for found in segments(vertices, cells, scalars, rays, pixels, constant=constant, most=most):
        composite(picture, found, transfer)
    return picture


# --- what cells leave of rays --------------------------------------------------------------------


def segments(
    vertices: np.ndarray,
    cells: np.ndarray,
    scalars: np.ndarray,
    rays: Rays,
    pixels: np.ndarray,
    *,
    constant: bool = False,
    most: int = PAIRS,
) -> Iterator[Segments]:
    """Yield the intervals of the rays of pixels inside cells, one band of the picture at a time."""
    x, y = (pixels + 0.5 - np.array(rays.size) / 2).T
    way = rays.direction + rays.perspective * (x[:, None] * rays.right + y[:, None] * rays.down)
    speed = np.sqrt((way * way).sum(axis=1))
    # coordinates in which rays are (x, y, t), or t (x, y, 1) in perspective
    axes = np.stack([rays.right, rays.down, rays.direction], axis=1)
    places = np.linalg.solve(axes, (vertices - rays.origin).T).T
    planes = planes_of(places, cells)
    low, high = projected_boxes(places[cells], rays.perspective)
    low, high = low - SLACK, high + SLACK
    # from here on a box is of columns and lines among those that pixels are in
    columns, at_column = np.unique(x, return_inverse=True)
    lines, at_line = np.unique(y, return_inverse=True)
    first = np.stack([np.searchsorted(columns, low[:, 0]), np.searchsorted(lines, low[:, 1])])
    stop = np.stack(
        [np.searchsorted(columns, high[:, 0], "right"), np.searchsorted(lines, high[:, 1], "right")]
    )
    chosen = np.full((len(lines), len(columns)), -1)
    chosen[at_line, at_column] = np.arange(len(pixels))
    corners = scalars[cells] if not constant else np.repeat(scalars[:, None], 4, axis=1)
    for top, bottom in bands(first, stop, len(lines), most):
        cell, column, line = pairs(first, stop, top, bottom)
        pixel = chosen[line, column]
        cell, pixel = cell[pixel >= 0], pixel[pixel >= 0]
        yield clip(planes, corners, cell, pixel, x[pixel], y[pixel], speed, rays.perspective)


def planes_of(places: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return (T, 4, 4) float64: normal and offset of the face opposite each vertex, positive
    inside, not normalised; 0 where a cell has no volume.

    The corners of a face are taken in the order of their positions, so cells that share it have the
    same numbers except for the sign.
    """
    order = np.lexsort(places.T)
    rank = np.empty(len(places), np.int64)
    rank[order] = np.arange(len(places))
    planes = np.empty((len(cells), 4, 4))
    for face in range(4):
        corners = np.delete(cells, face, axis=1)
        corners = np.take_along_axis(corners, np.argsort(rank[corners], axis=1), axis=1)
        a, b, c = places[corners].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        terms = normal * (places[cells[:, face]] - a)
        side = terms.sum(axis=1)
        side[np.abs(side) <= ROUNDING * np.abs(terms).sum(axis=1)] = 0
        planes[:, face, :3] = normal
        planes[:, face, 3] = -(normal * a).sum(axis=1)
        planes[:, face] *= np.sign(side)[:, None]
    return planes


def projected_boxes(corners: np.ndarray, perspective: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return (T, 2) float64 each: least and largest x and y of the rays that may meet cells of (T,
    4, 3) corners; inf and -inf for cells that no ray meets."""
    places, depth = corners[:, :, :2], corners[:, :, 2:]
    if not perspective:
        return places.min(axis=1), places.max(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = places / depth
    low = np.where(depth > 0, seen, np.inf).min(axis=1)
    high = np.where(depth > 0, seen, -np.inf).max(axis=1)
    # edges that pass the eye's plane are seen as far as infinity, on the side of where they do
    for i, j in permutations(range(4), 2):
        passing = (depth[:, i] <= 0) & (depth[:, j] > 0)
        at = places[:, i] * depth[:, j] - places[:, j] * depth[:, i]
        low[passing & (at < 0)] = -np.inf
        high[passing & (at > 0)] = np.inf
    return low, high


def bands(first: np.ndarray, stop: np.ndarray, lines: int, most: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of lines with about `most` pairs of a cell and a pixel in each."""
    across = np.maximum(stop[0] - first[0], 0)
    across[stop[1] <= first[1]] = 0
    change = np.bincount(first[1], across, lines + 1) - np.bincount(stop[1], across, lines + 1)
    work = np.cumsum(change)[:lines]
    top, sum_ = 0, 0.0
    for line, more in enumerate(work):
        if sum_ and sum_ + more > most:
            yield top, line
            top, sum_ = line, 0.0
        sum_ += more
    yield top, lines


def pairs(
    first: np.ndarray, stop: np.ndarray, top: int, bottom: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cell, column and line of each pair of a cell and a pixel of its box in some lines."""
    upper, lower = np.maximum(first[1], top), np.minimum(stop[1], bottom)
    across, down = np.maximum(stop[0] - first[0], 0), np.maximum(lower - upper, 0)
    count = across * down
    cell = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    line, column = np.divmod(within, across[cell])
    return cell, first[0][cell] + column, upper[cell] + line


def clip(
    planes: np.ndarray,
    corners: np.ndarray,
    cell: np.ndarray,
    pixel: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    speed: np.ndarray,
    perspective: bool,
) -> Segments:
    """Return the interval of the ray in the cell for each pair, (n,) of a cell and a pixel at x and
    y."""
    normal, offset = planes[cell, :, :3], planes[cell, :, 3]
    across = normal[..., 0] * x[:, None] + normal[..., 1] * y[:, None]
    # a face's plane has the value start + t slope along the ray
    start = offset if perspective else across + offset
    slope = across + normal[..., 2] if perspective else normal[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -start / slope
    near = np.where(slope > 0, t, 0 if perspective else -np.inf).max(axis=1)
    far = np.where(slope < 0, t, np.inf).min(axis=1)
    moved = np.where(normal[..., 0] != 0, normal[..., 0], normal[..., 1])
    inside = (slope != 0) | (start > 0) | ((start == 0) & (moved > 0))
    kept = np.flatnonzero(inside.all(axis=1) & (near < far))
    kept = kept[np.lexsort((near[kept], pixel[kept]))]
    cell, pixel, near, far = cell[kept], pixel[kept], near[kept], far[kept]
    own, ends = corners[cell], np.empty((len(kept), 2))
    first = own[:, 0]  # what is added to it is exactly 0 where corners are alike
    for end, depth in enumerate((near, far)):
        # barycentric coordinates times the cell's volume times 6; none if it is lost in rounding
        values = np.maximum(start[kept] + depth[:, None] * slope[kept], 0)
        total = values.sum(axis=1)
        total[total == 0] = 1
        ends[:, end] = first + (values * (own - first[:, None])).sum(axis=1) / total
    return Segments(pixel, cell, near, far, (far - near) * speed[pixel], ends)


# --- what is added to a ray ----------------------------------------------------------------------


def cut(found: Segments, transfer: TransferFunction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pieces of segments between control points, in the order of segments and then of
    depth.

    Returns the segment of each, (n,) int; at the near and the far end the colours, (n, 2, 3)
    float64, and the optical depth of the whole length at the extinction there, (n, 2) float64.
    """
    points = transfer.scalars
    distinct = np.unique(points)
    low, high = found.scalars.min(axis=1), found.scalars.max(axis=1)
    begin, end = np.searchsorted(distinct, low, "right"), np.searchsorted(distinct, high)
    count = np.maximum(end - begin, 0) + 1
    segment = np.repeat(np.arange(len(count)), count)
    k = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    near, far = found.scalars[segment].T
    falls = near > far
    k = np.where(falls, count[segment] - 1 - k, k)  # from the least scalar of the segment
    padded = np.append(distinct, np.inf)
    lower = np.where(k == 0, low[segment], padded[begin[segment] + k - 1])
    upper = np.where(k == count[segment] - 1, high[segment], padded[begin[segment] + k])
    values = values_in(np.searchsorted(points, lower, "right"), lower, upper, transfer)
    values[falls] = values[falls, ::-1]
    share = np.divide(upper - lower, np.abs(far - near), out=np.ones(len(k)), where=near != far)
    depths = values[:, :, 3] * (share * found.length[segment])[:, None]
    return segment, values[:, :, :3], depths


def values_in(
    interval: np.ndarray, lower: np.ndarray, upper: np.ndarray, transfer: TransferFunction
) -> np.ndarray:
    """Return (n, 2, 4) float64: colour and extinction at two scalars of an interval of the control
    points: 0 is below the first, 1 between the first and the next."""
    points = transfer.scalars
    nodes = np.column_stack([transfer.colours, transfer.extinctions])
    before, after = np.maximum(interval - 1, 0), np.minimum(interval, len(points) - 1)
    width = points[after] - points[before]
    values = np.empty((len(interval), 2, 4))
    for end, scalar in enumerate((lower, upper)):
        share = np.divide(scalar - points[before], width, out=np.zeros(len(width)), where=width > 0)
        share = np.clip(share, 0, 1)[:, None]
        values[:, end] = (1 - share) * nodes[before] + share * nodes[after]
    return values


def weights(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) float64 each: the weights of the colours at the two ends of a piece, to 1e-12
    relative.

    With the optical depth T(s) = a s + (b - a) s²/2 from the near end to s, and R(s) from there to
    the far end: ∫ 1 - exp(-T) ds and ∫ exp(-T) (1 - exp(-R)) ds over 0 to 1, Gauss-Legendre on
    panels that are finer by halves towards the near end, until the first has T below 1.
    """
    halvings = np.ceil(np.log2(np.maximum(np.maximum(a, b), 1))).astype(int)
    near, far = np.zeros(len(a)), np.zeros(len(a))
    for n in np.unique(halvings):
        at = np.flatnonzero(halvings == n)
        for s, w in zip(*nodes_of(n), strict=True):
            t = s * (a[at] * (1 - s / 2) + b[at] * (s / 2))
            r = (1 - s) * (a[at] * ((1 - s) / 2) + b[at] * ((1 + s) / 2))
            near[at] -= w * np.expm1(-t)
            far[at] -= w * np.exp(-t) * np.expm1(-r)
    return near, far


def nodes_of(halvings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points and weights of a quadrature over 0 to 1."""
    points, weights_ = np.polynomial.legendre.leggauss(POINTS)
    graded = 0.5 ** np.arange(halvings, 0, -1.0)
    breaks = np.concatenate([[0], graded, [1]])
    size = np.diff(breaks)[:, None]
    return (breaks[:-1, None] + size * (points + 1) / 2).ravel(), (size * weights_ / 2).ravel()


def composite(picture: np.ndarray, found: Segments, transfer: TransferFunction) -> None:
    """Add segments to a picture, (N, 4) float64, whose pixels have none yet, front to back."""
    segment, ends, depths = cut(found, transfer)
    near, far = weights(*depths.T)
    colours = near[:, None] * ends[:, 0] + far[:, None] * ends[:, 1]
    depth = depths.mean(axis=1)
    added = np.column_stack([colours, -np.expm1(-depth)])
    pixel, start, count = np.unique(found.pixel[segment], return_index=True, return_counts=True)
    sofar = np.zeros(len(pixel))  # optical depth
    for k in range(count.max(initial=0)):
        live = np.flatnonzero(count > k)
        at = start[live] + k
        picture[pixel[live]] += np.exp(-sofar[live])[:, None] * added[at]
        sofar[live] += depth[at]
