"""A slice of a distance field as a picture: what it says on a plane, and where its leaves are.

Red is inside, blue outside. Isolines are at round distances, the thick one at 0; fine squares are
the leaves that are large enough to be seen. The two axes that remain run right and up in the order
x, y, z, in world units.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from voxtool.errors import FileError, VoxtoolError
from voxtool.files.atomic import atomic_path
from voxtool.files.streams import STREAM, PathLike, standard_output
from voxtool.memory import check_memory

if TYPE_CHECKING:
    from voxtool.adf.field import Answer, DistanceField
    from voxtool.adf.query import FieldQuery

AXES = "xyz"
LEAST_LEAF = 4  # pixels: smaller leaves get no lines
ISOLINES = 9  # of each sign, at most
DPI = 100  # at which text has its size
MARGINS = (0.1, 0.02, 0.11, 0.05)  # left, right, bottom, top; of the picture's width
BAR = (0.03, 0.025, 0.08)  # from the plot to the scale, its width, and what its numbers take
BYTES = 400  # a pixel, at most: the answer, the isolines, the picture

INSIDE = ("#5e0a1b", "#a82233", "#d65f4c", "#efa07f", "#fbdccb")  # the last at the surface
OUTSIDE = ("#dbe9f4", "#9cc6e2", "#5b9fcd", "#2b6cab", "#0c2f5e")  # the first


def write_slice(
    query: FieldQuery,
    path: PathLike,
    axis: str,
    value: float,
    size: int = 800,
    clobber: bool = True,
) -> Answer:
    """Write a picture of a field on a plane as .png; `-` writes stdout.

    Parameters
    ----------
    axis, value : the plane: "x", "y" or "z", and where it crosses that axis, in world units.
    size : pixels of the picture's width.
    clobber : False refuses an existing file.

    Returns
    -------
    What the field says at the pixels of the plot.

    Raises
    ------
    VoxtoolError : no such axis, or the plane misses the cube.
    FileError : matplotlib is missing, or the file cannot be written.
    MemoryLimitError : the picture does not fit in memory.
    """
    try:
        import matplotlib as _  # noqa: F401
    except ImportError:
        raise FileError("pictures need matplotlib: pip install 'voxtool[pictures]'") from None
    check_plane(query.field, axis, value)
    check_memory(BYTES * size * size, f"a picture {size} pixels wide", "choose a smaller --size")
    with ExitStack() as stack:
        if path == STREAM:
            file: BinaryIO = stack.enter_context(standard_output(text=False))
        else:
            temporary = stack.enter_context(atomic_path(path, clobber))
            file = stack.enter_context(open(temporary, "wb"))
        return _draw(query, file, AXES.index(axis), value, size)


def check_plane(field: DistanceField, axis: str, value: float) -> None:
    """Refuse a plane that misses the cube.

    Raises
    ------
    VoxtoolError : says where it is.
    """
    if axis not in AXES or len(axis) != 1:
        raise VoxtoolError(f"axis {axis!r} is unknown: choose x, y or z")
    low = field.origin[AXES.index(axis)]
    if not low <= value <= low + field.side:
        raise VoxtoolError(
            f"slice {axis}={value:g} lies outside of the cube: choose {low:.9g} to "
            f"{low + field.side:.9g}"
        )


def _draw(query: FieldQuery, file: BinaryIO, normal: int, value: float, size: int) -> Answer:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    field = query.field
    left, right, bottom, top = MARGINS
    width = 1 - left - right - sum(BAR)
    height = width + bottom + top
    count = round(width * size)
    answer = query(_plane_points(field, normal, value, count), cell=True)
    distance = answer.distance.reshape(count, count)
    across, up = (axis for axis in range(3) if axis != normal)
    extent = [field.origin[a] + end * field.side for a in (across, up) for end in (0, 1)]
    unit = f" ({field.units})" if field.units else ""
    most = float(np.abs(distance).max()) or 1.0
    step = round_step(most / ISOLINES)
    levels = step * np.arange(math.ceil(distance.min() / step), distance.max() // step + 1)

    with matplotlib.rc_context(dict(matplotlib.rcParamsDefault)):  # whatever the user prefers
        figure = Figure(figsize=(size / DPI, height * size / DPI), dpi=DPI, facecolor="white")
        FigureCanvasAgg(figure)
        box = (left, bottom / height, width, width / height)
        plot = figure.add_axes(box)
        colours = LinearSegmentedColormap.from_list("distance", colour_stops(), 1024)
        image = plot.imshow(
            distance, cmap=colours, vmin=-most, vmax=most, origin="lower",
            interpolation="nearest", extent=(extent[0], extent[1], extent[2], extent[3]),
        )  # fmt: skip
        drawn = _outline_leaves(plot, field, answer, normal, count)
        middles = (np.arange(count) + 0.5) / count  # of the pixels
        places = [extent[i] + middles * field.side for i in (0, 2)]
        thin = levels[levels != 0]
        style: dict[str, Any] = {"colors": "#1a1a1a", "negative_linestyles": "solid"}
        if len(thin):
            plot.contour(*places, distance, levels=thin, linewidths=0.6, alpha=0.6, **style)
        if distance.min() < 0 < distance.max():
            plot.contour(*places, distance, levels=[0.0], linewidths=2.2, **style)
        plot.set_xlabel(f"{AXES[across]}{unit}", fontsize=9)
        plot.set_ylabel(f"{AXES[up]}{unit}", fontsize=9)
        plot.set_title(f"{AXES[normal]} = {value:g}{unit}", fontsize=11, pad=8)
        plot.tick_params(labelsize=8)
        bar = figure.add_axes((left + width + BAR[0], box[1], BAR[1], box[3]))
        figure.colorbar(image, cax=bar, ticks=levels)
        bar.set_ylim(distance.min(), distance.max())
        bar.tick_params(labelsize=8)
        bar.set_title(f"distance{unit}", fontsize=8, pad=8)
        legend = (
            f"red inside, blue outside; isolines every {step:g}{unit[2:-1] and ' ' + field.units}"
        )
        figure.text(
            left, 0.02 / height, f"{legend}, thick at 0; {drawn}", fontsize=8, color="#404040"
        )
        figure.savefig(file, format="png", metadata={"Software": None})
    return answer


def _plane_points(field: DistanceField, normal: int, value: float, count: int) -> np.ndarray:
    """(count**2, 3) float64: the middles of count x count pixels on the cube's face, row by row
    from the lowest."""
    places = (np.arange(count) + 0.5) * (field.side / count)
    points = np.empty((count, count, 3))
    across, up = (axis for axis in range(3) if axis != normal)
    points[..., normal] = value
    points[..., across] = field.origin[across] + places
    points[..., up] = field.origin[up] + places[:, None]
    return points.reshape(-1, 3)


def _outline_leaves(
    plot: Any, field: DistanceField, answer: Answer, normal: int, count: int
) -> str:
    """Squares around the leaves that are large enough; says which ones."""
    from matplotlib.collections import LineCollection

    assert answer.level is not None
    assert answer.cell is not None
    finest = int(math.log2(count / LEAST_LEAF))
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
    """Places from 0 to 1 and the colours there; they change at once in the middle, the surface."""
    places = np.linspace(0, 0.5, len(INSIDE)), np.linspace(0.5, 1, len(OUTSIDE))
    return [*zip(places[0].tolist(), INSIDE, strict=True),
            *zip(places[1].tolist(), OUTSIDE, strict=True)]  # fmt: skip


def round_step(least: float) -> float:
    """The least of 1, 2 and 5 times a power of ten that is not below a positive number."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(float(f"{step * power:.0e}") for step in (1, 2, 5, 10) if step * power >= least)
