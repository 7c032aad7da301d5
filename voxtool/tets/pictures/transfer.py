"""Transfer functions: the colour and the extinction of each scalar.

Both are linear between control points and constant beyond the first and the last; two points at one
scalar make a step. Colours are what a screen shows, extinctions are per world unit of length.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from voxtool.arrays import Data
from voxtool.errors import VoxtoolError, printable
from voxtool.tets.pictures.maps import MAPS
from voxtool.tets.volume.volume import TetVolume
from voxtool.vector import cross, dot

MOST_POINTS = 255
ROW = 16  # floats of an interval
EXACT_ROW = 10  # numbers of an interval in float64
FARTHEST = 1e300  # scalar: differences must not overflow
LARGEST = 1e30  # extinction that float32 holds with room for products
TINY = 1e-30  # smaller numbers count as 0 on the device: no denormals
# The tetrahedra of a cell, by its number of corners: the corners of each.
TETRAHEDRA = {
    4: [[0, 1, 2, 3]],
    8: [[0, a, b, 6] for a, b in ((1, 2), (2, 3), (3, 7), (7, 4), (4, 5), (5, 1))],
}
KEYS = ("scalar", "color", "extinction")  # of a control point in JSON


@dataclass(frozen=True, eq=False)
class TransferFunction(Data):
    """Control points of colour and extinction, linear between them and constant beyond.

    The arrays are copied and read-only.

    Attributes
    ----------
    scalars : (K,) float64
        Ascending, 1 to 255. At most two are equal: a step, at which the later point holds.
    colours : (K, 3) float64
        Red, green and blue from 0 to 1.
    extinctions : (K,) float64
        Extinction per world unit, 0 or more.

    Raises
    ------
    VoxtoolError
        If a point is not valid; the message says which.
    """

    scalars: np.ndarray
    colours: np.ndarray
    extinctions: np.ndarray

    def __post_init__(self) -> None:
        for name in ("scalars", "colours", "extinctions"):
            try:
                values = np.array(getattr(self, name), np.float64)
            except (TypeError, ValueError, OverflowError):
                raise VoxtoolError(
                    f"transfer function: {name} are not numbers of float64"
                ) from None
            object.__setattr__(self, name, values)
        super().__post_init__()
        s, c, e = self.scalars, self.colours, self.extinctions
        count = s.size
        if not 1 <= count <= MOST_POINTS:
            raise VoxtoolError(f"transfer function of {count} points: give 1 to {MOST_POINTS}")
        if (s.shape, c.shape, e.shape) != ((count,), (count, 3), (count,)):
            raise VoxtoolError(
                "transfer function: give each point a scalar, a colour of three numbers, and an "
                "extinction"
            )
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.diff(s, prepend=-FARTHEST)
        shared = steps == 0
        shared[1:] &= shared[:-1]
        for bad, what in (
            (~(np.abs(s) < FARTHEST), "scalar {s} is not a number in reach"),
            (~((c >= 0) & (c <= 1)).all(axis=1), "colour {c} is not from 0 to 1"),
            (~((e >= 0) & (e < np.inf)), "extinction {e} is not 0 or more"),
            (steps < 0, "its scalar is less than the one before: put them in ascending order"),
            (shared, "the two before it have the same scalar: at most two make a step"),
        ):
            if bad.any():
                at = int(bad.argmax())
                what = what.format(s=s[at], c=c[at].tolist(), e=e[at])
                raise VoxtoolError(f"transfer function, point {at + 1}: {what}")

    def __repr__(self) -> str:
        low, high = self.scalars[[0, -1]].tolist()
        return f"TransferFunction({len(self.scalars)} points from {low:g} to {high:g})"

    @staticmethod
    def from_json(text: str) -> TransferFunction:
        """Return the transfer function of {"points": [{"scalar": 0.2, "color": [1, 0.5, 0],
        "extinction": 3.5}, ...]}.

        Raises
        ------
        VoxtoolError
            If the JSON or a point is not valid; the message says which.
        """
        try:
            found = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise VoxtoolError(f"transfer function: no JSON: {printable(error)[:80]}") from None
        points = found.get("points") if isinstance(found, dict) and len(found) == 1 else None
        if not isinstance(points, list):
            raise VoxtoolError('transfer function: {"points": [...]} is expected, and nothing else')
        for number, point in enumerate(points, 1):
            if wrong := _wrong_with(point):
                raise VoxtoolError(f"transfer function, point {number}: {wrong}")
        scalars, colours, extinctions = (np.array([point[key] for point in points]) for key in KEYS)
        return TransferFunction(scalars, colours.reshape(-1, 3), extinctions)

    def to_json(self) -> str:
        """Return the JSON that from_json reads."""
        points = zip(
            self.scalars.tolist(), self.colours.tolist(), self.extinctions.tolist(), strict=True
        )
        return json.dumps(
            {"points": [{"scalar": s, "color": c, "extinction": e} for s, c, e in points]}, indent=1
        )

    def evaluate(self, scalars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the colours (..., 3) and extinctions (...,) of scalars, float64."""
        scalars = np.asarray(scalars, np.float64)
        interval = np.searchsorted(self.scalars, scalars, side="right")
        low = np.clip(interval - 1, 0, None)
        high = np.clip(interval, None, len(self.scalars) - 1)
        width, into = self.scalars[high] - self.scalars[low], scalars - self.scalars[low]
        w = np.clip(np.divide(into, width, out=np.zeros(scalars.shape), where=width > 0), 0, 1)
        colours = self.colours[low] + (self.colours[high] - self.colours[low]) * w[..., None]
        return colours, self.extinctions[low] + (self.extinctions[high] - self.extinctions[low]) * w

    def local(self, volume: TetVolume) -> LocalTransfer:
        """Return the function of normalised scalars and local lengths, for the device. Raise
        VoxtoolError for an extinction that float32 does not hold."""
        with np.errstate(over="ignore"):
            local = self.extinctions * volume.scale
        if (local > LARGEST).any():
            at = int(local.argmax())
            raise VoxtoolError(
                f"transfer function, point {at + 1}: extinction {self.extinctions[at]:g} is more "
                f"than float32 holds on a mesh of size {volume.scale:g}: choose a smaller one"
            )
        low, high = volume.scalar_range
        shown = self._within(low, high)
        reach = (high - low) or 1.0
        at = (shown.scalars - low) / reach
        points = np.where(at < TINY, 0, at).astype(np.float32)
        full = np.column_stack([shown.colours, shown.extinctions * volume.scale])
        full = np.where(full < TINY, 0, full)
        values = full.astype(np.float32)
        below = np.concatenate([[0], np.arange(len(points))])
        above = np.minimum(below + 1, len(points) - 1)
        above[0] = 0
        width = points[above] - points[below]
        wide = width > 1 / LARGEST
        rows = np.zeros((len(points) + 1, ROW), np.float32)
        rows[:, 0] = points[below]
        rows[wide, 1] = 1 / width[wide]
        rows[:, 2:6] = values[below]
        rows[wide, 6:10] = values[above][wide] - values[below][wide]
        exact = np.empty((len(points) + 1, EXACT_ROW))
        exact[:, 0] = at[below]
        exact[:, 1] = (shown.scalars[above] - shown.scalars[below]) / reach
        exact[:, 2:6] = full[below]
        exact[:, 6:] = full[above] - full[below]
        return LocalTransfer(points, rows, exact)

    def _within(self, low: float, high: float) -> TransferFunction:
        """Return a function that is the same from low to high and constant elsewhere: points far
        outside would cost float32 its precision within."""
        first, last = np.searchsorted(self.scalars, [low, high], side="right")
        front = [low] if first > 0 else []
        inner = self.scalars[first:last]
        back = [high] if last < len(self.scalars) and high not in (*front, *inner) else []
        before, after = self.evaluate(np.array(front)), self.evaluate(np.array(back))
        return TransferFunction(
            np.concatenate([front, inner, back]),
            np.concatenate([before[0], self.colours[first:last], after[0]]),
            np.concatenate([before[1], self.extinctions[first:last], after[1]]),
        )


def _wrong_with(point: Any) -> str:
    """Return what is wrong with a control point of JSON, or ""."""
    if not isinstance(point, dict):
        return "an object is expected"
    for key in (*KEYS, *point):
        if key not in point:
            return f"it has no {key}"
        if key not in KEYS:
            return f"{printable(key)[:40]!r} is unknown: it has {', '.join(KEYS)}"
    colour = point["color"]
    if not (isinstance(colour, list) and len(colour) == 3 and all(map(_is_number, colour))):
        return "its color is not a list of three numbers"
    for key in ("scalar", "extinction"):
        if not _is_number(point[key]):
            return f"its {key} is not a number"
    return ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, eq=False)
class LocalTransfer:
    """A transfer function of normalised scalars, per local length, for
    kernels/tets/pictures/transfer.h.

    points : (K,) float32, the scalars of the control points.
    rows : (K + 1, ROW) float32, one for each interval, the first below all points: the scalar at
        its low end; 1 / width; red, green, blue and extinction there; how they change to its end.
    exact : (K + 1, EXACT_ROW) float64, the same with the width of the interval itself, which is not
        0 where points are equal only by rounding.
    """

    points: np.ndarray
    rows: np.ndarray
    exact: np.ndarray

    @property
    def steepest(self) -> float:
        """The largest extinction per local length."""
        return float(self.exact[:, 5].max())

    def below(self, parts: int) -> np.ndarray:
        """Return the number of control points below each of `parts` equal parts of [0, 1], (parts,)
        float32. `parts` is a power of two, so that a scalar's part is computed exactly."""
        part = np.clip(self.points * np.float32(parts), 0, parts - 1).astype(np.int64)
        return np.searchsorted(part, np.arange(parts)).astype(np.float32)

    def transparent(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return which ranges of normalised scalars, (N,) float32 from low to high, ends included,
        have no extinction, (N,) bool."""
        first = np.searchsorted(self.points, low, side="right")
        last = np.searchsorted(self.points, high, side="right")
        # of the interval that begins at `high`, only that scalar is in the range
        start, change = self.rows[:, 5], self.rows[:, 9]
        begins = (last > 0) & (high == self.points[last - 1]) & (start[last] == 0)
        last = np.where(begins, last, last + 1)
        seen = (start != 0) | (change != 0)
        seen[1:-1] &= self.exact[1:-1, 1] > 0  # a step holds no scalar
        before = np.concatenate([[0], np.cumsum(seen)])
        return before[last] == before[first]


# --- named maps ----------------------------------------------------------------------------------

DEFAULT_MAP = "viridis"
DEPTH = 24  # unit distances along a mesh's longest side, by default
OPACITY_RANGE = ("75%", "99%")  # percentiles at which extinction is 0 and full by default


def named(
    name: str,
    low: float,
    high: float,
    unit_distance: float,
    opacity_range: Sequence[float] | None = None,
) -> TransferFunction:
    """Return a map of colours from scalar `low` to `high`, and a ramp of extinction; see
    `default_transfer`.

    opacity_range : by default low and high; a step where the two are equal.

    Raises
    ------
    VoxtoolError : no such map, or a number is out of range.
    """
    if name not in MAPS:
        raise VoxtoolError(f"map {printable(name)!r} is unknown: choose {', '.join(MAPS)}")
    if not (0 < unit_distance < np.inf and 1 / unit_distance < np.inf):
        raise VoxtoolError(f"unit distance {unit_distance:g}: give a positive length")
    clear, full = (low, high) if opacity_range is None else opacity_range
    if not (low <= high and all(abs(s) < FARTHEST for s in (low, high, clear, full))):
        raise VoxtoolError(
            f"scalars from {low:g} to {high:g}, opacity from {clear:g} to {full:g}: give finite "
            "ranges"
        )
    colours = np.array([list(bytes.fromhex(word)) for word in MAPS[name].split()]) / 255
    at = low + (high - low) * np.arange(len(colours)) / (len(colours) - 1)
    if low == high:
        at, colours = at[:1], colours[len(colours) // 2 :][:1]
    at, own = np.unique(at, return_index=True)
    scalars = np.unique(np.concatenate([at, [clear, full]]))
    if clear == full:
        scalars = np.sort(np.append(scalars, full))  # a step
        ramp = np.arange(len(scalars)) >= np.searchsorted(scalars, full, side="right") - 1
    else:
        reach = full - clear
        ramp = np.clip(scalars - clear, min(0, reach), max(0, reach)) / reach + 0.0
    smooth, _ = TransferFunction(at, colours[own], np.zeros(len(at))).evaluate(scalars)
    return TransferFunction(scalars, smooth, ramp / unit_distance)


def default_transfer(
    volume: TetVolume,
    name: str = DEFAULT_MAP,
    *,
    opacity_range: Sequence[float | str] | str | None = None,
    unit_distance: float | None = None,
) -> TransferFunction:
    """Return a colour map over the range of a volume's scalars, with a ramp of extinction.

    Parameters
    ----------
    volume : TetVolume
        The volume.
    name : str
        "viridis", "inferno", "coolwarm", "turbo" or "gray".
    opacity_range : (float or str, float or str) or "full", optional
        Scalars at which the extinction is 0 and full, in either order; "75%" is the scalar that is
        not exceeded in 75 % of the volume; "full" is the range of the scalars. By default "75%"
        and "99%", which hides the background of a simulation.
    unit_distance : float, optional
        Length over which full extinction leaves a transmittance of 1/e, world units; by default a
        24th of the volume's longest side.

    Returns
    -------
    TransferFunction

    Raises
    ------
    VoxtoolError
        If the map is unknown or a number is out of range.
    """
    low, high = volume.bounds()
    if unit_distance is None:
        unit_distance = float((high - low).max()) / DEPTH or 1.0
    if isinstance(opacity_range, str):
        if opacity_range != "full":
            raise VoxtoolError(f"opacity range {opacity_range!r}: give two scalars, or 'full'")
        opacity_range = volume.scalar_range
    ends = scalars_at(volume, OPACITY_RANGE if opacity_range is None else opacity_range)
    if opacity_range is None and not ends[0] < ends[1]:
        ends = volume.scalar_range
    return named(name, *volume.scalar_range, unit_distance, ends)


def scalars_at(volume: TetVolume, places: Sequence[float | str]) -> tuple[float, ...]:
    """Return scalars, of which some are given as percentiles by volume, such as "75%".

    Raises
    ------
    VoxtoolError
        If a percentile is not from 0 to 100.
    """
    if not any(isinstance(place, str) for place in places):
        return tuple(map(float, places))
    scalars, shares = scalar_shares(volume)
    (low, high), below = volume.scalar_range, np.cumsum(shares)
    found = []
    for place in places:
        if not isinstance(place, str):
            found.append(float(place))
            continue
        percent = _percent(place)
        rank = int(np.searchsorted(below, percent / 100 * below[-1]))
        found.append(low + (high - low) * float(scalars[min(rank, len(scalars) - 1)]))
    return tuple(found)


def _percent(text: str) -> float:
    try:
        percent = float(text.removesuffix("%"))
    except ValueError:
        percent = math.nan
    if not (text.endswith("%") and 0 <= percent <= 100):
        raise VoxtoolError(f"opacity range: {printable(text)!r} is no percentile: write 75%")
    return percent


def scalar_shares(volume: TetVolume) -> tuple[np.ndarray, np.ndarray]:
    """Return the normalised scalars of a volume in ascending order, (n,) float32, and the volume
    that each stands for, (n,) float64, local. A cell stands for its own volume, a vertex for an
    equal part of that of each of its cells."""
    sizes = cell_sizes(volume)
    if volume.constant:
        scalars = volume.gradients[:, 3]
    else:
        scalars, corners = volume.vertices[:, 3], volume.cells.shape[1]
        parts = np.repeat(sizes / corners, corners)
        sizes = np.bincount(volume.cells.ravel(), parts, len(scalars))
    order = np.argsort(scalars, kind="stable")
    return scalars[order], sizes[order]


def cell_sizes(volume: TetVolume) -> np.ndarray:
    """Return the volume of each cell, (T,) float64, local. A hexahedron has that of the six
    tetrahedra about its diagonal."""
    sizes = np.zeros(len(volume.cells))
    for corners in TETRAHEDRA[volume.cells.shape[1]]:
        a, b, c, d = volume.vertices[volume.cells[:, corners], :3].astype(np.float64).swapaxes(0, 1)
        sizes += np.abs(dot(b - a, cross(c - a, d - a))) / 6
    return sizes
