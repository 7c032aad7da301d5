"""A transfer function as a picture: its colours along the scalar, and its extinction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import WHITE
from voxtool.errors import VoxtoolError
from voxtool.pictures.canvas import drawn, need_matplotlib

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.tets.pictures.transfer import TransferFunction

LEAST_HEIGHT = 200  # pixels: text of lower legends cannot be read
HEIGHT, WIDTH = 512, 176  # pixels; others in proportion
STEPS = 512  # colours along the scalar
BAR = (0.34, 0.08)  # left side and width of the colour bar, of the legend's width
CURVE = (0.47, 0.45)  # the same of the curve
TITLE = 26  # characters that fit
BOTTOM, TOP = 0.12, 0.08  # margins, of the height
FAINT = "#909090"
PALE = "#b8b8b8"
BINS = 64  # of the histogram


def draw_legend(
    transfer: TransferFunction,
    scalar_range: tuple[float, float],
    title: str,
    height: int,
    *,
    unit: str = "",
    background: Sequence[float] | None = WHITE,
    shares: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return the legend of a transfer function from the lowest to the highest scalar of a range, to
    stand at the right of a picture, (height, W, 4) float32, premultiplied.

    title : the scalar's name; unit : the name of the world unit, or "".
    background : the colour behind the legend, which decides the colour of its text; None is white.
    shares : scalars from 0 to 1 over the range, and the volume of each, (n,) both: a histogram of
        them is drawn behind the curve, its bars in proportion to the square root of the volume.

    Raises
    ------
    VoxtoolError : the legend would be too low to be read.
    FileError : matplotlib is missing.
    """
    check_height(height)
    need_matplotlib("legends")
    low, high = scalar_range
    if low == high:
        low, high = low - 0.5, high + 0.5
    ink = ink_on(background)

    def paint(figure: Any) -> None:
        bar, plot = (
            figure.add_axes((left, BOTTOM, width, 1 - BOTTOM - TOP), facecolor="none")
            for left, width in (BAR, CURVE)
        )
        _draw_colours(bar, plot, transfer, low, high, ink)
        if shares is not None:
            _draw_histogram(plot, *shares, low, high)
        words: dict[str, Any] = {"color": ink, "parse_math": False}  # names may hold a $
        plot.set_xlabel(f"extinction per {unit or 'unit'}", fontsize=7, labelpad=1, **words)
        figure.text(0.04, 1 - TOP / 2, title[:TITLE], fontsize=8, va="center", **words)

    scale = height / HEIGHT
    legend = drawn(round(WIDTH * scale), height, paint, scale=scale, face="none")
    legend[..., :3] *= legend[..., 3:]
    return legend


def check_height(height: int) -> None:
    """Raise VoxtoolError if a legend of this height cannot be read."""
    if height < LEAST_HEIGHT:
        raise VoxtoolError(
            f"a legend {height} pixels high cannot be read: choose a --size of {LEAST_HEIGHT} or "
            "more, or leave out --legend"
        )


def ink_on(background: Sequence[float] | None) -> str:
    """Return the colour of text on a background; None is white."""
    brightness = sum(np.multiply(background, (0.2126, 0.7152, 0.0722))) if background else 1.0
    return "#202020" if brightness > 0.4 else "#f0f0f0"


def _draw_histogram(
    plot: Any, scalars: np.ndarray, volumes: np.ndarray, low: float, high: float
) -> None:
    """Draw how much of the volume has each scalar, behind the curve. Square roots show rare ones,
    too."""
    counts, edges = np.histogram(scalars, BINS, (0.0, 1.0), weights=volumes)
    bars = 0.9 * np.sqrt(counts / (counts.max() or 1.0)) * plot.get_xlim()[1]
    at = low + (high - low) * edges
    plot.stairs(bars, at, orientation="horizontal", fill=True, color=PALE, zorder=-1)


def _draw_colours(
    bar: Any, plot: Any, transfer: TransferFunction, low: float, high: float, ink: str
) -> None:
    """Draw the colour bar, and the extinction as a curve filled with the colours."""
    places, scalars = np.linspace(low, high, STEPS), transfer.scalars
    colours = np.stack([np.interp(places, scalars, c) for c in transfer.colours.T], axis=-1)
    # all corners of the curve: narrow peaks are shown, and steps are steep
    within = (scalars > low) & (scalars < high)
    corners = np.concatenate([[low], scalars[within], [high]])
    ends = np.interp([low, high], scalars, transfer.extinctions)
    curve = np.concatenate([ends[:1], transfer.extinctions[within], ends[1:]])
    most = float(curve.max()) or 1.0
    area = plot.fill_betweenx(corners, 0, curve, facecolor="none")
    for axes, end in ((bar, 1.0), (plot, most)):
        extent = (0.0, end, low, high)
        filled = axes.imshow(colours[:, None], origin="lower", aspect="auto", extent=extent)
        axes.tick_params(labelsize=7, colors=ink, length=3)
        for spine in axes.spines.values():
            spine.set(color=FAINT, linewidth=0.6)
    filled.set_clip_path(area.get_paths()[0], transform=plot.transData)
    plot.plot(curve, corners, color=ink, linewidth=0.8)
    plot.set_xlim(0, 1.06 * most)
    plot.set_ylim(low, high)
    bar.set_xticks([])
    plot.set_yticks([])
    plot.set_xticks([0, most], ["0", f"{most:.3g}"])
