"""Slices of octrees and of distance fields as pictures.

In a slice of an octree dark blue is a voxel set in a brick; a leaf that lies completely inside the
solid is lighter, the coarser it is. In a slice of a field red is inside, blue outside; isolines are
at round distances, the thick one at 0. Thin lines bound the leaves that are large enough to be
seen. The two remaining axes run right and up in the order x, y, z.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import GridError, VoxtoolError
from voxtool.memory import check_memory
from voxtool.pictures.canvas import drawn, need_matplotlib
from voxtool.svo.cells.voxel_layers import Leaves, paint, sorted_leaves

if TYPE_CHECKING:
    from voxtool.adf.field.field import DistanceField
    from voxtool.adf.field.host_query import QueryResult
    from voxtool.adf.queries.query import FieldQuery
    from voxtool.svo.octree.octree import Octree

AXES = "xyz"


def axis_number(axis: str) -> int:
    """Return the number of the axis "x", "y" or "z"; raise GridError for another name."""
    if axis not in AXES or len(axis) != 1:
        raise GridError(f"axis {axis!r} is unknown: choose x, y or z")
    return AXES.index(axis)


# ---- octrees

TARGET = 1024  # pixels along the longer side
LEAST_CELL = 8  # pixels: smaller cells get no lines
LINE = 16  # added to a colour's number where a line crosses it

PAPER, PAPER_LINE = (252, 252, 250), (212, 217, 222)
BLUES = [(24, 62, 120), (108, 156, 208), (146, 186, 226), (178, 208, 238), (204, 225, 245)]
BLUE_LINES = [(62, 102, 160), (82, 131, 188), (118, 163, 209), (150, 187, 224), (176, 205, 233)]


def palette() -> list[int]:
    """Return red, green and blue of each colour number: OUTSIDE, SET + level, and these + LINE."""
    plain = [PAPER, *BLUES, *BLUES[-1:] * LINE][:LINE]
    crossed = [PAPER_LINE, *BLUE_LINES, *BLUE_LINES[-1:] * LINE][:LINE]
    return [component for colour in (*plain, *crossed) for component in colour]


def draw_octree_slice(octree: Octree, axis: str = "z", value: int | None = None) -> np.ndarray:
    """Return a picture of a slice of an octree, (height, width) uint8 colour numbers of `palette`,
    top row first.

    axis, value : normal of the slice, and index of the voxels along it; None takes the middle of
        the set voxels.

    Raises
    ------
    GridError : no such axis, or an index outside the grid.
    MemoryLimitError : the picture does not fit in memory.
    """
    normal = axis_number(axis)
    count = octree.grid.shape[normal]
    value = _middle(octree, normal) if value is None else value
    if not 0 <= value < count:
        raise GridError(f"slice {axis}={value} lies outside the grid: choose 0 to {count - 1}")
    right, up = (a for a in range(3) if a != normal)
    width, height = octree.grid.shape[right], octree.grid.shape[up]
    scale = max(1, round(TARGET / max(width, height)))
    needed = 4 * octree.grid.side**2 + 4 * scale * scale * width * height
    check_memory(needed, f"a picture of {width} x {height} voxels and its layers")
    order = (normal, up, right)
    leaves = sorted_leaves(octree, order)
    slab = paint(leaves, value - value % 4, order, octree.grid.shape)
    voxels = slab[value % 4, :height, :width]
    picture = np.pad(voxels.repeat(scale, 0).repeat(scale, 1), (0, 1))  # a pixel closes the frame
    picture[-1], picture[:, -1] = LINE, LINE
    for level in leaves:
        _outline(picture, level, level.touching(value), scale)
    return picture[::-1]


def _middle(octree: Octree, axis: int) -> int:
    """Return the layer in the middle of the set voxels, or of the grid if there are none."""
    low, high = octree.grid.shape[axis], 0
    for level in octree.levels():
        held = level.inside if level.number else octree.bricks != 0
        cells = level.cells[held, axis]
        if len(cells):
            low, high = min(low, int(cells.min())), max(high, int(cells.max()) + level.side)
    return min(low + high, 2 * octree.grid.shape[axis] - 1) // 2


def _outline(picture: np.ndarray, level: Leaves, chosen: slice, scale: int) -> None:
    """Draw a line along the low sides of each leaf; the other sides are those of neighbours."""
    if level.side * scale < LEAST_CELL:
        return
    height, width = picture.shape
    side = level.side * scale
    for row, column in (level.corners[chosen, 1:] * scale).tolist():
        if row < height and column < width:
            for edge in (picture[row, column:][:side], picture[row:, column][:side]):
                edge[edge < LINE] += LINE


# ---- fields

LEAST_LEAF = 4  # pixels: smaller leaves get no lines
ISOLINES = 9  # of each sign, at most
MARGINS = (0.1, 0.02, 0.11, 0.05)  # left, right, bottom, top, as shares of the picture's width
BAR = (0.03, 0.025, 0.08)  # from the plot to the scale, its width, and what its numbers take
BYTES = 400  # a pixel, at most: the answer, the isolines, the picture

INSIDE = ("#5e0a1b", "#a82233", "#d65f4c", "#efa07f", "#fbdccb")  # the last at the surface
OUTSIDE = ("#dbe9f4", "#9cc6e2", "#5b9fcd", "#2b6cab", "#0c2f5e")  # the first at the surface


def draw_field_slice(
    query: FieldQuery, axis: str, value: float, size: int = 800
) -> tuple[np.ndarray, QueryResult]:
    """Return a picture of a distance field on a plane, (H, size, 4) float32, premultiplied, top
    row first; and the field at the pixels of the plot, row by row from the lowest.

    axis, value : normal of the plane, and its coordinate there, world units.
    size : width of the picture in pixels.

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

    def plot_all(figure: Any) -> None:
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

    return drawn(size, height * size, plot_all, face="white"), answer


def check_plane(field: DistanceField, axis: str, value: float) -> None:
    """Raise VoxtoolError, which names the range of the field's cube, if a plane misses it."""
    low = field.origin[axis_number(axis)]
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
    ends = np.linspace((0, 0.5), (0.5, 1), len(INSIDE)).T.ravel().tolist()  # a step in the middle
    stops = list(zip(ends, INSIDE + OUTSIDE, strict=True))
    image = plot.imshow(
        distance,
        cmap=LinearSegmentedColormap.from_list("distance", stops, 1024),
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


def round_step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is at least `least`, > 0."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(float(f"{step * power:.0e}") for step in (1, 2, 5, 10) if step * power >= least)
