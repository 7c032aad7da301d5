"""A transfer function drawn: its colours along the scalar, and its extinction.

For eyes, so it is drawn by matplotlib; its pixels depend on that library's version.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.choices import WHITE
from voxtool.errors import FileError, VoxtoolError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from voxtool.tets.transfer import TransferFunction

LEAST_HEIGHT = 200  # pixels: text of lower legends cannot be read
HEIGHT, WIDTH = 512, 176  # pixels; others in proportion
DPI = 100  # at this height, at which text has its size
STEPS = 512  # colours along the scalar
BAR = (0.34, 0.08)  # of the width: where the colour bar begins, and its own
CURVE = (0.47, 0.45)  # the same of the curve
TITLE = 26  # characters that fit
BOTTOM, TOP = 0.12, 0.08  # of the height


def draw_legend(
    transfer: TransferFunction,
    scalar_range: tuple[float, float],
    title: str,
    height: int,
    *,
    unit: str = "",
    background: Sequence[float] | None = WHITE,
) -> np.ndarray:
    """The legend of a transfer function, to stand at the right of a picture.

    Parameters
    ----------
    scalar_range : what is shown, in the scalar's own units.
    title : the scalar's name; unit : the name of the world unit, or "".
    height : pixels.
    background : the colour behind the legend, which decides the colour of its text; None is white.

    Returns
    -------
    (height, W, 4) float32, premultiplied; nothing where nothing is drawn.

    Raises
    ------
    VoxtoolError : it would be too low to be read.
    FileError : matplotlib is missing.
    """
    if height < LEAST_HEIGHT:
        raise VoxtoolError(
            f"a legend {height} pixels high cannot be read: choose a --size of {LEAST_HEIGHT} or "
            "more, or leave out --legend"
        )
    try:
        import matplotlib
    except ImportError:
        raise FileError("legends need matplotlib: pip install 'voxtool[pictures]'") from None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = scalar_range
    if low == high:
        low, high = low - 0.5, high + 0.5
    places = np.linspace(low, high, STEPS)
    scalars = transfer.scalars
    colours = np.stack([np.interp(places, scalars, c) for c in transfer.colours.T], axis=-1)
    # all corners of the curve: narrow peaks are shown, and steps are steep
    within = (scalars > low) & (scalars < high)
    corners = np.concatenate([[low], scalars[within], [high]])
    ends = np.interp([low, high], scalars, transfer.extinctions)
    curve = np.concatenate([ends[:1], transfer.extinctions[within], ends[1:]])
    most = float(curve.max()) or 1.0
    brightness = sum(np.multiply(background, (0.2126, 0.7152, 0.0722))) if background else 1.0
    ink, faint = ("#202020", "#909090") if brightness > 0.4 else ("#f0f0f0", "#909090")

    scale = height / HEIGHT
    width = round(WIDTH * scale)
    size = ((width + 0.01) / (DPI * scale), (height + 0.01) / (DPI * scale))
    with matplotlib.rc_context(dict(matplotlib.rcParamsDefault)):  # whatever the user prefers
        figure = Figure(figsize=size, dpi=DPI * scale, facecolor="none")
        canvas = FigureCanvasAgg(figure)
        extent = (0.0, 1.0, low, high)
        bar = figure.add_axes((BAR[0], BOTTOM, BAR[1], 1 - BOTTOM - TOP), facecolor="none")
        bar.imshow(colours[:, None], origin="lower", aspect="auto", extent=extent)
        bar.set_xticks([])
        bar.tick_params(labelsize=7, colors=ink, length=3)
        plot = figure.add_axes((CURVE[0], BOTTOM, CURVE[1], 1 - BOTTOM - TOP), facecolor="none")
        area = plot.fill_betweenx(corners, 0, curve, facecolor="none")
        filled = plot.imshow(
            colours[:, None], origin="lower", aspect="auto", extent=(0.0, most, low, high)
        )
        filled.set_clip_path(area.get_paths()[0], transform=plot.transData)
        plot.plot(curve, corners, color=ink, linewidth=0.8)
        plot.set_xlim(0, 1.06 * most)
        plot.set_ylim(low, high)
        plot.set_yticks([])
        plot.set_xticks([0, most], ["0", f"{most:.3g}"])
        plot.tick_params(labelsize=7, colors=ink, length=3)
        words: dict[str, Any] = {"color": ink, "parse_math": False}  # names may hold a $
        plot.set_xlabel(f"extinction per {unit or 'unit'}", fontsize=7, labelpad=1, **words)
        for axes in (bar, plot):
            for spine in axes.spines.values():
                spine.set(color=faint, linewidth=0.6)
        figure.text(0.04, 1 - TOP / 2, title[:TITLE], fontsize=8, va="center", **words)
        canvas.draw()
        straight = np.asarray(canvas.buffer_rgba()).astype(np.float32) / 255
    legend = straight.copy()
    legend[..., :3] *= straight[..., 3:]
    return legend
