"""A slice of a distance field as a picture: the distances on a plane, and the leaves it crosses.

Red is inside, blue outside. Isolines are at round distances, the thick one at 0. Thin squares are
the leaves that are large enough to be seen. The two remaining axes run right and up in the order x,
y, z, in world units.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import VoxtoolError
from voxtool.memory import check_memory
from voxtool.plots.canvas import drawn, need_matplotlib

if TYPE_CHECKING:
    from voxtool.adf.field import DistanceField
    from voxtool.adf.host_query import QueryResult
    from voxtool.adf.query import FieldQuery

AXES = "xyz"
LEAST_LEAF = 4  # pixels: smaller leaves get no lines
ISOLINES = 9  # of each sign, at most
MARGINS = (0.1, 0.02, 0.11, 0.05)  # left, right, bottom, top; of the picture's width
BAR = (0.03, 0.025, 0.08)  # from the plot to the scale, its width, and what its numbers take
BYTES = 400  # a pixel, at most: the answer, the isolines, the picture

INSIDE = ("#5e0a1b", "#a82233", "#d65f4c", "#efa07f", "#fbdccb")  # the last at the surface
OUTSIDE = ("#dbe9f4", "#9cc6e2", "#5b9fcd", "#2b6cab", "#0c2f5e")  # the first at the surface


def draw_slice(
    query: FieldQuery, axis: str, value: float, size: int = 800
) -> tuple[np.ndarray, QueryResult]:
    """Return a picture of a distance field on a plane, and the field's values there.

    Parameters
    ----------
    axis, value : normal of the plane, "x", "y" or "z", and its coordinate there, world units.
    size : width of the picture in pixels.

    Returns
    -------
    picture : (H, size, 4) float32, premultiplied, top row first.
    answer : the field at the pixels of the plot, row by row from the lowest.

    Raises
    ------
    VoxtoolError : no such axis, or the plane misses the cube.
    FileError : matplotlib is missing.
    MemoryLimitError : the picture does not fit in memory.
    """
    need_matplotlib("pictures")
    check_plane(query.field, axis, value)
    check_memory(BYTES * size * size, f"a picture {size} pixels wide", "choose a smaller --size")
    field, normal = query.field, AXES.index(axis)
    across, up = (a for a in AXES if a != axis)
    left, right, bottom, top = MARGINS
    width = 1 - left - right - sum(BAR)  # of the plot; widths of the picture are the unit
    height = width + bottom + top
    answer = query(_plane_points(field, normal, value, round(width * size)), cell=True)
    unit = f" ({field.units})" if field.units else ""

    def paint(figure: Any) -> None:
        low, high = bottom / height, width / height
        plot = figure.add_axes((left, low, width, high))
        bar = figure.add_axes((left + width + BAR[0], low, BAR[1], high))
        step = _draw_distances(figure, plot, bar, field, answer, normal)
        leaves = _outline_leaves(plot, field, answer, normal)
        plot.set_xlabel(f"{across}{unit}", fontsize=9)
        plot.set_ylabel(f"{up}{unit}", fontsize=9)
        plot.set_title(f"{axis} = {value:g}{unit}", fontsize=11, pad=8)
        plot.tick_params(labelsize=8)
        bar.tick_params(labelsize=8)
        bar.set_title(f"distance{unit}", fontsize=8, pad=8)
        spacing = f"{step:g} {field.units}".strip()
        legend = f"red inside, blue outside; isolines every {spacing}, thick at 0; {leaves}"
        figure.text(left, 0.02 / height, legend, fontsize=8, color="#404040")

    return drawn(size, height * size, paint, face="white"), answer


def check_plane(field: DistanceField, axis: str, value: float) -> None:
    """Raise VoxtoolError, which names the range of the field's cube, if a plane misses it."""
    if axis not in AXES or len(axis) != 1:
        raise VoxtoolError(f"axis {axis!r} is unknown: choose x, y or z")
    low = field.origin[AXES.index(axis)]
    if not low <= value <= low + field.side:
        raise VoxtoolError(
            f"slice {axis}={value:g} lies outside of the cube: choose {low:.9g} to "
            f"{low + field.side:.9g}"
        )


def _draw_distances(
    figure: Any, plot: Any, bar: Any, field: DistanceField, answer: QueryResult, normal: int
) -> float:
    """Draw the colours, the isolines and the scale; return the step between isolines."""
    from matplotlib.colors import LinearSegmentedColormap

    count = math.isqrt(len(answer.distance))
    distance = answer.distance.reshape(count, count)
    low, high = distance.min(), distance.max()
    most = float(np.abs(distance).max()) or 1.0
    step = round_step(most / ISOLINES)
    levels = step * np.arange(math.ceil(low / step), high // step + 1)
    corners = [field.origin[a] for a in range(3) if a != normal]
    extent = tuple(corner + end * field.side for corner in corners for end in (0, 1))
    image = plot.imshow(
        distance,
        cmap=LinearSegmentedColormap.from_list("distance", colour_stops(), 1024),
        vmin=-most,
        vmax=most,
        origin="lower",
        interpolation="nearest",
        extent=extent,
    )
    middles = (np.arange(count) + 0.5) / count * field.side  # of the pixels
    places = [corner + middles for corner in corners]
    style: dict[str, Any] = {"colors": "#1a1a1a", "negative_linestyles": "solid"}
    thin = levels[levels != 0]
    if len(thin):
        plot.contour(*places, distance, levels=thin, linewidths=0.6, alpha=0.6, **style)
    if low < 0 < high:
        plot.contour(*places, distance, levels=[0.0], linewidths=2.2, **style)
    figure.colorbar(image, cax=bar, ticks=levels)
    bar.set_ylim(low, high)
    return step


def _plane_points(field: DistanceField, normal: int, value: float, count: int) -> np.ndarray:
    """Return the centres of count x count pixels on the plane, row by row from the lowest,
    (count**2, 3) float64."""
    places = (np.arange(count) + 0.5) * (field.side / count)
    points = np.empty((count, count, 3))
    across, up = (axis for axis in range(3) if axis != normal)
    points[..., normal] = value
    points[..., across] = field.origin[across] + places
    points[..., up] = field.origin[up] + places[:, None]
    return points.reshape(-1, 3)


def _outline_leaves(plot: Any, field: DistanceField, answer: QueryResult, normal: int) -> str:
    """Draw squares around the leaves that are large enough; return a phrase that says which."""
    from matplotlib.collections import LineCollection

    assert answer.level is not None
    assert answer.cell is not None
    finest = int(math.log2(math.isqrt(len(answer.level)) / LEAST_LEAF))
    axes = [axis for axis in range(3) if axis != normal]
    segments, shown = [], []
    for level in range(1, finest + 1):
        found = answer.level == level
        if not found.any():
            continue
        shown.append(level)
        edge = field.side / (1 << level)
        cells = np.unique(answer.cell[found][:, axes], axis=0)
        low = np.array(field.origin)[axes] + cells * edge
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]) * edge
        segments += list(low[:, None] + corners)
    plot.add_collection(
        LineCollection(segments, colors="#000000", linewidths=0.5, alpha=0.2), autolim=False
    )
    if not shown:
        return f"leaves, all of levels over {finest}, are too small to be drawn"
    what = f"{shown[0]}" if len(shown) == 1 else f"{shown[0]} to {shown[-1]}"
    finer = "; finer ones are not drawn" if (answer.level > finest).any() else ""
    return f"squares: leaves, level{'s' if len(shown) > 1 else ''} {what}{finer}"


def colour_stops() -> list[tuple[float, str]]:
    """Return places from 0 to 1 and their colours, with a step at the surface, in the middle."""
    places = np.linspace(0, 0.5, len(INSIDE)), np.linspace(0.5, 1, len(OUTSIDE))
    return [*zip(places[0].tolist(), INSIDE, strict=True),
            *zip(places[1].tolist(), OUTSIDE, strict=True)]  # fmt: skip


def round_step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is at least `least`, > 0."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(float(f"{step * power:.0e}") for step in (1, 2, 5, 10) if step * power >= least)
